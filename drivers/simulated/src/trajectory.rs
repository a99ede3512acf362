//! Where the camera is: closed-form arcs round a target, as a hand would lead it.

use std::f64::consts::{PI, TAU};

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// A path of the camera, a pose for every moving frame.
#[derive(Clone, Debug, PartialEq)]
pub enum Trajectory {
    /// The camera stands.
    Still(Isometry3<f64>),
    /// The camera swings to and fro round a target and looks at it.
    Orbit(Orbit),
}

/// A swing in front of a target, which lies towards +y of the camera at azimuth 0; world z is up.
#[derive(Clone, Debug, PartialEq)]
pub struct Orbit {
    /// What the camera looks at, world frame, metres.
    pub target: Point3<f64>,
    /// Mean distance from the target, metres.
    pub distance_m: f64,
    /// The swing to either side, radians.
    pub azimuth_rad: f64,
    /// Mean elevation above the horizon, radians.
    pub elevation_rad: f64,
    /// The swing up and down, radians.
    pub elevation_swing_rad: f64,
    /// Moving frames from the leftmost to the rightmost camera, and back.
    pub frames_per_swing: f64,
    /// Amplitude of the hand's tremor as it turns the camera, radians; it moves the camera by 0.3 m a radian.
    pub tremor_rad: f64,
}

impl Trajectory {
    /// The camera at `eye`, looking at `target`.
    pub fn still(eye: Point3<f64>, target: Point3<f64>) -> Self {
        Trajectory::Still(look_at(eye, target))
    }

    /// A scan of a target by hand in `n_frames` frames: swings 0.6 m in front of it, 0.7° a frame and 50° to either side at
    /// most, so that few frames mean a short arc rather than a fast one.
    pub fn hand_held(target: Point3<f64>, n_frames: usize) -> Self {
        const LONGEST_SWING: usize = 100;
        let n_swings = n_frames.div_ceil(LONGEST_SWING).max(1);
        let frames_per_swing = n_frames.max(2) as f64 / n_swings as f64;
        let reach = (0.7 * frames_per_swing / 50.0).min(1.0);
        Trajectory::Orbit(Orbit {
            target,
            distance_m: 0.6,
            azimuth_rad: 50_f64.to_radians() * reach,
            elevation_rad: 34_f64.to_radians(),
            elevation_swing_rad: 17_f64.to_radians() * reach,
            frames_per_swing,
            tremor_rad: 0.15_f64.to_radians(),
        })
    }

    /// The pose of a moving frame.
    pub fn world_from_camera(&self, frame: usize) -> Isometry3<f64> {
        match self {
            Trajectory::Still(world_from_camera) => *world_from_camera,
            Trajectory::Orbit(orbit) => orbit.world_from_camera(frame as f64),
        }
    }
}

impl Orbit {
    fn world_from_camera(&self, frame: f64) -> Isometry3<f64> {
        let phase = PI * frame / self.frames_per_swing;
        let azimuth = -self.azimuth_rad * phase.cos();
        // Three quarters of the pace: left and right turning points are met at different heights.
        let elevation = self.elevation_rad + self.elevation_swing_rad * (1.5 * phase).sin();
        let distance_m = self.distance_m * (1.0 + 0.04 * (0.8 * phase).sin());
        let (sin_a, cos_a) = azimuth.sin_cos();
        let (sin_e, cos_e) = elevation.sin_cos();
        let towards_camera = Vector3::new(sin_a * cos_e, -cos_a * cos_e, sin_e);
        let steady = look_at(self.target + towards_camera * distance_m, self.target);

        let turn = Vector3::new(tremor(frame, 0.0), tremor(frame, 1.3), tremor(frame, 2.9));
        let shift = Vector3::new(tremor(frame, 4.1), tremor(frame, 5.2), tremor(frame, 0.7));
        steady
            * Isometry3::from_parts(
                Translation3::from(shift * (0.3 * self.tremor_rad)),
                UnitQuaternion::from_scaled_axis(turn * self.tremor_rad),
            )
    }
}

/// Two sines of no common period, 2.1 Hz and 3.4 Hz at 30 frames a second, between -1 and 1.
fn tremor(frame: f64, phase: f64) -> f64 {
    let secs = frame / 30.0;
    0.6 * (TAU * 2.1 * secs + phase).sin() + 0.4 * (TAU * 3.4 * secs + 2.0 * phase).sin()
}

/// The pose (world from camera) at `eye` looking at `target`, with the image's rows as level as may be.
pub fn look_at(eye: Point3<f64>, target: Point3<f64>) -> Isometry3<f64> {
    let straight_down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
    let rotation = (target - eye)
        .try_normalize(1e-12)
        .and_then(|forward| {
            let right = forward.cross(&Vector3::z()).try_normalize(1e-9)?;
            let down = forward.cross(&right);
            let axes = Matrix3::from_columns(&[right, down, forward]);
            Some(UnitQuaternion::from_rotation_matrix(
                &Rotation3::from_matrix_unchecked(axes),
            ))
        })
        // Above the target there is no level: the image's rows are the world's x.
        .unwrap_or(straight_down);
    Isometry3::from_parts(Translation3::from(eye), rotation)
}
