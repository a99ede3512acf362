//! How far a mesh is from the truth: distance, normals, and detail, after the best rigid alignment.
//!
//! Detail is the signed distance with its mean over a radius of 8 mm taken off: what is left shows relief and noise, but not
//! slow drift. Compared is what some camera saw, away from the borders of the truth and of the box.

use super::surface_samples::{Oriented, sample};
use super::truth::Truth;
use crate::geometry::{
    CameraModel, PointGrid, Pose, TriMesh, TriangleBvh, increment, point_to_plane_row,
};
use crate::robust::median;
use nalgebra::{Matrix6, Point3, Vector3, Vector6};
use rayon::prelude::*;
use serde::Serialize;

/// Points taken from the mesh.
const N_SAMPLES: usize = 150_000;
/// Points taken from the truth for completeness.
const N_TRUTH_SAMPLES: usize = 40_000;
/// Radius of the surroundings that detail is measured against, metres.
const DETAIL_RADIUS_M: f64 = 0.008;
/// The share of details left out as outliers.
const DETAIL_OUTLIERS: f64 = 0.01;
/// A mesh reaches this far beyond the box before it is cut, metres.
const AIR_M: f64 = 0.03;
/// Farther from the truth than this a point is no part of it, metres.
const MAX_DISTANCE_M: f64 = 0.01;
/// Points this near take part in the alignment at first, metres.
const START_REACH_M: f64 = 0.02;
/// A truth that is wider than this is hardly in metres: it is more than a room.
const MAX_WIDTH_M: f64 = 20.0;
/// Truth with surface nearer than this is complete, metres.
const COMPLETE_M: f64 = 0.002;

/// The cameras of a scan.
#[derive(Clone, Copy, Debug)]
pub struct Cameras<'a> {
    /// The camera.
    pub model: &'a CameraModel,
    /// Where it was, in the scan's world.
    pub world_from_cameras: &'a [Pose],
    /// Where the scan's world lies in the frame of the truth, to a centimetre.
    pub truth_from_world: Pose,
}

/// How far a mesh is from the truth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SurfaceError {
    /// Points compared.
    pub n_points: usize,
    /// Mean distance to the truth, metres.
    pub mean_m: f64,
    /// Median distance, metres.
    pub median_m: f64,
    /// Root mean square distance, metres.
    pub rms_m: f64,
    /// Mean angle between normals, radians.
    pub normal_mean_rad: f64,
    /// Median angle between normals, radians.
    pub normal_median_rad: f64,
    /// Root mean square detail, metres.
    pub detail_rms_m: f64,
    /// Share of the truth that was seen and has surface within 2 mm.
    pub completeness: f64,
}

/// Why nothing was compared.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum SurfaceErrorFailure {
    /// The mesh is elsewhere.
    #[error(
        "only {n_near} of the {n_points} points of the mesh in the box lie within {:.0} mm of the truth, at least 100 must: are \
         its pose and box right?",
        1000.0 * START_REACH_M
    )]
    Elsewhere {
        /// Points near the truth.
        n_near: usize,
        /// All points in the box.
        n_points: usize,
    },
    /// Nothing of the mesh is near the truth, as where one is in millimetres.
    #[error(
        "none of the {n_points} points of the mesh in the box lies near the truth, which is {width_m:.3} m wide: is it in metres, \
         and are its pose and box right?"
    )]
    OtherUnits {
        /// All points in the box.
        n_points: usize,
        /// The longest side of the truth, metres.
        width_m: f64,
    },
    /// No camera saw what is to be compared.
    #[error(
        "none of the {n_points} points of the mesh lies on truth that a camera saw: its pose or box is wrong, or its faces are \
         turned inside out"
    )]
    Unseen {
        /// All points in the box.
        n_points: usize,
    },
}

