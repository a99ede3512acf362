//! Global albedo, Eq. (2), as the ratio of sums `Σ w s I / Σ w s²` with `s = gain (n·l)/d²`: the mean of ratios that the
//! paper prints is biased by grazing samples.

use super::energy::{Tukey, unit_normal, views_of};
use super::view::View;
use crate::geometry::TriMesh;
use nalgebra::Point3;
use rayon::prelude::*;

/// The surface's one albedo, times the light's strength, m²; robust weights are taken at `current`, if there is one.
pub fn global_albedo(
    mesh: &TriMesh,
    sites: &[Point3<f64>],
    visible: &[u64],
    views: &[View],
    current: Option<(f64, Tukey)>,
) -> Option<f64> {
    const TILE: usize = 2048;
    let sums: Vec<(f64, f64)> = (0..mesh.faces.len().div_ceil(TILE))
        .into_par_iter()
        .map(|tile| {
            let (mut numerator, mut denominator) = (0.0, 0.0);
            for face in tile * TILE..((tile + 1) * TILE).min(mesh.faces.len()) {
                let Some((normal, _)) = unit_normal(mesh, face) else {
                    continue;
                };
                for view in views_of(visible[face], views) {
                    let Some(sample) = view.sample(&sites[face], &normal) else {
                        continue;
                    };
                    let s = sample.unit_prediction;
                    let robust = current.map_or(1.0, |(albedo, loss)| {
                        loss.weight((sample.observed - albedo * s) / sample.sigma)
                    });
                    let weight = robust / (sample.sigma * sample.sigma);
                    numerator += weight * s * sample.observed;
                    denominator += weight * s * s;
                }
            }
            (numerator, denominator)
        })
        .collect();
    let (numerator, denominator) = sums
        .iter()
        .fold((0.0, 0.0), |(n, d), (a, b)| (n + a, d + b));
    (denominator > 0.0 && numerator > 0.0).then(|| numerator / denominator)
}
