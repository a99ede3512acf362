//! What sends light, laid out for kernels.

use super::Lit;
use crate::geometry::lanes::{LANES, Lane};

/// Patches nearer to one another than this count as this far apart, metres: a patch is no point.
const MIN_DISTANCE_M: f32 = 0.02;

/// Point, normal, radiance times area, and distance to the light.
const N_COORDINATES: usize = 8;

/// Coordinates of patches, in steps of a kernel; the last is filled up with dark ones.
#[derive(Clone, Debug)]
pub struct Sources {
    steps: Vec<[Lane; N_COORDINATES]>,
}

impl Sources {
    /// Lays patches out in their order.
    pub fn new<'a>(patches: impl Iterator<Item = &'a Lit>) -> Self {
        let mut steps = Vec::new();
        for (index, lit) in patches.enumerate() {
            let lane = index % LANES;
            if lane == 0 {
                steps.push([[0.0; LANES]; N_COORDINATES]);
            }
            let ([x, y, z], [nx, ny, nz]) = (lit.point, lit.normal);
            let coordinates = [x, y, z, nx, ny, nz, lit.radiance * lit.area_m2, lit.light_m];
            for (column, value) in steps[index / LANES].iter_mut().zip(coordinates) {
                column[lane] = value;
            }
        }
        Sources { steps }
    }

    /// The steps: x, y, z (m), the normal's x, y, z, radiance times area (m²), distance to the light (m).
    #[inline]
    pub fn steps(&self) -> &[[Lane; N_COORDINATES]] {
        &self.steps
    }
}

/// How a source lies to a place that it lights.
#[derive(Clone, Copy)]
pub struct Way {
    /// From the place to the source, metres.
    pub across: [f32; 3],
    /// The square of that length.
    pub squared: f32,
    /// Cosine at the place times that length; negative below its horizon.
    pub here: f32,
    /// The same at the source.
    pub there: f32,
    /// Fourth power of the length, of `MIN_DISTANCE_M` at least: with it the cosines become those of unit vectors, and light fades.
    pub to_the_fourth: f32,
    /// Radiance times area of the source, m².
    pub power: f32,
    /// Distance of the source to the light, metres.
    pub light_m: f32,
}

impl Way {
    /// The way from a place with its unit normal to the source in a lane of a step.
    #[inline(always)]
    pub fn new(
        step: &[Lane; N_COORDINATES],
        lane: usize,
        [px, py, pz]: [f32; 3],
        [nx, ny, nz]: [f32; 3],
    ) -> Self {
        let [x, y, z, mx, my, mz, power, light_m] = step;
        let (dx, dy, dz) = (x[lane] - px, y[lane] - py, z[lane] - pz);
        let squared = dx * dx + dy * dy + dz * dz;
        let nearest = MIN_DISTANCE_M * MIN_DISTANCE_M;
        let apart = if squared > nearest { squared } else { nearest };
        Way {
            across: [dx, dy, dz],
            squared,
            here: nx * dx + ny * dy + nz * dz,
            there: -(mx[lane] * dx + my[lane] * dy + mz[lane] * dz),
            to_the_fourth: apart * apart,
            power: power[lane],
            light_m: light_m[lane],
        }
    }
}
