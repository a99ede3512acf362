//! The absolute trajectory error of Sturm et al. 2012: how far tracked positions are from the true ones.

use crate::geometry::Pose;
use nalgebra::{Matrix3, Vector3};
use serde::Serialize;

/// Fewer pairs do not determine the alignment.
const MIN_PAIRS: usize = 3;

/// A tracked pose and the true pose of the same moment; their worlds may differ.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PosePair {
    /// World from camera as tracked.
    pub estimate: Pose,
    /// World from camera as measured by something better.
    pub truth: Pose,
}

/// Distances of the tracked positions to the true ones after the best rigid alignment, metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TrajectoryError {
    /// How many poses were compared.
    pub n_pairs: usize,
    /// Root mean square distance.
    pub rmse_m: f64,
    /// Largest distance.
    pub max_m: f64,
}

/// Moves the tracked positions rigidly onto the true ones (Umeyama 1991, without scale) and measures what is left; `None`
/// for fewer than three pairs.
pub fn trajectory_error(pairs: &[PosePair]) -> Option<TrajectoryError> {
    if pairs.len() < MIN_PAIRS {
        return None;
    }
    let n = pairs.len() as f64;
    let source = |pair: &PosePair| pair.estimate.translation.vector;
    let target = |pair: &PosePair| pair.truth.translation.vector;
    let source_mean = pairs.iter().map(source).sum::<Vector3<f64>>() / n;
    let target_mean = pairs.iter().map(target).sum::<Vector3<f64>>() / n;
    let covariance = pairs
        .iter()
        .map(|pair| (target(pair) - target_mean) * (source(pair) - source_mean).transpose())
        .sum::<Matrix3<f64>>();
    let turn = nearest_rotation(&covariance)?;
    let distances = pairs
        .iter()
        .map(|pair| (turn * (source(pair) - source_mean) - (target(pair) - target_mean)).norm());
    let (sum, max_m) = distances.fold((0.0, 0.0f64), |(sum, max), d| (sum + d * d, max.max(d)));
    Some(TrajectoryError {
        n_pairs: pairs.len(),
        rmse_m: (sum / n).sqrt(),
        max_m,
    })
}

/// The rotation that has the largest trace with a covariance.
fn nearest_rotation(covariance: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let mut mirror = Matrix3::identity();
    // Singular values are sorted: the last axis is the one that a mirror image costs least.
    mirror[(2, 2)] = (u * v_t).determinant().signum();
    Some(u * mirror * v_t)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::increment;
    use nalgebra::Vector6;

    fn path() -> Vec<Pose> {
        (0..20)
            .map(|i| {
                let t = f64::from(i) * 0.1;
                increment(&Vector6::new(0.0, 0.0, 0.0, t.sin(), t.cos(), 0.3 * t * t))
            })
            .collect()
    }

    #[test]
    fn another_world_is_no_error_and_noise_is_as_large_as_it_is() {
        let other_world = increment(&Vector6::new(0.4, -0.2, 1.1, 3.0, -2.0, 0.5));
        let pair = |(i, truth): (usize, Pose)| {
            let mut estimate = other_world * truth;
            estimate.translation.vector.x += if i % 2 == 0 { 0.001 } else { -0.001 };
            PosePair { estimate, truth }
        };
        let pairs: Vec<PosePair> = path().into_iter().enumerate().map(pair).collect();
        let error = trajectory_error(&pairs).unwrap();
        assert_eq!(error.n_pairs, 20);
        // The alignment takes a little of the noise away.
        assert!((0.0009..=0.001).contains(&error.rmse_m), "{error:?}");
        assert!(error.max_m < 0.0013, "{error:?}");
    }

    #[test]
    fn two_pairs_tell_nothing() {
        let pair = |truth: Pose| PosePair {
            estimate: truth,
            truth,
        };
        let pairs: Vec<PosePair> = path().into_iter().take(2).map(pair).collect();
        assert_eq!(trajectory_error(&pairs), None);
    }
}
