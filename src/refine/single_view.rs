//! A surface from one depth map and its infrared image, for refinement without fusion.
//!
//! Depth is smoothed by a joint bilateral filter (Petschnigg et al. 2004): a neighbour counts by its distance on the image, by its
//! difference in depth, and by its difference in albedo, so that depth is not averaged over the border of two things. The guide
//! is the infrared image with its shading taken off: the image itself falls off with distance and with the slope, and would
//! print both into the depth. Albedo needs normals, which come from a first pass without a guide. Neighbouring pixels are joined
//! to triangles unless the surface between them would be seen at more than 80°, where depth jumps.
//!
//! Not handled: noise of the depth that goes together over more pixels than the filter reaches.

use super::optics::Optics;
use crate::fusion::DepthNoise;
use crate::geometry::TriMesh;
use crate::shading::{SATURATION, linearise};
use crate::snapshot::ShadingSnapshot;
use depth_camera::Image;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// Reach of the filter, pixels.
const REACH: isize = 4;
/// Standard deviation of the weight by distance, pixels.
const SPATIAL_PX: f64 = 2.0;
/// Standard deviation of the weight by depth, metres: three times the noise of a Kinect at 0.6 m.
const DEPTH_M: f64 = 0.005;
/// The same in standard deviations of the depth, where these are more: beyond 0.9 m with a Kinect I, 1.9 m with a Kinect II.
const DEPTH_SIGMAS: f64 = 3.0;
/// Standard deviation of the weight by the logarithm of albedo; materials differ by more, noise by less.
const LOG_ALBEDO: f64 = 0.15;
/// Tangent of the angle of incidence beyond which neighbours are not joined: 80°.
const MAX_SLOPE: f64 = 5.67;

/// The surface that a depth map shows, world frame; empty where there is no depth.
pub fn surface_of_view(snapshot: &ShadingSnapshot, optics: &Optics) -> TriMesh {
    let flat = Image::filled(snapshot.depth_m.width(), snapshot.depth_m.height(), 0.0f32);
    let rough = filtered(&snapshot.depth_m, &flat, &optics.depth_noise);
    let guide = log_albedo(snapshot, &rough, optics);
    let depth_m = filtered(&snapshot.depth_m, &guide, &optics.depth_noise);
    let camera = meshed(&depth_m, optics);
    TriMesh {
        vertices: camera
            .vertices
            .iter()
            .map(|vertex| snapshot.world_from_camera * vertex)
            .collect(),
        faces: camera.faces,
    }
}

/// Joint bilateral filter: depth (0 is none) by a guide in logarithms, of which NaN tells nothing.
fn filtered(depth_m: &Image<f32>, guide: &Image<f32>, noise: &DepthNoise) -> Image<f32> {
    let (width, height) = (depth_m.width(), depth_m.height());
    let falloff = |difference: f64, sigma: f64| (-0.5 * (difference / sigma).powi(2)).exp();
    let spatial: Vec<f64> = (0..=REACH).map(|d| falloff(d as f64, SPATIAL_PX)).collect();
    let pixel = |u: usize, v: usize| {
        let (centre, own) = (*depth_m.at(u, v), *guide.at(u, v));
        if centre <= 0.0 {
            return 0.0;
        }
        let depth_sigma_m = DEPTH_M.max(DEPTH_SIGMAS * f64::from(noise.sigma_m(centre)));
        let (mut sum, mut weights) = (0.0, 0.0);
        for dv in -REACH..=REACH {
            for du in -REACH..=REACH {
                let (Some(x), Some(y)) = (u.checked_add_signed(du), v.checked_add_signed(dv))
                else {
                    continue;
                };
                if x >= width || y >= height || *depth_m.at(x, y) <= 0.0 {
                    continue;
                }
                let other = f64::from(*depth_m.at(x, y));
                let unlike = f64::from(guide.at(x, y) - own);
                let by_albedo = if unlike.is_finite() {
                    falloff(unlike, LOG_ALBEDO)
                } else {
                    1.0
                };
                let weight = spatial[du.unsigned_abs()]
                    * spatial[dv.unsigned_abs()]
                    * falloff(other - f64::from(centre), depth_sigma_m)
                    * by_albedo;
                sum += weight * other;
                weights += weight;
            }
        }
        (sum / weights) as f32
    };
    let pixels = (0..width * height)
        .into_par_iter()
        .map(|index| pixel(index % width, index / width));
    Image::from_vec(width, height, pixels.collect())
}

