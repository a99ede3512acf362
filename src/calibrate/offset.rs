//! The shift of a Kinect I's IR image against its depth image, from silhouettes that both show.
//!
//! A silhouette of the depth image at p with the outward normal n is found in the IR image at a distance s along n, with
//! `s = n·o + e`: o is the offset looked for, e the *erosion* by which depth misses the true silhouette, the same on all
//! sides. Edges of several directions part the two, so that neither a fattening window nor a lost border biases o; edges
//! beside the projector's shadow, which lose more, do not count. Each image is fitted alone; the images' median and spread
//! give the estimate and its interval. What all images have in common, such as a limb that the light does not reach, is no
//! spread and may be a few tenths of a pixel more.
//!
//! Not handled: a silhouette on one side only, which cannot part offset from erosion, so that such images do not count; an
//! erosion that differs from side to side; a camera that moved between depth and IR, which shows as spread.

use super::{
    depth_edges::{DepthEdge, depth_edges},
    edge_match::{Brightness, coarse, design},
    estimate::INTERVAL_SIGMAS,
};
use crate::robust::{SIGMAS_PER_DEVIATION, Tukey, median_between};
use depth_camera::Image;
use nalgebra::{Matrix3, Vector3};

/// An edge of the IR image is looked for within this distance of where the fit so far has it, pixels, fit by fit; what is
/// further off does not count in the fit either. Whole pixels and a border of 1 or 2 pixels are in the first reach.
const REACHES_PX: [f64; 6] = [4.0, 3.0, 2.0, 1.5, 1.5, 1.5];
/// An image with fewer matched edges does not count.
const MIN_EDGES_PER_IMAGE: usize = 80;
/// Fewer edges than this in all tell nothing.
const MIN_EDGES: usize = 300;
/// The interval needs a spread.
const MIN_IMAGES: usize = 3;
/// An interval wider than this, from end to end, is no measurement, pixels.
const MAX_INTERVAL_PX: f64 = 1.0;
/// Least information on offset and erosion per edge: 0.5 for a circle, 0 for edges of one side.
const MIN_CONDITIONING: f64 = 0.02;

/// What one image says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageOffset {
    /// How far right of and below its place in the depth image a point lies in the IR image, pixels.
    pub offset_px: [f64; 2],
    /// How far outside the depth's silhouettes the true ones lie, pixels.
    pub erosion_px: f64,
    /// Edges that were found in both images.
    pub n_edges: usize,
}

/// What all images say.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OffsetEstimate {
    /// How far right of and below its place in the depth image a point lies in the IR image, pixels.
    pub offset_px: [f64; 2],
    /// Half the interval of 95 % confidence of each, pixels.
    pub half_interval_px: [f64; 2],
    /// How far outside the depth's silhouettes the true ones lie, pixels.
    pub erosion_px: f64,
    /// Edges that were found in both images.
    pub n_edges: usize,
    /// Images that had enough of them.
    pub n_images: usize,
}

/// Why the images do not tell the offset.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum OffsetError {
    /// Too few silhouettes that IR shows too.
    #[error(
        "{n_edges} edges of depth are found in the IR images, must be at least {MIN_EDGES}: the scene needs an object that \
         stands free before its background, in contrast to it"
    )]
    FewEdges {
        /// Edges found in both images.
        n_edges: usize,
    },
    /// Too few images for a spread.
    #[error(
        "{n_images} different images have {MIN_EDGES_PER_IMAGE} edges on several sides, must be at least {MIN_IMAGES} for an interval"
    )]
    FewImages {
        /// Images with enough edges, without copies of others.
        n_images: usize,
    },
    /// The images disagree.
    #[error(
        "the data cannot tell: the offset would be ({:.2} ± {:.2}, {:.2} ± {:.2}) px, the interval must be at most \
         {MAX_INTERVAL_PX} px wide", .0.offset_px[0], .0.half_interval_px[0], .0.offset_px[1], .0.half_interval_px[1]
    )]
    Undecided(OffsetEstimate),
}

