//! What every depth camera driver of Relief has in common: the trait [`DepthCamera`], the [`Frame`] that it delivers, the
//! camera's own description [`CameraInfo`] and the [`CameraError`]s that a caller can act on.
//!
//! Depth arrives in metres along the optical axis, IR in raw counts with the response not removed; both share one pixel
//! grid (u right, v down, pixel centres at integers) and one Brown–Conrady camera. Nothing here knows a device.

mod error;
mod image;
mod pool;

pub use error::CameraError;
pub use image::Image;
pub use pool::ImagePool;

use std::time::{Duration, Instant};

/// The sensors that Relief knows, which decides how shading images are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sensor {
    /// Kinect I: structured light, 640×480, shading images under a lamp while the speckle projector is covered.
    Kinect1,
    /// Kinect II: time of flight, 512×424, every IR frame is a shading image lit by the sensor's own emitter.
    Kinect2,
}

impl Sensor {
    /// The name used in `session.toml` and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Sensor::Kinect1 => "kinect1",
            Sensor::Kinect2 => "kinect2",
        }
    }

    /// The sensor of that name, if there is one.
    pub fn from_name(name: &str) -> Option<Self> {
        [Sensor::Kinect1, Sensor::Kinect2]
            .into_iter()
            .find(|sensor| sensor.name() == name)
    }
}

/// Brown–Conrady camera of the IR sensor, in pixels; the depth image shares it.
///
/// With normalised coordinates (x, y) = (X/Z, Y/Z) and r² = x² + y²:
/// x' = x(1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2x²),
/// y' = y(1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2y²) + 2 p2 x y, u = fx x' + cx, v = fy y' + cy.
///
/// With the feature `serde` it is read and written by these names; none has a default: a forgotten distortion would be a wrong
/// camera.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, serde::Serialize))]
pub struct Intrinsics {
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Horizontal focal length, pixels.
    pub fx: f64,
    /// Vertical focal length, pixels.
    pub fy: f64,
    /// Principal point, pixels from the centre of the leftmost column.
    pub cx: f64,
    /// Principal point, pixels from the centre of the top row.
    pub cy: f64,
    /// Radial distortion, r² term.
    pub k1: f64,
    /// Radial distortion, r⁴ term.
    pub k2: f64,
    /// Tangential distortion, first term.
    pub p1: f64,
    /// Tangential distortion, second term.
    pub p2: f64,
    /// Radial distortion, r⁶ term.
    pub k3: f64,
}

/// Narrower images than this have no reduced levels to track on; no depth camera's are.
const MIN_SIDE_PX: usize = 16;
/// More pixels than any depth camera's: a wrong size must not ask for gigabytes. Single precision counts no further, either.
const MAX_PIXELS: usize = 1 << 23;

impl Intrinsics {
    /// Checks that images of this size can be worked on.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn check_size(&self) -> Result<(), String> {
        for (key, side) in [("width", self.width), ("height", self.height)] {
            if side < MIN_SIDE_PX {
                return Err(format!("{key} is {side}, must be at least {MIN_SIDE_PX}"));
            }
        }
        let n_pixels = self.width.saturating_mul(self.height);
        if n_pixels >= MAX_PIXELS {
            return Err(format!(
                "width × height is {} × {}, must be below {MAX_PIXELS} pixels",
                self.width, self.height
            ));
        }
        Ok(())
    }
}

/// What lights a shading image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LightKind {
    /// The sensor's own emitter (Kinect II): always on.
    Emitter,
    /// A lamp fixed to the sensor (Kinect I): on at shading poses only.
    Lamp,
}

impl LightKind {
    /// The name used in `session.toml`.
    pub fn name(self) -> &'static str {
        match self {
            LightKind::Emitter => "emitter",
            LightKind::Lamp => "lamp",
        }
    }
}

/// The near point light that moves with the camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// Position in the IR camera frame (x right, y down, z forward), metres.
    pub position_m: [f64; 3],
    /// What it is.
    pub kind: LightKind,
}

/// A light further from the camera than this is not the near light that shading needs, metres.
const MAX_LIGHT_DISTANCE_M: f64 = 2.0;

impl Light {
    /// Checks that a position, metres, can be that of the near light; `key` is its name where it was given.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn check_position(key: &str, position_m: [f64; 3]) -> Result<(), String> {
        if let Some(value) = position_m.iter().find(|value| !value.is_finite()) {
            return Err(format!("{key} is {value}, must be finite"));
        }
        let distance_m = position_m.iter().map(|x| x * x).sum::<f64>().sqrt();
        match distance_m <= MAX_LIGHT_DISTANCE_M {
            true => Ok(()),
            false => Err(format!(
                "{key} is {distance_m} m from the camera, must be at most {MAX_LIGHT_DISTANCE_M} m"
            )),
        }
    }

    /// The emitter of a Kinect II where its own ranging has it, 45 mm beside the camera, in images that are not mirrored.
    pub fn kinect2_emitter() -> Self {
        Light {
            position_m: [-0.045, 0.0, 0.0],
            kind: LightKind::Emitter,
        }
    }
}

