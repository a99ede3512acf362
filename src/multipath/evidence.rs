//! What a fused scan tells of the white level: views of one place disagree by what multipath makes of each.
//!
//! At a place of the model, view i lies `x_i = β_i − β̄` deeper than the mean of all views for each unit of strength, where β
//! is the predicted bias along the normal and grows where light comes in slantingly. What is left after each view has been
//! moved rigidly, as tracking would, is compared with how deep the view does lie: the slope is by how much the strength is
//! wrong. Tracking and fusion have hidden a part of it, so that the slope is too small by a factor of about two, and only its
//! zero is exact.

use super::RangeBias;
use crate::geometry::{MotionEquations, Pose, RayGrid, cell_of, point_to_plane_row};
use crate::interreflection::WhiteLevel;
use crate::robust::{Tukey, median_absolute_deviation};
use depth_camera::Image;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// A fused frame.
#[derive(Clone, Copy, Debug)]
pub struct Seen<'a> {
    /// Depth that was fused, metres, 0 is none.
    pub depth_m: &'a Image<f32>,
    /// Where it was fused.
    pub world_from_camera: &'a Pose,
    /// Its predicted multipath.
    pub bias: &'a RangeBias,
}

/// By how much the strength of multipath, 1/(π white level), is wrong.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Evidence {
    /// What should be added to the strength, as far as tracking and fusion have not hidden it.
    pub slope: f64,
    /// Standard deviation of the slope, from the scatter of the residuals.
    pub sigma: f64,
    /// How much the views should disagree for each unit of strength, root mean square, metres.
    pub predicted_m: f64,
    /// How much they disagree, metres.
    pub residual_m: f64,
    /// Patches that were compared.
    pub n_patches: usize,
}

/// Pixels between those that are looked at.
const STEP_PX: usize = 4;
/// Side of the places at which views are compared, metres.
const PLACE_M: f64 = 0.02;
/// Fewer views of a place and there is no mean to differ from.
const MIN_VIEWS: usize = 3;
/// More slanting patches are not compared.
const MIN_COSINE: f64 = 0.3;
/// Fewer patches in a view and its pose takes up all that there is.
const MIN_PATCHES: usize = 50;
/// Motions that the patches of a view do not hold are damped by this share of all that they hold. What is predicted and what is found
/// lose the same motions, so that it need only outweigh rounding.
const DAMPING: f64 = 1e-9;
/// Reweighting settles within ten rounds.
const ROUNDS: usize = 15;

/// A patch of a view on the model.
#[derive(Clone, Copy)]
struct Sample {
    place: [i32; 3],
    point: Point3<f64>,
    normal: Vector3<f64>,
    cosine: f64,
    /// Bias along the normal for each unit of strength, metres.
    beta_m: f64,
    /// How deep below the model's surface it lies, metres.
    depth_m: f64,
}

/// What views of a model tell of the strength of multipath, fused with that of `white`; `signed_distance` gives distance (m, positive
/// outside) and gradient of the model at a point of the world. `None` where too little was seen.
pub(super) fn evidence(
    views: &[Seen],
    rays: &RayGrid,
    white: Option<WhiteLevel>,
    signed_distance: impl Fn(&Point3<f64>) -> Option<(f64, Vector3<f64>)> + Sync,
) -> Option<Evidence> {
    let of_view = |view: &Seen| samples(view, rays, white, &signed_distance);
    let views: Vec<Vec<Sample>> = views.par_iter().map(of_view).collect();
    let means = place_means(&views);
    let (mut x, mut y) = (Vec::new(), Vec::new());
    for view in &views {
        without_motion(view, &means, &mut x, &mut y);
    }
    robust_slope(&x, &y)
}

