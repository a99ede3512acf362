//! One bounce from every patch to every other.
//!
//! A Lambertian patch that looks L bright sends `L cosθ cosθ' dA/(π r²)` to another, where a perfectly white surface would
//! look as bright. That over what the light sends there directly is the share of light that has come over the first patch,
//! whatever the second one's albedo; its path is longer by the way from light to patch to patch over that from the light.

use crate::geometry::lanes::LANES;
use crate::interreflection::{Lit, Sources, Way};
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
            point,
            normal,
            direct,
            light_m,
            ..
        } = *self.patch;
        let (mut light, mut longer) = ([0.0f32; LANES], [0.0f32; LANES]);
        for step in self.sources.steps() {
            for i in 0..LANES {
                let way = Way::new(step, i, point, normal);
                let here = if way.here > 0.0 { way.here } else { 0.0 };
                let there = if way.there > 0.0 { way.there } else { 0.0 };
                let sent = way.power * (here * there) / way.to_the_fourth;
                light[i] += sent;
                longer[i] += sent * (way.light_m + way.squared.sqrt() - light_m);
            }
        }
        Bounce {
            share: light.iter().sum::<f32>() / direct,
            range_m: 0.5 * longer.iter().sum::<f32>() / direct,
        }
    }
}