/// The offset between a depth image (metres, 0 is none) and an IR image (counts, response not removed) from the same pose;
/// `None` where too few silhouettes are seen in both, or all on one side.
pub fn image_offset(
    depth_m: &Image<f32>,
    ir_counts: &Image<f32>,
    full_scale: f64,
) -> Option<ImageOffset> {
    let edges = depth_edges(depth_m);
    if edges.len() < MIN_EDGES_PER_IMAGE {
        return None;
    }
    let brightness = Brightness::new(ir_counts, full_scale);
    let mut fit = Vector3::zeros();
    fit.fixed_rows_mut::<2>(0)
        .copy_from(&coarse(&edges, &brightness));
    let mut n_edges = 0;
    for reach_px in REACHES_PX {
        let matches: Vec<_> = edges
            .iter()
            .filter_map(|edge| Some((*edge, brightness.edge_near(edge, &fit, reach_px)?)))
            .collect();
        (fit, n_edges) = refit(&matches, &fit, reach_px)?;
    }
    (n_edges >= MIN_EDGES_PER_IMAGE).then_some(ImageOffset {
        offset_px: [fit.x, fit.y],
        erosion_px: fit.z,
        n_edges,
    })
}

/// The offset that the images agree on.
///
/// # Errors
/// If there are too few edges or images, or they disagree, each with the figure that shows it.
pub fn combine_offsets(images: &[ImageOffset]) -> Result<OffsetEstimate, OffsetError> {
    // Copies of one image agree without being right: a spread of 0 is none.
    let mut distinct: Vec<ImageOffset> = Vec::new();
    for image in images {
        if !distinct.contains(image) {
            distinct.push(*image);
        }
    }
    let n_edges = distinct.iter().map(|image| image.n_edges).sum();
    if n_edges < MIN_EDGES {
        return Err(OffsetError::FewEdges { n_edges });
    }
    let n_images = distinct.len();
    if n_images < MIN_IMAGES {
        return Err(OffsetError::FewImages { n_images });
    }
    let of = |value: fn(&ImageOffset) -> f64| median_with_interval(distinct.iter().map(value));
    let (right, down) = (
        of(|image| image.offset_px[0]),
        of(|image| image.offset_px[1]),
    );
    let estimate = OffsetEstimate {
        offset_px: [right.0, down.0],
        half_interval_px: [right.1, down.1],
        erosion_px: of(|image| image.erosion_px).0,
        n_edges,
        n_images,
    };
    match right.1.max(down.1) * 2.0 > MAX_INTERVAL_PX {
        true => Err(OffsetError::Undecided(estimate)),
        false => Ok(estimate),
    }
}

/// Standard error of the median of Gaussian values over that of their mean: √(π/2).
const MEDIAN_OVER_MEAN_ERROR: f64 = 1.2533;

/// The median and half its interval of 95 % confidence: 1.96 standard errors of a median, whose deviation comes from the
/// median deviation, widened for few values as Student's distribution is.
fn median_with_interval(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let mut values: Vec<f64> = values.collect();
    let middle = median_between(&mut values).expect("there are enough images");
    let n = values.len() as f64;
    let mut deviations: Vec<f64> = values.iter().map(|value| (value - middle).abs()).collect();
    let deviation = median_between(&mut deviations).expect("there are enough images");
    let sigma = SIGMAS_PER_DEVIATION * deviation;
    let few = 1.0 + 3.0 / (n - 1.0);
    (
        middle,
        INTERVAL_SIGMAS * few * MEDIAN_OVER_MEAN_ERROR * sigma / n.sqrt(),
    )
}

/// One step of the robust fit of offset and erosion to the distances of the matches, and the matches that count in it;
/// `None` where the edges' directions do not part the three.
///
/// The weights are Tukey's, of the constant `reach_px`.
fn refit(
    matches: &[(DepthEdge, f64)],
    from: &Vector3<f64>,
    reach_px: f64,
) -> Option<(Vector3<f64>, usize)> {
    let loss = Tukey {
        scale: 1.0,
        cutoff: reach_px,
    };
    let (mut jtj, mut jtr) = (Matrix3::zeros(), Vector3::zeros());
    let (mut sum_weights, mut n_used) = (0.0, 0);
    for (edge, distance) in matches {
        let row = design(edge);
        let weight = loss.weight(distance - row.dot(from));
        if weight == 0.0 {
            continue;
        }
        jtj += row * row.transpose() * weight;
        jtr += row * (weight * distance);
        sum_weights += weight;
        n_used += 1;
    }
    let smallest = jtj.symmetric_eigenvalues().min();
    if smallest.is_nan() || smallest < MIN_CONDITIONING * sum_weights || n_used == 0 {
        return None;
    }
    Some((jtj.cholesky()?.solve(&jtr), n_used))
}

