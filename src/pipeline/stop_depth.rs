//! Shading images of a Kinect I without a shutter: depth is stopped for a few frames, on request, and the image has to prove that
//! the projector is dark.
//!
//! What comes meanwhile goes on as frames without depth, which the selection of shading images takes for exposures, just as
//! under a shutter. Depth is started again when there are enough, or when it is plain that there will be none.

use crate::{
    capture::ShadingStrategy,
    lock::lock,
    snapshot::{SnapshotParams, Texture, texture},
};
use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame, Image, Sensor};
use std::{
    fmt,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

/// Exposures of a shading image, within the bounds of the selection's own parameters: they halve the noise.
const N_EXPOSURES: usize = 4;

/// How long speckle may show after depth has stopped, seconds: any projector would have gone dark. Arbitrary.
const MAX_SPECKLED_SECS: f64 = 1.0;

/// How long it may be dark before the operator has lit the lamp, seconds. Arbitrary.
const MAX_DARK_SECS: f64 = 10.0;

/// Frames with depth that may still come after it was stopped: what was under way. Arbitrary.
const MAX_WITH_DEPTH: usize = 30;

/// How a request for a shading image ended.
#[derive(Clone, Debug, PartialEq)]
pub enum ShadingOutcome {
    /// The lamp alone lit so many exposures; what they become is the selection's matter.
    Taken {
        /// How many.
        n_exposures: usize,
    },
    /// There is no shading image.
    Refused(ShadingRefusal),
}

/// Why there is no shading image.
#[derive(Clone, Debug, PartialEq)]
pub enum ShadingRefusal {
    /// The projector stays lit with depth stopped.
    Speckle {
        /// Speckle energy of the last image.
        energy: f64,
    },
    /// Nothing lights the scene.
    Dark,
    /// The camera did not obey, or was unplugged.
    Camera(CameraError),
}

impl fmt::Display for ShadingRefusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ShadingRefusal::Speckle { energy } => write!(
                f,
                "the projector stays lit with depth stopped: speckle energy is {energy:.2}, must be below {:.2}; \
                 set capture.shading to \"shutter\" and cover the projector",
                Texture::SPECKLE_LIMIT
            ),
            ShadingRefusal::Dark => f.write_str(
                "the infrared image is dark with depth stopped: light the lamp, then ask for the image again",
            ),
            ShadingRefusal::Camera(error) => write!(f, "depth cannot be stopped: {error}"),
        }
    }
}

/// The camera as the strategy wants it; with the handle for requests, if the program is to stop depth for them.
pub(super) fn by_strategy(
    camera: Box<dyn DepthCamera>,
    strategy: ShadingStrategy,
    params: &SnapshotParams,
) -> (Box<dyn DepthCamera>, Option<ShadingRequest>) {
    let is_kinect1 = camera.info().sensor == Sensor::Kinect1;
    if strategy != ShadingStrategy::StopDepth || !is_kinect1 {
        return (camera, None);
    }
    let request = ShadingRequest::default();
    let n_wanted = N_EXPOSURES.clamp(params.min_exposures, params.max_exposures);
    match StopDepthCamera::new(camera, request.clone(), n_wanted) {
        Ok(camera) => (Box::new(camera), Some(request)),
        Err(camera) => (camera, None),
    }
}

/// A request for a shading image, made by one thread and met by the camera's; clones are the same request.
#[derive(Clone, Debug, Default)]
pub struct ShadingRequest {
    wanted: Arc<AtomicBool>,
    newest: Arc<Mutex<Option<ShadingOutcome>>>,
}

impl ShadingRequest {
    /// Asks for a shading image; asking again before it is taken changes nothing.
    pub fn ask(&self) {
        self.wanted.store(true, Ordering::Relaxed);
    }

    /// How the newest request ended; told once.
    pub fn take_outcome(&self) -> Option<ShadingOutcome> {
        lock(&self.newest).take()
    }

    /// Says how the request ended.
    pub(super) fn answer(&self, outcome: ShadingOutcome) {
        match &outcome {
            ShadingOutcome::Taken { n_exposures } => {
                tracing::info!(n_exposures, "shading exposures taken with depth stopped");
            }
            ShadingOutcome::Refused(refusal) => tracing::warn!("no shading image: {refusal}"),
        }
        *lock(&self.newest) = Some(outcome);
    }
}

/// A camera that stops depth for a few frames when it is asked to.
pub struct StopDepthCamera {
    camera: Box<dyn DepthCamera>,
    request: ShadingRequest,
    n_wanted: usize,
    full_scale: f64,
    pause: Option<Pause>,
}

