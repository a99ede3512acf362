//! What sends light, laid out for kernels.

use super::Lit;
use crate::geometry::lanes::{LANES, Lane};

/// Patches nearer to one another than this count as this far apart, metres: a patch is no point.
pub const MIN_DISTANCE_M: f32 = 0.02;

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
