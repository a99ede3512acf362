//! A depth camera that does not exist: a deterministic Kinect over closed-form surfaces, for recordings that anyone can make
//! and for tests that know the truth.
//!
//! [`SimulatedCamera`] leads a sensor along a [`Trajectory`] through a [`Scene`] and delivers what it would measure. The
//! same [`Setup`] gives the same frames, bit for bit on one machine: noise depends on seed, frame and pixel alone.
//! The truth is the caller's to ask for ([`SimulatedCamera::true_world_from_camera`], [`SimulatedCamera::true_depth`],
//! [`SimulatedCamera::scene`]); nothing of it is in the frames. The lens is written here a second time on purpose: a
//! mistake in the pipeline's own camera model must not cancel against itself.

mod trajectory;

mod scene;

mod infrared;
mod medallion;
mod noise;
mod optics;
mod render;
mod sensor;
mod texture;

pub use infrared::Infrared;
pub use scene::{Scene, Shape, Solid};
pub use texture::Texture;
pub use trajectory::{Orbit, Trajectory, look_at};

use std::time::{Duration, Instant};

use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame, Image, Sensor};
use nalgebra::Isometry3;

use render::Lens;
use sensor::Exposure;

/// Device time of the first frame, seconds.
const START_SECS: f64 = 100.0;

/// Both sensors deliver 30 frames a second.
const FRAME_SECS: f64 = 1.0 / 30.0;

/// How long the hand waits before and after the four images of a shading pose.
const HOLD_SECS: f64 = 0.5 + FRAME_SECS;

/// Shading images that are taken at one pose of a Kinect I.
const N_SHADING_IMAGES: usize = 4;

/// Everything that decides what a simulated camera delivers.
#[derive(Clone, Debug)]
pub struct Setup {
    /// What is seen.
    pub scene: Scene,
    /// Where from.
    pub trajectory: Trajectory,
    /// With what.
    pub sensor: Sensor,
    /// How its IR image comes about.
    pub infrared: Infrared,
    /// How many frames are taken on the move.
    pub n_moving_frames: usize,
    /// Kinect I: moving frames at whose pose the hand then holds still for four IR images under the lamp. Must increase.
    pub shading_frames: Vec<usize>,
    /// Pixels so many times larger than the real sensor's, 1 to 4; the image is smaller by as much.
    pub reduction: usize,
    /// Of the noise.
    pub seed: u64,
}

/// What a frame shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Exposed {
    /// Depth alone (Kinect I).
    Depth,
    /// Depth, and the projector's speckle (Kinect I).
    DepthAndSpeckle,
    /// Depth and a shading image (Kinect II).
    DepthAndShading,
    /// The projector is covered and the lamp lit: empty depth and a shading image (Kinect I).
    Shading,
}

/// One frame to come.
#[derive(Clone, Copy, Debug)]
struct Moment {
    device_time_secs: f64,
    /// Its pose is that of this moving frame.
    moving_frame: usize,
    exposed: Exposed,
}

/// A simulated Kinect; see the crate's documentation.
#[derive(Clone, Debug)]
pub struct SimulatedCamera {
    setup: Setup,
    info: CameraInfo,
    lens: Lens,
    /// The lens of the IR image, where it is another.
    ir_lens: Option<Lens>,
    moments: Vec<Moment>,
    next: usize,
}

impl SimulatedCamera {
    /// A camera of this set-up.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] for a reduction that is not from 1 to 4, and for shading frames that do not increase or
    /// are not moving frames, or are given to a Kinect II.
    pub fn new(setup: Setup) -> Result<Self, CameraError> {
        check(&setup)?;
        let moments = schedule(&setup);
        let lens = optics::reduced(&sensor::intrinsics(setup.sensor), setup.reduction);
        let info = CameraInfo {
            sensor: setup.sensor,
            serial: format!("simulated-{}", setup.seed),
            driver: None,
            intrinsics: lens,
            ir_full_scale: Some(sensor::full_scale(setup.sensor)),
            ir_gain: None,
            light: Some(setup.infrared.light(setup.sensor)),
            n_frames: Some(moments.len()),
        };
        let ir_lens = setup.infrared.shifted(&lens);
        Ok(SimulatedCamera {
            ir_lens: (ir_lens != lens).then(|| Lens::new(ir_lens)),
            setup,
            info,
            lens: Lens::new(lens),
            moments,
            next: 0,
        })
    }

    /// A Kinect II led round the plaque, `n_frames` frames of 512×424.
    pub fn kinect2_plaque(n_frames: usize, seed: u64) -> Self {
        Self::plaque(Sensor::Kinect2, n_frames, Vec::new(), seed)
    }

    /// A Kinect I led round the plaque, `n_frames` frames of 640×480 on the move and four at every tenth pose.
    pub fn kinect1_plaque(n_frames: usize, seed: u64) -> Self {
        let shading_frames = (6..n_frames).step_by(10).collect();
        Self::plaque(Sensor::Kinect1, n_frames, shading_frames, seed)
    }

    fn plaque(sensor: Sensor, n_frames: usize, shading_frames: Vec<usize>, seed: u64) -> Self {
        let scene = Scene::plaque();
        let (low, high) = scene.object_bounds();
        let trajectory = Trajectory::hand_held(nalgebra::center(&low, &high), n_frames);
        SimulatedCamera::new(Setup {
            scene,
            trajectory,
            sensor,
            infrared: Infrared::of_sensor(sensor),
            n_moving_frames: n_frames,
            shading_frames,
            reduction: 1,
            seed,
        })
        .expect("full size, and shading frames that increase")
    }