/// A camera's description of itself, fixed while it streams.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// Which sensor it is.
    pub sensor: Sensor,
    /// The device's serial number; a recording without one carries its session's name.
    pub serial: String,
    /// What decodes the sensor's packets, which decides the response of its IR: "libfreenect2"; `None` where that is unknown.
    pub driver: Option<String>,
    /// The camera model of depth and IR.
    pub intrinsics: Intrinsics,
    /// IR counts at full scale; `None` if the camera delivers no IR.
    pub ir_full_scale: Option<f64>,
    /// Gain of the IR image as the device reported it, where it has one (Kinect I: 1 to 50); counts scale with it.
    pub ir_gain: Option<u16>,
    /// The light of the shading images; `None` if the camera delivers no IR.
    pub light: Option<Light>,
    /// How many frames will come, where that is known beforehand.
    pub n_frames: Option<usize>,
}

impl CameraInfo {
    /// Whether the camera delivers IR.
    pub fn has_infrared(&self) -> bool {
        self.ir_full_scale.is_some() || self.light.is_some()
    }
}

/// One moment of the device: a depth image, an IR image, or both.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Counts frames from the start of the stream; gaps are frames that the driver knows to be lost.
    pub frame_id: u64,
    /// The device's own clock, seconds; never compared with `host_time`.
    pub device_time_secs: f64,
    /// When the driver had the frame, on this machine's monotonic clock.
    pub host_time: Instant,
    /// Depth along the optical axis, metres; 0 is no measurement.
    pub depth: Option<Image<f32>>,
    /// Raw IR counts, response not removed.
    pub ir: Option<Image<u16>>,
}

impl Frame {
    /// Share of the pixels with depth, 0 to 1; 0 without a depth image.
    pub fn depth_share(&self) -> f64 {
        self.depth.as_ref().map_or(0.0, |depth| {
            let n_valid = depth.data().iter().filter(|z| **z > 0.0).count();
            n_valid as f64 / depth.data().len().max(1) as f64
        })
    }
}

/// Device time in whole microseconds, seconds.
///
/// That is what lists of recordings keep: a time that has passed through here is the same when it is read again.
pub fn whole_microseconds(secs: f64) -> f64 {
    (secs * 1e6).round() / 1e6
}

/// A source of depth and IR frames: a device, a recording, or a simulation.
///
/// A camera is driven by one thread. After an error that [`CameraError::is_recoverable`] the next call may succeed.
pub trait DepthCamera: Send {
    /// The camera's description of itself.
    fn info(&self) -> &CameraInfo;

    /// Waits at most `timeout` for the next frame; `None` when the stream has ended for good.
    ///
    /// # Errors
    /// [`CameraError::Timeout`] when no frame came in time, [`CameraError::NotDue`] when a recording has none for that time,
    /// [`CameraError::DamagedFrame`] for one frame that cannot be used (the stream goes on), and the other kinds when the stream is over.
    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError>;

    /// How many frames the driver had to let go since the camera was opened, and IR images that it had to leave out of frames, none
    /// of which an error of [`DepthCamera::grab`] tells of. A camera that lets nothing go has missed none.
    fn n_missed(&self) -> u64 {
        0
    }

    /// Stops depth while IR goes on: frames carry IR alone from then on. Of a Kinect I it is said that its projector goes dark;
    /// only the IR image can tell.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] from a camera that cannot, and what a device says that does not obey.
    fn pause_depth(&mut self) -> Result<(), CameraError> {
        Err(CameraError::Invalid(
            "this camera cannot stop depth while IR goes on".to_owned(),
        ))
    }

    /// Starts depth again after [`DepthCamera::pause_depth`].
    ///
    /// # Errors
    /// As [`DepthCamera::pause_depth`].
    fn resume_depth(&mut self) -> Result<(), CameraError> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_light_that_is_nowhere_near_is_named_with_its_bound() {
        let said = |position_m| Light::check_position("lamp", position_m).err();
        assert_eq!(said([1.0, 0.0, -1.5]), None);
        let far = "lamp is 50 m from the camera, must be at most 2 m";
        assert_eq!(said([0.0, -50.0, 0.0]).unwrap(), far);
        assert_eq!(said([0.0, 1e200, 0.0]).unwrap(), far.replace("50", "inf"));
        let nowhere = "lamp is NaN, must be finite";
        assert_eq!(said([0.0, 0.0, f64::NAN]).unwrap(), nowhere);
    }

    #[test]
    fn a_size_that_cannot_be_worked_on_is_named_with_its_bound() {
        let said = |width, height| {
            let intrinsics = Intrinsics {
                width,
                height,
                fx: 500.0,
                fy: 500.0,
                cx: 0.0,
                cy: 0.0,
                k1: 0.0,
                k2: 0.0,
                p1: 0.0,
                p2: 0.0,
                k3: 0.0,
            };
            intrinsics.check_size().err()
        };
        assert_eq!(said(16, 16), None);
        assert_eq!(said(3840, 2160), None);
        assert_eq!(said(8, 24).unwrap(), "width is 8, must be at least 16");
        assert_eq!(said(640, 0).unwrap(), "height is 0, must be at least 16");
        let many = said(4096, 2048).unwrap();
        assert!(
            many.contains("4096 × 2048") && many.contains("8388608"),
            "{many}"
        );
    }
}
