//! What a sensor gets wrong, taken off the depth of a scan as well as it is known while the scan goes on, and, since the scan
//! itself tells more, once more at its end: how strong multipath is, and what surface it falls on.
//!
//! A Kinect II suffers from multipath, and from an error by range alone, a constant and a wiggle, and a decoder may have computed its depth
//! by the rays of the wrong rows; a Kinect I has a slow error of its depth, a lens of focal lengths of its own, and reads its rows one after
//! the other. Only the frames of a whole scan tell all but multipath ([`RangeError`], [`DepthField`](crate::fusion::DepthField),
//! [`RollingShutter`](crate::fusion::RollingShutter)). Pure: what is predicted of the frames is kept here as long as fusion holds them.

mod agreement;
mod carry;
mod gross_error;
mod lens;
mod measured;
mod predictions;
mod ray_order;
mod revision;
mod settling;
mod slow_field;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod wavy_wall;

pub use measured::{MeasuredDepth, MeasuredWhite};
pub use ray_order::WrongRays;
pub use revision::Revised;

use crate::{
    fusion::{Fusion, FusionParams, GoesOn},
    geometry::{CameraModel, Pose, RangeError, RayGrid},
    interreflection::WhiteLevel,
    multipath::Multipath,
    shading::Calibration,
};
use depth_camera::{CameraInfo, Frame, Image, Sensor};
use predictions::Predictions;
use ray_order::RayOrder;
use revision::Known;

/// Corrects the depth of one scan.
pub struct DepthCorrection {
    info: CameraInfo,
    rays: RayGrid,
    fusion: FusionParams,
    /// `None` for a sensor that suffers from none, or where it is not wanted.
    multipath: Option<Multipath>,
    /// Where depth is known to have been computed with the rays of its image upside down, which is put right in every frame.
    rays_upside_down: Option<RayOrder>,
    /// The error by range that the device's calibration tells, taken off every frame.
    range: Option<RangeError>,
    /// The white level that frames are corrected for while the scan goes on; `None` before the first.
    live: Option<WhiteLevel>,
    /// The one that another calibration tells, which was found since.
    recalibrated: Option<WhiteLevel>,
    /// Whether the device's calibration tells it.
    is_measured: bool,
    predictions: Predictions,
    /// While the white level of a scan is still being looked for, no more frames than so many are fused again.
    max_sought_by: usize,
}

impl DepthCorrection {
    /// A correction for a camera with its calibration, for a scan that is fused with `fusion`.
    pub fn new(
        info: &CameraInfo,
        calibration: &Calibration,
        has_multipath: bool,
        fusion: &FusionParams,
    ) -> Self {
        let multipath = has_multipath.then(|| Multipath::new(info, calibration));
        let measured = calibration.light.white_level;
        let rays = RayGrid::new(CameraModel::new(info.intrinsics));
        let is_upside_down = fusion.rays_upside_down && info.sensor == Sensor::Kinect2;
        DepthCorrection {
            info: info.clone(),
            rays_upside_down: is_upside_down.then(|| RayOrder::upside_down(&rays)),
            rays,
            fusion: fusion.clone(),
            multipath: multipath.flatten(),
            range: calibration
                .range_error_m
                .clone()
                .filter(|_| info.sensor == Sensor::Kinect2),
            live: measured.map(WhiteLevel),
            recalibrated: None,
            is_measured: measured.is_some(),
            predictions: Predictions::default(),
            max_sought_by: revision::MAX_SOUGHT_BY,
        }
    }

    /// A frame without the errors of its depth that are known while the scan goes on; `None` if there are none.
    pub fn correct(&mut self, frame: &Frame) -> Option<Frame> {
        let depth = frame.depth.as_ref();
        let righted = self.rays_upside_down.as_ref().zip(depth);
        let righted = righted.map(|(rays, depth)| rays.righted(depth));
        let ranged = self.range.as_ref().zip(righted.as_ref().or(depth));
        let ranged = ranged.map(|(range, depth)| range.corrected(depth, &self.rays));
        let known = ranged.or(righted).map(|depth| with_depth(frame, depth));
        self.without_multipath(known.as_ref().unwrap_or(frame))
            .or(known)
    }