#[cfg(test)]
mod tests {
    use super::*;
    use depth_camera::{DepthCamera, Sensor};
    use simulated::{Infrared, Scene, Setup, SimulatedCamera, Trajectory};
    use std::time::Duration;

    /// What images of the plaque and its props say, taken with an IR image that lies elsewhere.
    fn simulated(offset_px: [f64; 2], n_images: usize) -> Vec<ImageOffset> {
        let scene = Scene::plaque();
        let (low, high) = scene.object_bounds();
        let mut camera = SimulatedCamera::new(Setup {
            trajectory: Trajectory::hand_held(nalgebra::center(&low, &high), 24),
            scene,
            sensor: Sensor::Kinect2,
            infrared: Infrared {
                offset_px,
                ..Infrared::of_sensor(Sensor::Kinect2)
            },
            n_moving_frames: n_images,
            shading_frames: Vec::new(),
            reduction: 1,
            seed: 3,
        })
        .unwrap();
        let frames = std::iter::from_fn(|| camera.grab(Duration::ZERO).unwrap());
        let offsets = frames.filter_map(|frame| {
            let ir = frame.ir.unwrap().map(|&counts| f32::from(counts));
            image_offset(&frame.depth.unwrap(), &ir, 65535.0)
        });
        offsets.collect()
    }

    #[test]
    fn a_known_offset_is_found_to_a_fraction_of_a_pixel() {
        for truth in [[0.0, 0.0], [5.0, 4.0], [-3.4, 1.7]] {
            let estimate = combine_offsets(&simulated(truth, 3)).unwrap();
            for axis in 0..2 {
                let error = estimate.offset_px[axis] - truth[axis];
                assert!(error.abs() < 0.3, "{truth:?}: {estimate:?}");
            }
            assert_eq!(estimate.n_images, 3);
        }
    }

    fn image(right: f64, n_edges: usize) -> ImageOffset {
        ImageOffset {
            offset_px: [right, 4.0],
            erosion_px: 0.5,
            n_edges,
        }
    }

    #[test]
    fn what_the_images_cannot_tell_is_refused_with_its_figure() {
        assert_eq!(
            combine_offsets(&[image(5.0, 100), image(5.1, 100), image(5.0, 100)]),
            Err(OffsetError::FewEdges { n_edges: 200 })
        );
        assert_eq!(
            combine_offsets(&[image(5.0, 900)]),
            Err(OffsetError::FewImages { n_images: 1 })
        );
        let copies = [image(5.0, 150), image(5.1, 150), image(5.0, 150)];
        assert_eq!(
            combine_offsets(&copies),
            Err(OffsetError::FewImages { n_images: 2 })
        );
        let scattered = [3.0, 4.0, 5.0, 6.0, 7.0].map(|right| image(right, 100));
        let error = combine_offsets(&scattered).unwrap_err().to_string();
        // A median deviation of 1 px of five: 1.96 · 1.75 · 1.2533 · 1.4826 / √5.
        assert!(
            error.contains("cannot tell: the offset would be (5.00 ± 2.85, 4.00 ± 0.00) px"),
            "{error}"
        );
    }

    #[test]
    fn edges_on_one_side_do_not_part_offset_from_erosion() {
        let edge = |v: f64| DepthEdge {
            place: nalgebra::Point2::new(50.0, v),
            outward: nalgebra::Vector2::x(),
        };
        let matches: Vec<_> = (0..100).map(|v| (edge(f64::from(v)), 1.0)).collect();
        assert_eq!(refit(&matches, &Vector3::zeros(), 4.0), None);
    }
}
