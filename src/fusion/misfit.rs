//! How far fused frames lie from the model that they made.

use super::Fusion;
use crate::geometry::RayGrid;
use nalgebra::Point3;
use rayon::prelude::*;

/// Most frames that are looked at, evenly spread.
const MAX_FRAMES: usize = 60;
/// Pixels between those that are looked at.
const STEP_PX: usize = 8;

impl Fusion {
    /// Mean distance of points of the fused frames to the model, metres, where it knows none the truncation distance; `None` without
    /// such points.
    pub fn misfit_m(&self, rays: &RayGrid) -> Option<f64> {
        let frames = self.keyframes();
        let every = frames.len().div_ceil(MAX_FRAMES).max(1);
        let unknown_m = f64::from(self.fused.volume.truncation_m());
        let sums: Vec<(f64, usize)> = frames
            .par_iter()
            .step_by(every)
            .map(|frame| {
                let depth_m = frame.depth_m();
                let (mut sum, mut n_points) = (0.0, 0);
                for v in (0..depth_m.height()).step_by(STEP_PX) {
                    for u in (0..depth_m.width()).step_by(STEP_PX) {
                        let z = *depth_m.at(u, v);
                        if z <= 0.0 {
                            continue;
                        }
                        let point = Point3::from((rays.direction(u, v) * z).cast::<f64>());
                        let known = self.signed_distance(&(frame.world_from_camera * point));
                        sum += known.map_or(unknown_m, |(distance, _)| distance.abs());
                        n_points += 1;
                    }
                }
                (sum, n_points)
            })
            .collect();
        mean(&sums)
    }
}

/// Mean of values by their sums and numbers; `None` of none.
pub(super) fn mean(sums: &[(f64, usize)]) -> Option<f64> {
    let (sum, n) = sums
        .iter()
        .fold((0.0, 0), |sum, part| (sum.0 + part.0, sum.1 + part.1));
    (n > 0).then(|| sum / n as f64)
}