    /// A frame without its multipath; `None` if nothing can be predicted for it.
    fn without_multipath(&mut self, frame: &Frame) -> Option<Frame> {
        let multipath = self.multipath.as_ref()?;
        let prediction = multipath.predict(frame)?;
        self.live.get_or_insert(prediction.plausible_white);
        let depth = multipath.corrected(frame.depth.as_ref()?, &prediction.bias, None, self.live);
        self.predictions.insert(frame.device_time_secs, prediction);
        Some(with_depth(frame, depth))
    }

    /// Goes on with another calibration, by which the scan is to be revised; frames that were corrected stay as they are.
    pub fn recalibrate(&mut self, calibration: &Calibration) {
        let by = Multipath::new(&self.info, calibration);
        let (Some(before), Some(by)) = (&self.multipath, by) else {
            return;
        };
        self.predictions.recalibrate(before, &by);
        if self.is_measured {
            self.recalibrated = calibration.light.white_level.map(WhiteLevel);
        }
        self.multipath = Some(by);
    }

    /// Forgets the predictions of frames that fusion does not hold any more; and as long as it has fused none, or all were taken back,
    /// what was seen before does not belong to the scan, and does not tell its white level.
    pub fn thin_out(&mut self, fusion: &Fusion) {
        if fusion.n_fused() > 0 {
            return self.predictions.thin_out(fusion);
        }
        self.predictions = Predictions::default();
        if !self.is_measured {
            self.live = None;
        }
    }

    /// Fuses a scan again as long as it tells of errors that were not taken off: multipath at least four times, for a model tells
    /// the slant of the surface better than single frames do, and what was fused on one is a better one; after that its views tell
    /// how strong it is. `None` if it stays as it is; as soon as `goes_on` says no, what was fused again in whole counts.
    pub fn revise(&self, fusion: &Fusion, goes_on: &GoesOn) -> Option<Revised> {
        self.settled(fusion, goes_on).revised
    }

    /// The depth (m) of a frame of the scan as it was corrected while the scan went on, corrected for what a revision knows;
    /// `world_from_camera` is where the revision has it. Its rows stay as they were read: a Kinect I rests for a shading image.
    pub fn revised_depth(
        &self,
        depth_m: &Image<f32>,
        time_secs: f64,
        world_from_camera: &Pose,
        revised: &Revised,
    ) -> Image<f32> {
        let (model, known) = (&revised.fusion, &revised.known);
        let depth = (depth_m, self.live);
        self.anew(depth, time_secs, world_from_camera, model, known)
    }

    /// The white level by which a frame of the scan was corrected while the scan went on; none where it had no infrared image.
    fn corrected_by(&self, time_secs: f64) -> Option<WhiteLevel> {
        self.live.filter(|_| self.predictions.has(time_secs))
    }

    /// The depth (m) of a frame of the scan, corrected for what is known now instead of `by` a white level, on a model in which it was
    /// taken from `world_from_camera`.
    fn anew(
        &self,
        (depth_m, by): (&Image<f32>, Option<WhiteLevel>),
        time_secs: f64,
        world_from_camera: &Pose,
        model: &Fusion,
        known: &Known,
    ) -> Image<f32> {
        let nearest = self.predictions.near(time_secs);
        let predicted = self.multipath.as_ref().zip(nearest);
        let righted = |depth_m: &Image<f32>| known.gross.taken_off(depth_m, &self.rays);
        let depth = match predicted {
            Some((multipath, nearest)) => {
                let here = righted(depth_m);
                let here = here.as_ref().unwrap_or(depth_m);
                let bias = nearest.bias_on(model, multipath, here, world_from_camera);
                let raw = multipath.corrected(depth_m, &nearest.prediction.bias, by, None);
                let raw = righted(&raw).unwrap_or(raw);
                multipath.corrected(&raw, &bias, None, known.white)
            }
            None => righted(depth_m).unwrap_or_else(|| depth_m.clone()),
        };
        match &known.field {
            Some(field) => field.corrected(&depth),
            None => depth,
        }
    }
}

/// The same frame with another depth image, metres.
fn with_depth(frame: &Frame, depth_m: Image<f32>) -> Frame {
    Frame {
        frame_id: frame.frame_id,
        device_time_secs: frame.device_time_secs,
        host_time: frame.host_time,
        depth: Some(depth_m),
        ir: frame.ir.clone(),
    }
}