/// Logarithm of the albedo that every pixel has if the surface is as given; NaN where that is not known.
fn log_albedo(snapshot: &ShadingSnapshot, depth_m: &Image<f32>, optics: &Optics) -> Image<f32> {
    let linear = linearise(
        &snapshot.lit_counts(optics.full_scale, optics.calibration.gamma),
        optics.full_scale,
        SATURATION,
        optics.calibration,
        &optics.flat_image(),
    );
    let (width, height) = (depth_m.width(), depth_m.height());
    let at = |u: usize, v: usize| point(depth_m, u, v, optics);
    let albedo = |u: usize, v: usize| {
        if u == 0 || v == 0 || u + 1 == width || v + 1 == height {
            return None;
        }
        let right = at(u + 1, v)? - at(u - 1, v)?;
        let down = at(u, v + 1)? - at(u, v - 1)?;
        let normal = down.cross(&right).try_normalize(0.0)?;
        let irradiance = optics.light.irradiance(&at(u, v)?, &normal);
        let value = f64::from(*linear.value.at(u, v));
        (irradiance > 0.0 && value > 0.0).then(|| (value / irradiance).ln() as f32)
    };
    let pixels = (0..width * height)
        .into_par_iter()
        .map(|index| albedo(index % width, index / width).unwrap_or(f32::NAN));
    Image::from_vec(width, height, pixels.collect())
}

/// The point of a pixel, camera frame; `None` without depth.
fn point(depth_m: &Image<f32>, u: usize, v: usize, optics: &Optics) -> Option<Point3<f64>> {
    let z = f64::from(*depth_m.at(u, v));
    let [x, y] = optics.rays.rays().at(u, v).map(f64::from);
    (z > 0.0).then(|| Point3::from(Vector3::new(x, y, 1.0) * z))
}

/// Neighbouring pixels joined to triangles, counter-clockwise seen from the camera, cut where depth jumps.
fn meshed(depth_m: &Image<f32>, optics: &Optics) -> TriMesh {
    let (width, height) = (depth_m.width(), depth_m.height());
    let mut vertex_of = vec![u32::MAX; width * height];
    let mut mesh = TriMesh::default();
    for v in 0..height {
        for u in 0..width {
            if let Some(point) = point(depth_m, u, v, optics) {
                vertex_of[v * width + u] = mesh.vertices.len() as u32;
                mesh.vertices.push(point);
            }
        }
    }
    let focal_px = optics.rays.camera().intrinsics().fx;
    let joined = |a: u32, b: u32| {
        let (near, far) = (mesh.vertices[a as usize].z, mesh.vertices[b as usize].z);
        (near - far).abs() < MAX_SLOPE * near.min(far) / focal_px
    };
    let whole = |face: &[u32; 3]| {
        face.iter().all(|&vertex| vertex != u32::MAX)
            && (0..3).all(|corner| joined(face[corner], face[(corner + 1) % 3]))
    };
    let mut faces = Vec::new();
    for v in 0..height.saturating_sub(1) {
        for u in 0..width.saturating_sub(1) {
            let corner = |du: usize, dv: usize| vertex_of[(v + dv) * width + u + du];
            let (a, b, c, d) = (corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1));
            // Whichever diagonal leaves more of the square.
            let ways = [[[a, c, d], [a, d, b]], [[a, c, b], [b, c, d]]];
            let best = ways.map(|way| way.into_iter().filter(whole).collect::<Vec<_>>());
            let [first, second] = best;
            faces.extend(if second.len() > first.len() {
                second
            } else {
                first
            });
        }
    }
    mesh.faces = faces;
    // Pixels without a triangle are no surface.
    mesh.filter_faces(|_| true)
}

#[cfg(test)]
mod tests {
    use super::super::scenes::{FULL_SCALE, RippledPlane, calibration, optics, poses, rays};
    use super::super::{RefineParams, Subject, refine};
    use super::*;
    use depth_camera::Sensor;

    const RIPPLED: RippledPlane = RippledPlane {
        amplitude_m: 0.0003,
    };

    /// What a camera sees of the rippled plane, its depth with noise of 1 mm.
    fn noisy(optics: &Optics) -> ShadingSnapshot {
        let mut snapshot = RIPPLED.snapshot(optics, &poses(0.4)[1]);
        for (k, depth) in snapshot.depth_m.data_mut().iter_mut().enumerate() {
            *depth += 0.0035 * (((k as f32) * 0.618_034).fract() - 0.5);
        }
        snapshot
    }