/// Compares a mesh of a scan's world with the truth.
///
/// # Errors
/// If the mesh is not near the truth, or no camera saw that part of it.
pub fn surface_error(
    truth: &Truth,
    mesh: &TriMesh,
    cameras: &Cameras,
) -> Result<SurfaceError, SurfaceErrorFailure> {
    let mut moved = moved(mesh, &cameras.truth_from_world);
    let inside = |vertex: &u32| truth.contains(&moved.vertices[*vertex as usize], AIR_M);
    let normals = moved.vertex_normals();
    let samples = sample(&moved, &normals, N_SAMPLES, |face| face.iter().all(inside));
    let near: Vec<Point3<f64>> = samples
        .par_iter()
        .filter(|(point, _)| truth.closest(point, START_REACH_M).is_some())
        .map(|(point, _)| *point)
        .collect();
    if near.len() < 100 {
        return Err(elsewhere(near.len(), samples.len(), truth.width_m()));
    }
    let every_fifth: Vec<_> = near.into_iter().step_by(5).collect();
    let aligned = align(truth, &every_fifth);
    moved
        .vertices
        .iter_mut()
        .for_each(|vertex| *vertex = aligned * *vertex);
    let poses: Vec<Pose> = cameras
        .world_from_cameras
        .iter()
        .map(|pose| aligned * cameras.truth_from_world * pose)
        .collect();
    let compared: Vec<Compared> = samples
        .par_iter()
        .filter_map(|(point, normal)| {
            let sample = (aligned * point, aligned * normal);
            compare(truth, &sample, cameras.model, &poses)
        })
        .collect();
    if compared.is_empty() {
        let n_points = samples.len();
        return Err(SurfaceErrorFailure::Unseen { n_points });
    }
    let completeness = completeness(truth, &moved, cameras.model, &poses);
    Ok(figures(&compared, completeness))
}

/// Why a mesh of so many points, of which so few are near the truth, is not compared.
fn elsewhere(n_near: usize, n_points: usize, width_m: f64) -> SurfaceErrorFailure {
    match n_near == 0 && width_m > MAX_WIDTH_M {
        true => SurfaceErrorFailure::OtherUnits { n_points, width_m },
        false => SurfaceErrorFailure::Elsewhere { n_near, n_points },
    }
}

fn moved(mesh: &TriMesh, pose: &Pose) -> TriMesh {
    TriMesh {
        vertices: mesh.vertices.iter().map(|vertex| pose * vertex).collect(),
        faces: mesh.faces.clone(),
    }
}

/// One point that is compared.
struct Compared {
    point: Point3<f64>,
    distance_m: f64,
    /// Along the truth's normal.
    signed_m: f64,
    angle_rad: f64,
}

fn compare(
    truth: &Truth,
    (point, normal): &Oriented,
    camera: &CameraModel,
    truth_from_cameras: &[Pose],
) -> Option<Compared> {
    let closest = truth.closest(point, MAX_DISTANCE_M)?;
    let cosine = normal.dot(&closest.normal);
    let counts = cosine > 0.0
        && truth.counts(&closest.point)
        && truth.is_seen(&closest.point, &closest.normal, camera, truth_from_cameras);
    counts.then(|| Compared {
        point: *point,
        distance_m: closest.distance_m,
        signed_m: (point - closest.point).dot(&closest.normal),
        angle_rad: cosine.min(1.0).acos(),
    })
}

/// The rigid motion that brings points onto the truth: point to plane, iterated, robust beyond 2 mm.
fn align(truth: &Truth, points: &[Point3<f64>]) -> Pose {
    const ITERATIONS: usize = 30;
    const ROBUST_M: f64 = 0.002;
    let mut aligned = Pose::identity();
    for _ in 0..ITERATIONS {
        let rows: Vec<Option<(Vector6<f64>, f64, f64)>> = points
            .par_iter()
            .map(|point| {
                let moved = aligned * point;
                let closest = truth.closest(&moved, MAX_DISTANCE_M)?;
                let residual = (moved - closest.point).dot(&closest.normal);
                let weight = 1.0 / (1.0 + (residual / ROBUST_M).powi(2));
                let row = point_to_plane_row(&moved.coords, &closest.normal);
                Some((row, residual, weight))
            })
            .collect();
        let (mut jtj, mut jtr) = (Matrix6::identity() * 1e-9, Vector6::zeros());
        for (row, residual, weight) in rows.into_iter().flatten() {
            jtj += row * row.transpose() * weight;
            jtr += row * (residual * weight);
        }
        let Some(step) = jtj.cholesky().map(|factor| factor.solve(&-jtr)) else {
            break;
        };
        aligned = increment(&step) * aligned;
        if step.amax() < 1e-7 {
            break;
        }
    }
    aligned
}

