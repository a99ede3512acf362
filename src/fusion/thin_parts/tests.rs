//! A plate of 3 mm, seen from both sides, and curved surfaces far from the world's origin.

use super::*;
use crate::fusion::sampling::tests::volume_of;
use crate::fusion::tests::small_params;
use crate::fusion::{DepthNoise, FusionParams};
use crate::geometry::camera::tests::distorted_camera;
use crate::geometry::{Pose, RayGrid};
use depth_camera::{Image, Sensor};
use nalgebra::{Translation3, UnitQuaternion};
use pulp::Arch;

const THICKNESS_M: f64 = 0.003;
const FRONT_M: f64 = 0.6;

/// Depth (m) of a square plate across the axis at [`FRONT_M`].
fn plate() -> Image<f32> {
    let rays = RayGrid::new(distorted_camera());
    let is_on_plate = |ray: &[f32; 2]| ray.iter().all(|x| (x * FRONT_M as f32).abs() < 0.1);
    let depth = rays.rays().data().iter();
    let depth = depth.map(|ray| {
        if is_on_plate(ray) {
            FRONT_M as f32
        } else {
            0.0
        }
    });
    Image::from_vec(512, 424, depth.collect())
}

/// Fuses the plate from the front and from behind, in turns.
fn fused(params: FusionParams) -> Fusion {
    let noise = DepthNoise::of_sensor(Sensor::Kinect2);
    let mut fusion = Fusion::new(distorted_camera(), noise, params);
    let half_turn = UnitQuaternion::from_euler_angles(0.0, std::f64::consts::PI, 0.0);
    let beyond = Translation3::new(0.0, 0.0, 2.0 * FRONT_M + THICKNESS_M);
    let from_behind = Pose::from_parts(beyond, half_turn);
    let depth = plate();
    for round in 0..4 {
        for (side, pose) in [Pose::identity(), from_behind].iter().enumerate() {
            let time_secs = f64::from(2 * round) + side as f64;
            fusion.fuse_at(&depth, time_secs, pose);
            fusion.remember(None);
        }
    }
    fusion
}

/// How far the plate's vertices lie from the nearer of its sides, away from its rim: the largest, metres.
fn largest_error_m(fusion: &Fusion) -> f64 {
    let vertices = fusion.mesh().vertices;
    let inner = vertices.iter().filter(|v| v.x.abs().max(v.y.abs()) < 0.08);
    let off = inner.map(|v| {
        (v.z - FRONT_M)
            .abs()
            .min((v.z - FRONT_M - THICKNESS_M).abs())
    });
    off.fold(0.0, f64::max)
}

fn params() -> FusionParams {
    FusionParams {
        voxel_size_m: 0.001,
        thin_truncation_voxels: 2.0,
        truncation_voxels: 5.0,
        min_surface_weight: 2.0,
        ..small_params()
    }
}

#[test]
fn a_plate_thinner_than_the_band_is_as_thick_as_it_is() {
    let mut fusion = fused(params());
    let before = largest_error_m(&fusion);
    assert!(before > 0.0015, "{before}");
    let replaced = fusion.separate_thin_parts(&PoseCorrection::default(), &|_| true);
    assert!(replaced > 0);
    let after = largest_error_m(&fusion);
    assert!(after < 0.0002, "{after}");
    let sides: Vec<f64> = fusion
        .mesh()
        .vertices
        .iter()
        .map(|v| v.z - FRONT_M)
        .collect();
    assert!(sides.iter().any(|z| *z < 0.0005) && sides.iter().any(|z| *z > 0.0025));
}

#[test]
fn nothing_is_changed_where_nothing_is_thin_or_nobody_waits() {
    let mut fusion = fused(params());
    let before = fusion.mesh();
    let nowhere = PoseCorrection::default();
    assert_eq!(fusion.separate_thin_parts(&nowhere, &|_| false), 0);
    fusion.params.thin_truncation_voxels = fusion.params.truncation_voxels;
    assert_eq!(fusion.separate_thin_parts(&nowhere, &|_| true), 0);
    assert_eq!(fusion.mesh().vertices, before.vertices);

    // From one side alone it is a surface like any other.
    let mut fusion = fused(params());
    fusion.keyframes.truncate(1);
    assert_eq!(fusion.separate_thin_parts(&nowhere, &|_| true), 0);
    assert_eq!(fusion.mesh().vertices, before.vertices);
}

/// The surface where a distance (m) from the middle is 0, in voxels of 2 mm, about a metre from the world's origin.
fn far_off(distance_m: impl Fn(f64) -> f64) -> TriMesh {
    let volume = volume_of(0.01, |x, y, z| distance_m((x * x + y * y + z * z).sqrt()));
    let mut mesh = marching_cubes::marching_cubes(Arch::new(), &volume, 1.0);
    for vertex in &mut mesh.vertices {
        *vertex += Vector3::new(0.31, -0.22, 0.87);
    }
    mesh
}

#[test]
fn a_curved_shell_is_thin_and_a_ball_is_not_however_far_from_the_origin() {
    let (voxel_size_m, reach_m) = (0.002, 0.01);
    let brick_m = voxel_size_m * BRICK_SIDE as f64;
    // From 15 mm to 19 mm: within a brick the normals turn by 25°.
    let shell = far_off(|radius_m| (radius_m - 0.017).abs() - 0.002);
    let facets = facets(&shell, brick_m);
    assert!(facets.len() > 100, "{}", facets.len());
    // A mean of places in a brick lies in it.
    for Facet { brick, centre, .. } in &facets {
        for axis in 0..3 {
            let in_brick = centre[axis] / brick_m - f64::from(brick[axis]);
            assert!((-1e-9..1.0 + 1e-9).contains(&in_brick), "{in_brick}");
        }
    }
    let thin = bricks_of_thin_parts(&shell, voxel_size_m, reach_m);
    assert!(facets.iter().all(|facet| thin.contains(&facet.brick)));

    let ball = far_off(|radius_m| radius_m - 0.019);
    assert!(bricks_of_thin_parts(&ball, voxel_size_m, reach_m).is_empty());
}

#[test]
fn without_room_for_a_second_volume_the_model_stays() {
    let mut fusion = fused(params());
    let before = fusion.mesh();
    fusion.params.memory_budget_mb = 1;
    assert_eq!(
        fusion.separate_thin_parts(&PoseCorrection::default(), &|_| true),
        0
    );
    assert_eq!(fusion.mesh().vertices, before.vertices);
}
