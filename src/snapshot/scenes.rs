//! Tiny scenes with closed-form answers.

use super::{ShadingSnapshot, TrackedFrame};
use crate::fusion::{ModelMap, TrackingOutcome};
use crate::geometry::{CameraModel, Pose, RayGrid};
use depth_camera::{CameraInfo, Frame, Image, Intrinsics, Light, LightKind, Sensor};
use nalgebra::{Point3, Rotation3, Vector3};

/// A camera of 128×106 pixels, 70° wide, with the light of its sensor.
pub(super) fn camera_info(sensor: Sensor) -> CameraInfo {
    let (position_m, kind, full_scale) = match sensor {
        Sensor::Kinect1 => ([0.12, -0.07, 0.02], LightKind::Lamp, 1023.0),
        Sensor::Kinect2 => ([0.052, 0.0, 0.004], LightKind::Emitter, 65535.0),
    };
    CameraInfo {
        sensor,
        serial: "scene".into(),
        driver: None,
        intrinsics: Intrinsics {
            width: 128,
            height: 106,
            fx: 91.4,
            fy: 91.4,
            cx: 63.5,
            cy: 52.5,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
        },
        ir_full_scale: Some(full_scale),
        ir_gain: None,
        light: Some(Light { position_m, kind }),
        n_frames: None,
    }
}

/// An endless plane in the world frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plane {
    pub(super) point: Point3<f64>,
    pub(super) normal: Vector3<f64>,
}

impl Plane {
    /// Through (0, 0, 0.6), leaning by `tilt_rad` from facing the origin, towards `azimuth_rad` about z.
    pub(super) fn tilted(tilt_rad: f64, azimuth_rad: f64) -> Self {
        let lean = Rotation3::from_axis_angle(&Vector3::y_axis(), tilt_rad);
        let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), azimuth_rad);
        Plane {
            point: Point3::new(0.0, 0.0, 0.6),
            normal: turn * (lean * -Vector3::z()),
        }
    }
}

/// The shading image of a plane at a third of full scale, with the model of it at half the resolution a side.
pub(super) fn view_of_plane(
    plane: &Plane,
    world_from_camera: &Pose,
) -> (ShadingSnapshot, ModelMap) {
    let camera = CameraModel::new(camera_info(Sensor::Kinect2).intrinsics);
    let snapshot = ShadingSnapshot {
        frame_id: 0,
        device_time_secs: 0.0,
        n_exposures: 1,
        ir_counts: Image::filled(128, 106, 65535.0 / 3.0),
        unlit_counts: None,
        depth_m: seen_by(plane, world_from_camera, &camera)
            .map(|hit| hit.map_or(0.0, |point| (world_from_camera.inverse() * point).z as f32)),
        world_from_camera: *world_from_camera,
        moved: None,
    };
    let points = seen_by(plane, world_from_camera, &camera.reduced(2));
    let model = ModelMap {
        normals: points.map(|hit| hit.map_or(Vector3::zeros(), |_| plane.normal.cast())),
        points: points.map(|hit| hit.map_or(Vector3::zeros(), |point| point.coords.cast())),
    };
    (snapshot, model)
}

/// Where the rays of a camera meet a plane's front within 3 m.
fn seen_by(
    plane: &Plane,
    world_from_camera: &Pose,
    camera: &CameraModel,
) -> Image<Option<Point3<f64>>> {
    let eye = Point3::from(world_from_camera.translation.vector);
    RayGrid::new(*camera).rays().map(|&[x, y]| {
        let ray = world_from_camera * Vector3::new(f64::from(x), f64::from(y), 1.0);
        let depth = (plane.point - eye).dot(&plane.normal) / ray.dot(&plane.normal);
        (ray.dot(&plane.normal) < 0.0 && depth > 0.0 && depth < 3.0).then(|| eye + ray * depth)
    })
}

/// A frame of any images.
pub(super) fn frame(
    frame_id: u64,
    device_time_secs: f64,
    depth: Option<Image<f32>>,
    ir: Option<Image<u16>>,
) -> Frame {
    Frame {
        frame_id,
        device_time_secs,
        host_time: std::time::Instant::now(),
        depth,
        ir,
    }
}

/// A tracked outcome without the figures of a fit.
pub(super) fn tracked(world_from_camera: Pose) -> TrackingOutcome {
    TrackingOutcome::Tracked {
        world_from_camera,
        fit: None,
    }
}

/// A frame that has no model.
pub(super) fn without_model<'a>(
    frame: &'a Frame,
    outcome: &'a TrackingOutcome,
) -> TrackedFrame<'a> {
    TrackedFrame {
        frame,
        outcome,
        model: None,
    }
}