fn completeness(
    truth: &Truth,
    mesh: &TriMesh,
    camera: &CameraModel,
    truth_from_cameras: &[Pose],
) -> f64 {
    let bvh = TriangleBvh::new(mesh);
    let all = sample(truth.mesh(), truth.normals(), N_TRUTH_SAMPLES, |_| true);
    let there: Vec<bool> = all
        .par_iter()
        .filter(|(point, normal): &&(Point3<f64>, Vector3<f64>)| {
            truth.counts(point) && truth.is_seen(point, normal, camera, truth_from_cameras)
        })
        .map(|(point, _)| bvh.closest_point(point, COMPLETE_M).is_some())
        .collect();
    there.iter().filter(|&&there| there).count() as f64 / there.len().max(1) as f64
}

fn figures(compared: &[Compared], completeness: f64) -> SurfaceError {
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
    let root_mean_square =
        |values: &[f64]| mean(&values.iter().map(|x| x * x).collect::<Vec<_>>()).sqrt();
    // A copy, since its order changes, and sums go by it.
    let median = |values: &[f64]| median(&mut values.to_vec()).unwrap_or(0.0);
    let distances: Vec<f64> = compared.iter().map(|point| point.distance_m).collect();
    let angles: Vec<f64> = compared.iter().map(|point| point.angle_rad).collect();
    SurfaceError {
        n_points: compared.len(),
        mean_m: mean(&distances),
        median_m: median(&distances),
        rms_m: root_mean_square(&distances),
        normal_mean_rad: mean(&angles),
        normal_median_rad: median(&angles),
        detail_rms_m: root_mean_square(&details(compared)),
        completeness,
    }
}

/// Signed distances less their mean nearby, but for the largest. Of fewer points the tail that is left would differ by per cents.
fn details(compared: &[Compared]) -> Vec<f64> {
    let points = compared.iter().map(|point| point.point).collect();
    let grid = PointGrid::new(points, DETAIL_RADIUS_M);
    let mut details: Vec<f64> = compared
        .par_iter()
        .map(|centre| {
            let near = grid
                .near(&centre.point)
                .map(|index| compared[index].signed_m);
            let (sum, n) = near.fold((0.0, 0.0), |(sum, n), signed| (sum + signed, n + 1.0));
            centre.signed_m - sum / n
        })
        .collect();
    details.sort_unstable_by(|a, b| a.abs().total_cmp(&b.abs()));
    details.truncate(details.len() - (details.len() as f64 * DETAIL_OUTLIERS) as usize);
    details
}

#[cfg(test)]
mod tests {
    use super::*;
    use depth_camera::Intrinsics;

    const SIDE: usize = 161;

    /// A square of 0.16 m, 0.6 m away, with waves of a given height and length, on a grid of 1 mm.
    fn waves(height_m: f64, length_m: f64) -> TriMesh {
        let at = |k: usize| 0.001 * k as f64 - 0.08;
        let k = 2.0 * std::f64::consts::PI / length_m;
        let depth = |x: f64| 0.6 + height_m * (k * x).sin();
        let vertices = (0..SIDE * SIDE)
            .map(|i| (at(i % SIDE), at(i / SIDE)))
            .map(|(x, y)| Point3::new(x, y, depth(x) + 0.01 * (30.0 * y).sin() * (20.0 * x).cos()))
            .collect();
        let faces = (0..(SIDE - 1) * (SIDE - 1))
            .map(|i| (i / (SIDE - 1) * SIDE + i % (SIDE - 1)) as u32)
            .flat_map(|a| {
                let (b, c) = (a + 1, a + SIDE as u32);
                [[a, c, b], [b, c, c + 1]]
            })
            .collect();
        TriMesh { vertices, faces }
    }

    fn camera() -> CameraModel {
        CameraModel::new(Intrinsics {
            width: 512,
            height: 424,
            fx: 365.0,
            fy: 365.0,
            cx: 255.5,
            cy: 211.5,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
        })
    }

    fn error(mesh: &TriMesh, truth_from_world: Pose) -> Result<SurfaceError, SurfaceErrorFailure> {
        let truth = Truth::new(waves(0.0, 1.0), None);
        let model = camera();
        let cameras = Cameras {
            model: &model,
            world_from_cameras: &[truth_from_world.inverse()],
            truth_from_world,
        };
        surface_error(&truth, mesh, &cameras)
    }

    #[test]
    fn a_moved_truth_has_no_error() {
        let motion = increment(&Vector6::new(0.01, -0.02, 0.015, 0.004, 0.003, -0.005));
        let moved = moved(&waves(0.0, 1.0), &motion);
        // The start is off by half a degree and a few millimetres more.
        let start = increment(&Vector6::new(0.005, 0.0, -0.004, 0.002, -0.003, 0.001));
        let error = error(&moved, start * motion.inverse()).unwrap();
        assert!(error.mean_m < 2e-5, "{error:?}");
        assert!(
            error.detail_rms_m < 1e-5 && error.normal_mean_rad < 2e-3,
            "{error:?}"
        );
        assert!(
            error.completeness > 0.99 && error.n_points > 100_000,
            "{error:?}"
        );
    }

