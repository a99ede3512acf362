//! Planes whose information has a closed form.

use super::*;
use crate::snapshot::scenes::{self, Plane};
use depth_camera::Sensor;

fn trace(view: &ViewInformation) -> f64 {
    let sums = view.patches.iter().map(|(_, i)| i.0[0] + i.0[3] + i.0[5]);
    sums.sum()
}

/// The view of a plane whose normal leans by `tilt_rad` from a camera 0.4 m before it, with the light in the camera.
fn view_of(tilt_rad: f64) -> ViewInformation {
    let plane = Plane::tilted(tilt_rad, 0.0);
    let optics = Optics {
        light_camera: Point3::origin(),
        ..Optics::new(&scenes::camera_info(Sensor::Kinect2)).unwrap()
    };
    let pose = nalgebra::Isometry3::translation(0.0, 0.0, 0.2);
    let (snapshot, model) = scenes::view_of_plane(&plane, &pose);
    view_information(&snapshot, &model, &optics)
}

#[test]
fn determinant_is_that_of_the_matrix() {
    let t = Vector3::new(0.3, -0.2, 0.5);
    let s = Vector3::new(-0.1, 0.7, 0.2);
    let sum = Information::of_tangent(&t, 2.0).plus(&Information::of_tangent(&s, 1.0));
    let matrix =
        Matrix3::identity() + (t * t.transpose() * 2.0 + s * s.transpose()) / HALF_INFORMATION;
    assert!((sum.determinant() - matrix.determinant()).abs() < 1e-12 * matrix.determinant());
    let rest = sum.minus(&Information::of_tangent(&s, 1.0));
    let alone = 1.0 + 2.0 * t.norm_squared() / HALF_INFORMATION;
    assert!((rest.determinant() - alone).abs() < 1e-12 * alone);
}

#[test]
fn a_surface_seen_head_on_tells_least() {
    let tilts = [0.0, 20.0, 40.0, 60.0, 75.0];
    let [head_on, t20, t40, t60, t75] = tilts.map(|tilt: f64| trace(&view_of(tilt.to_radians())));
    // Perspective tilts the surface beside the axis: by 8° in each direction, 2 · 0.14² against sin² 20°.
    assert!(head_on < 0.4 * t20);
    assert!(t20 < t40);
    // Beyond 60° fewer pixels show the surface, and at 75° all but the nearest are too slanted.
    assert!(t60 < 1.5 * t40 && t75 < 0.5 * t60, "{t40} {t60} {t75}");
}

#[test]
fn information_of_a_tilted_plane_is_the_closed_form() {
    // The Gaussian's solid angle over that of a patch at the reference distance, times cosine and sine squared; the
    // whole view is nearer than that distance.
    let tilt = 30.0_f64.to_radians();
    let expected = 2.0
        * std::f64::consts::PI
        * (ATTENTION_RAD * REFERENCE_M / PATCH_M).powi(2)
        * tilt.cos()
        * tilt.sin().powi(2)
        / HALF_INFORMATION;
    let measured = trace(&view_of(tilt));
    // The tilt that perspective adds is of both signs; its square and the cut at 2.8 sigmas leave some.
    assert!(
        (measured / expected - 1.0).abs() < 0.15,
        "{measured} {expected}"
    );
}

#[test]
fn saturated_and_black_pixels_tell_nothing() {
    let plane = Plane::tilted(0.5, 0.0);
    let optics = Optics::new(&scenes::camera_info(Sensor::Kinect2)).unwrap();
    let (mut snapshot, model) = scenes::view_of_plane(&plane, &nalgebra::Isometry3::identity());
    for counts in [65535.0, 0.0] {
        snapshot.ir_counts = snapshot.ir_counts.map(|_| counts);
        let view = view_information(&snapshot, &model, &optics);
        assert!(view.patches.is_empty() && view.target_world.is_some());
    }
}