fn samples(
    view: &Seen,
    rays: &RayGrid,
    white: Option<WhiteLevel>,
    signed_distance: &(impl Fn(&Point3<f64>) -> Option<(f64, Vector3<f64>)> + Sync),
) -> Vec<Sample> {
    let bias = view.bias;
    let eye = view.world_from_camera.translation.vector;
    let sample = |cell: usize| {
        let bounce = bias.measured(cell)?;
        let square = bias.cells().square(cell, STEP_PX);
        let (mut point, mut normal, mut below) = (Vector3::zeros(), Vector3::zeros(), 0.0);
        let (mut n, mut n_pixels) = (0, 0);
        for (u, v) in square.pixels() {
            n_pixels += 1;
            let z = *view.depth_m.at(u, v);
            let here = view.world_from_camera * Point3::from((rays.direction(u, v) * z).cast());
            if z <= 0.0 {
                continue;
            }
            if let Some((distance, gradient)) = signed_distance(&here) {
                point += here.coords;
                normal += gradient;
                below -= distance;
                n += 1;
            }
        }
        if 2 * n < n_pixels {
            return None;
        }
        let point = Point3::from(point / f64::from(n));
        let normal = normal.try_normalize(0.0)?;
        let towards = eye - point.coords;
        let cosine = normal.dot(&towards.try_normalize(0.0)?);
        (cosine >= MIN_COSINE).then(|| Sample {
            place: cell_of(&point, PLACE_M),
            point,
            normal,
            cosine,
            beta_m: bounce.bias_by_strength_m(white) * cosine,
            depth_m: below / f64::from(n),
        })
    };
    (0..bias.cells().n_cells()).filter_map(sample).collect()
}

/// Mean bias at every place that enough views see, those from the front counting more, as they do in fusion.
fn place_means(views: &[Vec<Sample>]) -> BTreeMap<[i32; 3], f64> {
    let mut sums: BTreeMap<[i32; 3], (f64, f64, usize)> = BTreeMap::new();
    for sample in views.iter().flatten() {
        let weight = sample.cosine * sample.cosine;
        let (sum, weights, n) = sums.entry(sample.place).or_default();
        *sum += weight * sample.beta_m;
        *weights += weight;
        *n += 1;
    }
    sums.into_iter()
        .filter(|(_, (.., n))| *n >= MIN_VIEWS)
        .map(|(place, (sum, weights, _))| (place, sum / weights))
        .collect()
}

/// Adds a view's predicted and found differences from the mean, without what a motion of the view explains.
fn without_motion(
    view: &[Sample],
    means: &BTreeMap<[i32; 3], f64>,
    x: &mut Vec<f64>,
    y: &mut Vec<f64>,
) {
    let compared: Vec<(&Sample, f64)> = view
        .iter()
        .filter_map(|sample| Some((sample, sample.beta_m - means.get(&sample.place)?)))
        .collect();
    if compared.len() < MIN_PATCHES {
        return;
    }
    let Some(motion) = motion_of(compared.iter().map(|(sample, _)| *sample)) else {
        return;
    };
    let values = compared
        .iter()
        .map(|(s, predicted)| (*predicted, s.depth_m));
    let (predicted, found): (Vec<f64>, Vec<f64>) = values.unzip();
    x.extend(motion.left_of(&predicted));
    y.extend(motion.left_of(&found));
}

/// How patches of a view hold it against motions; `None` if they do not.
fn motion_of<'a>(
    patches: impl ExactSizeIterator<Item = &'a Sample> + Clone,
) -> Option<MotionEquations> {
    let points = patches.clone().map(|sample| sample.point.coords);
    let middle = points.sum::<Vector3<f64>>() / patches.len() as f64;
    let rows = patches.map(|sample| {
        let row = point_to_plane_row(&(sample.point.coords - middle), &sample.normal);
        (row, 1.0)
    });
    MotionEquations::new(rows.collect(), DAMPING)
}

/// The slope of y over x through the origin, by iteratively reweighted least squares.
fn robust_slope(x: &[f64], y: &[f64]) -> Option<Evidence> {
    let mut slope = 0.0;
    let mut evidence = None;
    for _ in 0..ROUNDS {
        let mut residuals: Vec<f64> = x.iter().zip(y).map(|(x, y)| y - slope * x).collect();
        let scale = median_absolute_deviation(&mut residuals);
        if scale <= 0.0 {
            break;
        }
        let tukey = Tukey {
            scale,
            cutoff: Tukey::EFFICIENT_CUTOFF,
        };
        let (mut xx, mut xy, mut rr, mut weights) = (0.0, 0.0, 0.0, 0.0);
        for (x, y) in x.iter().zip(y) {
            let residual = y - slope * x;
            let weight = tukey.weight(residual) * scale * scale;
            xx += weight * x * x;
            xy += weight * x * y;
            rr += weight * residual * residual;
            weights += weight;
        }
        if xx <= 0.0 {
            break;
        }
        slope = xy / xx;
        evidence = Some(Evidence {
            slope,
            sigma: scale / xx.sqrt(),
            predicted_m: (xx / weights).sqrt(),
            residual_m: (rr / weights).sqrt(),
            n_patches: x.len(),
        });
    }
    evidence
}