    #[test]
    fn short_waves_are_detail_and_long_ones_are_not() {
        // A sine of height h has the root mean square h/√2, cut by chords to that times √((2 + cos φ)/3) at steps of φ; a wave
        // of 5 mm averages out over a disc of 8 mm.
        let short = error(&waves(0.0003, 0.005), Pose::identity()).unwrap();
        let chords = ((2.0 + (2.0 * std::f64::consts::PI / 5.0).cos()) / 3.0).sqrt();
        let expected = 0.0003 / 2f64.sqrt() * chords;
        assert!(
            (short.detail_rms_m / expected - 1.0).abs() < 0.08,
            "{short:?}"
        );
        assert!((short.rms_m / expected - 1.0).abs() < 0.04, "{short:?}");
        let long = error(&waves(0.0003, 0.08), Pose::identity()).unwrap();
        assert!(long.rms_m > 0.6 * expected, "{long:?}");
        assert!(long.detail_rms_m < 0.15 * expected, "{long:?}");
    }

    /// What the recorded sessions' scoring script said of these meshes, as PLY, against [`waves`] of no height, whose box it was given 3 mm
    /// wider; means of eight of its samplings, which scatter by 0.4 %: mean, median, root mean square distance and detail in millimetres, mean and median normals in degrees, and completeness.
    #[test]
    fn figures_are_within_two_per_cent_of_the_scoring_script() {
        let mut broken = waves(0.0005, 0.012);
        broken.faces.drain(..2 * 40 * (SIDE - 1));
        let scored = [
            (
                waves(0.0003, 0.005),
                [0.16383, 0.18297, 0.18281, 0.17947, 8.81498, 9.6237, 1.0],
            ),
            (
                broken,
                [
                    0.30301, 0.33043, 0.33762, 0.35388, 8.71243, 9.62256, 0.78523,
                ],
            ),
            (
                waves(0.001, 0.03),
                [0.62027, 0.68474, 0.68863, 0.21104, 7.31437, 8.12423, 1.0],
            ),
        ];
        for (mesh, scored) in scored {
            let error = error(&mesh, Pose::identity()).unwrap();
            let measured = [
                1e3 * error.mean_m,
                1e3 * error.median_m,
                1e3 * error.rms_m,
                1e3 * error.detail_rms_m,
                error.normal_mean_rad.to_degrees(),
                error.normal_median_rad.to_degrees(),
                error.completeness,
            ];
            for (measured, scored) in measured.iter().zip(scored) {
                assert!((measured / scored - 1.0).abs() < 0.02, "{error:?}");
            }
        }
    }

    #[test]
    fn what_is_elsewhere_or_unseen_is_not_compared() {
        let away = increment(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.5));
        let told = error(&waves(0.0, 1.0), away).unwrap_err().to_string();
        let expected = "only 0 of the 0 points of the mesh in the box";
        assert!(told.starts_with(expected), "{told}");
        // In the box with its air, and farther off than points that take part.
        let aside = increment(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.025));
        let result = error(&waves(0.0, 1.0), aside);
        assert!(matches!(result, Err(SurfaceErrorFailure::Elsewhere { .. })));
        let truth = Truth::new(waves(0.0, 1.0), None);
        let model = camera();
        let behind = increment(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 2.0));
        let cameras = Cameras {
            model: &model,
            world_from_cameras: &[behind],
            truth_from_world: Pose::identity(),
        };
        let result = surface_error(&truth, &waves(0.0, 1.0), &cameras);
        assert!(matches!(result, Err(SurfaceErrorFailure::Unseen { .. })));
    }

    #[test]
    fn a_truth_as_wide_as_a_hall_is_asked_for_its_unit_where_nothing_is_near() {
        use SurfaceErrorFailure::{Elsewhere, OtherUnits};
        assert!(matches!(elsewhere(0, 500, 150.0), OtherUnits { .. }));
        assert!(matches!(elsewhere(1, 500, 150.0), Elsewhere { .. }));
        assert!(matches!(elsewhere(0, 500, 0.15), Elsewhere { .. }));
    }
}
