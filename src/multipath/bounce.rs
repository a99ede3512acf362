//! One bounce from every patch to every other.
//!
//! A Lambertian patch that looks L bright sends `L cosθ cosθ' dA/(π r²)` to another, where a perfectly white surface would
//! look as bright. That over what the light sends there directly is the share of light that has come over the first patch,
//! whatever the second one's albedo; its path is longer by the way from light to patch to patch over that from the light.

use crate::geometry::lanes::LANES;
use crate::interreflection::{Lit, MIN_DISTANCE_M, Sources};
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use std::ops::{Add, Mul};

/// Light that a patch receives over others, for a white level of 1/π.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Bounce {
    /// Its share of the direct light.
    pub share: f32,
    /// That share times half of how much longer its path is, metres.
    pub range_m: f32,
}

impl Bounce {
    /// The same in a place that is brighter by a factor r than its surroundings, whose direct light D the share is of: all light
    /// there is r(D + sB), of which that which is bounced is still sB.
    pub fn where_brighter_by(self, factor: f32) -> Bounce {
        Bounce {
            share: self.share,
            range_m: self.range_m / factor,
        }
    }
}

impl Add for Bounce {
    type Output = Bounce;

    fn add(self, other: Bounce) -> Bounce {
        Bounce {
            share: self.share + other.share,
            range_m: self.range_m + other.range_m,
        }
    }
}

impl Mul<f32> for Bounce {
    type Output = Bounce;

    fn mul(self, factor: f32) -> Bounce {
        Bounce {
            share: self.share * factor,
            range_m: self.range_m * factor,
        }
    }
}

/// What every patch receives over the sources; `None` for none.
pub fn bounces(patches: &[Option<Lit>], sources: &Sources) -> Vec<Option<Bounce>> {
    let arch = Arch::new();
    patches
        .par_iter()
        .map(|patch| {
            let patch = patch.as_ref()?;
            let kernel = Received { patch, sources };
            Some(arch.dispatch(kernel))
        })
        .collect()
}

/// What one patch receives.
struct Received<'a> {
    patch: &'a Lit,
    sources: &'a Sources,
}

impl WithSimd for Received<'_> {
    type Output = Bounce;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Bounce {
        let Lit {
            point: [px, py, pz],
            normal: [nx, ny, nz],
            direct,
            light_m,
            ..
        } = *self.patch;
        let (mut light, mut longer) = ([0.0f32; LANES], [0.0f32; LANES]);
        for [x, y, z, mx, my, mz, power, source_light_m] in self.sources.steps() {
            for i in 0..LANES {
                let (dx, dy, dz) = (x[i] - px, y[i] - py, z[i] - pz);
                let squared = dx * dx + dy * dy + dz * dz;
                let here = nx * dx + ny * dy + nz * dz;
                let there = -(mx[i] * dx + my[i] * dy + mz[i] * dz);
                let here = if here > 0.0 { here } else { 0.0 };
                let there = if there > 0.0 { there } else { 0.0 };
                let nearest = MIN_DISTANCE_M * MIN_DISTANCE_M;
                let apart = if squared > nearest { squared } else { nearest };
                let sent = power[i] * (here * there) / (apart * apart);
                light[i] += sent;
                longer[i] += sent * (source_light_m[i] + squared.sqrt() - light_m);
            }
        }
        Bounce {
            share: light.iter().sum::<f32>() / direct,
            range_m: 0.5 * longer.iter().sum::<f32>() / direct,
        }
    }
}