    /// What the camera sees.
    pub fn scene(&self) -> &Scene {
        &self.setup.scene
    }

    /// How many frames there are in all, those at shading poses included.
    pub fn n_frames(&self) -> usize {
        self.moments.len()
    }

    /// Exponent of the sensor's response: IR / full scale = light ^ gamma.
    pub fn gamma(&self) -> f64 {
        self.setup.infrared.gamma
    }

    /// The true pose of a frame; the world's z points up, and it is not the first camera's frame.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn true_world_from_camera(&self, frame: usize) -> Isometry3<f64> {
        let moving_frame = self.moments[frame].moving_frame;
        self.setup.trajectory.world_from_camera(moving_frame)
    }

    /// The true depth of a frame at the pixels' centres, metres; 0 where nothing is.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn true_depth(&self, frame: usize) -> Image<f32> {
        let world_from_camera = self.true_world_from_camera(frame);
        self.lens.true_depth(&self.setup.scene, &world_from_camera)
    }

    /// The images of a moment.
    fn expose(&self, frame: usize) -> (Image<f32>, Option<Image<u16>>) {
        let infrared = &self.setup.infrared;
        let exposure = Exposure {
            sensor: self.setup.sensor,
            gamma: infrared.gamma,
            seed: self.setup.seed,
            frame: frame as u64,
            reduction: self.setup.reduction,
        };
        let exposed = self.moments[frame].exposed;
        let light = match exposed {
            Exposed::Depth | Exposed::DepthAndSpeckle => sensor::projector(infrared),
            Exposed::DepthAndShading | Exposed::Shading => infrared.near_light(),
        };
        let pose = self.true_world_from_camera(frame);
        let scene = &self.setup.scene;
        let picture = self.lens.render(scene, &pose, &light);
        let shifted = self.ir_lens.as_ref();
        let shifted = shifted.map(|lens| lens.render(scene, &pose, &light));
        let ir_picture = shifted.as_ref().unwrap_or(&picture);
        let fx = self.lens.intrinsics.fx;
        let depth = match exposed {
            Exposed::Shading => Image::filled(picture.width(), picture.height(), 0.0),
            _ => exposure.depth_image(&picture, fx),
        };
        let ir = match exposed {
            Exposed::Depth => None,
            Exposed::DepthAndSpeckle => Some(exposure.speckle_image(ir_picture, fx)),
            Exposed::DepthAndShading | Exposed::Shading => Some(exposure.shading_image(ir_picture)),
        };
        (depth, ir)
    }
}

impl DepthCamera for SimulatedCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    /// Never waits and never fails.
    fn grab(&mut self, _timeout: Duration) -> Result<Option<Frame>, CameraError> {
        let Some(&moment) = self.moments.get(self.next) else {
            return Ok(None);
        };
        let (depth, ir) = self.expose(self.next);
        let frame_id = self.next as u64;
        self.next += 1;
        Ok(Some(Frame {
            frame_id,
            device_time_secs: moment.device_time_secs,
            host_time: Instant::now(),
            depth: Some(depth),
            ir,
        }))
    }
}

fn check(setup: &Setup) -> Result<(), CameraError> {
    let invalid = |what: String| Err(CameraError::Invalid(what));
    if !(1..=4).contains(&setup.reduction) {
        return invalid(format!(
            "reduction is {}, must be from 1 to 4",
            setup.reduction
        ));
    }
    if setup.sensor == Sensor::Kinect2 && !setup.shading_frames.is_empty() {
        return invalid("shading_frames are given, must be empty for kinect2".to_owned());
    }
    if !setup.shading_frames.is_sorted_by(|a, b| a < b) {
        return invalid("shading_frames must increase".to_owned());
    }
    match setup.shading_frames.last() {
        Some(&last) if last >= setup.n_moving_frames => invalid(format!(
            "shading_frames holds {last}, must be below n_moving_frames, {}",
            setup.n_moving_frames
        )),
        _ => Ok(()),
    }
}

/// The frames in order: moving ones at 30 Hz, after each shading frame a pause, four lamp-lit ones and another pause.
fn schedule(setup: &Setup) -> Vec<Moment> {
    let mut moments = Vec::new();
    let mut device_time_secs = START_SECS;
    for moving_frame in 0..setup.n_moving_frames {
        let holds_at = |frame: usize| setup.shading_frames.binary_search(&frame).is_ok();
        let exposed = match setup.sensor {
            Sensor::Kinect2 => Exposed::DepthAndShading,
            // The operator looks at the IR image before the lamp goes on.
            Sensor::Kinect1 if holds_at(moving_frame) || holds_at(moving_frame + 1) => {
                Exposed::DepthAndSpeckle
            }
            Sensor::Kinect1 => Exposed::Depth,
        };
        moments.push(Moment {
            device_time_secs,
            moving_frame,
            exposed,
        });
        device_time_secs += FRAME_SECS;
        if !holds_at(moving_frame) {
            continue;
        }
        device_time_secs += HOLD_SECS - FRAME_SECS;
        for _ in 0..N_SHADING_IMAGES {
            moments.push(Moment {
                device_time_secs,
                moving_frame,
                exposed: Exposed::Shading,
            });
            device_time_secs += FRAME_SECS;
        }
        device_time_secs += HOLD_SECS - FRAME_SECS;
    }
    moments
}