impl StopDepthCamera {
    /// A camera of which `n_wanted` exposures make a shading image.
    ///
    /// # Errors
    /// The camera as it was, if it delivers no IR.
    pub fn new(
        camera: Box<dyn DepthCamera>,
        request: ShadingRequest,
        n_wanted: usize,
    ) -> Result<Self, Box<dyn DepthCamera>> {
        match camera.info().ir_full_scale {
            Some(full_scale) => Ok(StopDepthCamera {
                camera,
                request,
                n_wanted,
                full_scale,
                pause: None,
            }),
            None => Err(camera),
        }
    }

    fn begin(&mut self) {
        match self.camera.pause_depth() {
            Ok(()) => self.pause = Some(Pause::default()),
            Err(error) => self.end(ShadingOutcome::Refused(ShadingRefusal::Camera(error))),
        }
    }

    fn end(&mut self, outcome: ShadingOutcome) {
        self.pause = None;
        // A device that was unplugged keeps the streams in mind; whatever else is wrong with it, the next frame tells.
        if let Err(error) = self.camera.resume_depth() {
            tracing::warn!(%error, "depth is not started again");
        }
        self.request.answer(outcome);
    }
}

impl DepthCamera for StopDepthCamera {
    fn info(&self) -> &CameraInfo {
        self.camera.info()
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        if self.request.wanted.swap(false, Ordering::Relaxed) && self.pause.is_none() {
            self.begin();
        }
        let grabbed = self.camera.grab(timeout);
        let Some(pause) = &mut self.pause else {
            return grabbed;
        };
        let outcome = match &grabbed {
            Ok(Some(frame)) => pause.observe(frame, self.full_scale, self.n_wanted),
            Err(error) if !error.is_recoverable() => Some(ShadingOutcome::Refused(
                ShadingRefusal::Camera(error.clone()),
            )),
            _ => None,
        };
        if let Some(outcome) = outcome {
            self.end(outcome);
        }
        grabbed
    }

    fn n_missed(&self) -> u64 {
        self.camera.n_missed()
    }

    fn pause_depth(&mut self) -> Result<(), CameraError> {
        self.camera.pause_depth()
    }

    fn resume_depth(&mut self) -> Result<(), CameraError> {
        self.camera.resume_depth()
    }
}

/// What has come since depth was stopped.
#[derive(Debug, Default)]
struct Pause {
    n_with_depth: usize,
    /// When the last frame without depth was taken, device time.
    last_secs: Option<f64>,
    speckled_secs: f64,
    dark_secs: f64,
    n_exposures: usize,
}

impl Pause {
    /// Takes in a frame; says how it ended, if it did.
    fn observe(
        &mut self,
        frame: &Frame,
        full_scale: f64,
        n_wanted: usize,
    ) -> Option<ShadingOutcome> {
        let (None, Some(ir)) = (&frame.depth, &frame.ir) else {
            self.n_with_depth += 1;
            let error = CameraError::Unresponsive("depth goes on after it was stopped".to_owned());
            return (self.n_with_depth > MAX_WITH_DEPTH)
                .then_some(ShadingOutcome::Refused(ShadingRefusal::Camera(error)));
        };
        let last_secs = self.last_secs.replace(frame.device_time_secs);
        let passed_secs = last_secs.map_or(0.0, |last_secs| frame.device_time_secs - last_secs);
        self.judge(ir, full_scale, passed_secs);
        let energy = || texture(ir, full_scale).speckle_energy;
        if self.n_exposures >= n_wanted {
            let n_exposures = self.n_exposures;
            Some(ShadingOutcome::Taken { n_exposures })
        } else if self.speckled_secs >= MAX_SPECKLED_SECS {
            let energy = energy();
            Some(ShadingOutcome::Refused(ShadingRefusal::Speckle { energy }))
        } else {
            (self.dark_secs >= MAX_DARK_SECS)
                .then_some(ShadingOutcome::Refused(ShadingRefusal::Dark))
        }
    }

    /// What an image shows that came so long after the last one.
    fn judge(&mut self, ir: &Image<u16>, full_scale: f64, passed_secs: f64) {
        let texture = texture(ir, full_scale);
        if texture.is_speckled() {
            self.speckled_secs += passed_secs;
        } else if texture.is_dark() {
            self.dark_secs += passed_secs;
        } else {
            self.n_exposures += 1;
        }
    }
}

#[cfg(test)]
mod tests;