    /// Mean angle to the true normals in the middle, radians.
    fn normal_error(mesh: &TriMesh) -> f64 {
        let pairs = mesh.vertices.iter().zip(mesh.vertex_normals());
        let inner = pairs.filter(|(p, _)| p.x.abs() < 0.03 && p.y.abs() < 0.03);
        let angles: Vec<f64> = inner
            .map(|(p, n)| n.angle(&RIPPLED.normal(p.x, p.y)))
            .collect();
        assert!(angles.len() > 500);
        angles.iter().sum::<f64>() / angles.len() as f64
    }

    #[test]
    fn one_noisy_view_is_filtered_meshed_and_refined() {
        let (rays, calibration) = (rays(), calibration());
        let optics = optics(&rays, &calibration);
        let snapshot = noisy(&optics);
        let surface = surface_of_view(&snapshot, &optics);
        let mut raw = meshed(&snapshot.depth_m, &optics);
        let to_world = |vertex: &mut Point3<f64>| *vertex = snapshot.world_from_camera * *vertex;
        raw.vertices.iter_mut().for_each(to_world);
        let (unfiltered, filtered) = (normal_error(&raw), normal_error(&surface));
        assert!(
            filtered < 0.4 * unfiltered,
            "{unfiltered} to {filtered} rad"
        );
        let snapshots = [snapshot];
        let subject = Subject {
            scene: &surface,
            object: &surface,
            snapshots: &snapshots,
            optics: &optics,
        };
        let refined = refine(&subject, &RefineParams::default(), |_| true).expect("visible");
        let after = normal_error(&refined.mesh);
        assert!(after < 0.9 * filtered, "{filtered} to {after} rad");
    }

    #[test]
    fn depth_jumps_are_cut_and_albedo_keeps_its_border() {
        let (rays, calibration) = (rays(), calibration());
        let optics = optics(&rays, &calibration);
        let mut snapshot = RippledPlane { amplitude_m: 0.0 }.snapshot(&optics, &poses(0.0)[0]);
        let width = snapshot.depth_m.width();
        for (index, depth) in snapshot.depth_m.data_mut().iter_mut().enumerate() {
            *depth -= if index % width >= 100 { 0.05 } else { 0.0 };
        }
        let mesh = surface_of_view(&snapshot, &optics);
        let (_, n_components) = mesh.face_components();
        assert_eq!(n_components, 2);
        for face in 0..mesh.faces.len() {
            assert!(mesh.face_normal(face).z < 0.0, "towards the camera");
        }
        // A step of 3 mm is smoothed away where the albedo is one, and kept where it is the border of two.
        let step = |bright: f32| {
            let mut snapshot = RippledPlane { amplitude_m: 0.0 }.snapshot(&optics, &poses(0.0)[0]);
            for (index, depth) in snapshot.depth_m.data_mut().iter_mut().enumerate() {
                *depth -= if index % width >= 100 { 0.003 } else { 0.0 };
            }
            for (index, counts) in snapshot.ir_counts.data_mut().iter_mut().enumerate() {
                if index % width >= 100 {
                    *counts = (*counts * bright).min(0.9 * FULL_SCALE as f32);
                }
            }
            let (noise, guide) = (&optics.depth_noise, Image::filled(width, 160, 0.0));
            let flat = filtered(&snapshot.depth_m, &guide, noise);
            let guide = log_albedo(&snapshot, &flat, &optics);
            let depth = filtered(&snapshot.depth_m, &guide, noise);
            depth.at(99, 80) - depth.at(100, 80)
        };
        let (one, two) = (step(1.0), step(0.5));
        assert!(one < 0.0022 && two > 0.0027, "{one} and {two}");
    }

    #[test]
    fn far_stairs_of_a_kinect_i_are_smoothed() {
        // One disparity at 2 m, to either side of its border.
        const STEP_M: f32 = 0.011;
        let depths = (0..20 * 20).map(|pixel| 2.0 + if pixel % 20 < 10 { 0.0 } else { STEP_M });
        let depth_m = Image::from_vec(20, 20, depths.collect());
        let guide = Image::filled(20, 20, 0.0);
        let step_left = |sensor| {
            let smooth = filtered(&depth_m, &guide, &DepthNoise::of_sensor(sensor));
            smooth.at(10, 10) - smooth.at(9, 10)
        };
        assert!(step_left(Sensor::Kinect1) < 0.4 * STEP_M);
        assert!(step_left(Sensor::Kinect2) > 0.5 * STEP_M);
    }
}
