//! Multipath taken off the depth of a scan, as well as its strength is known while the scan goes on, and again at its end.

use crate::{
    fusion::{DepthNoise, Fusion, FusionParams, PoseCorrection, TrackingOutcome},
    geometry::{CameraModel, Pose},
    multipath::{Evidence, Multipath, MultipathParams, RangeBias, Seen, WhiteLevel, WhiteSearch},
    shading::Calibration,
};
use depth_camera::{CameraInfo, Frame, Image};
use std::collections::{BTreeMap, BTreeSet};

/// Takes multipath off the frames of one scan.
pub struct DepthCorrection {
    multipath: Multipath,
    /// The white level that frames are corrected for; `None` before the first frame or where views agree without.
    white: Option<WhiteLevel>,
    /// The white level that frames were corrected for while the scan went on.
    live: Option<WhiteLevel>,
    /// Whether the device's calibration tells it.
    is_measured: bool,
    /// How often a scan may be fused again.
    max_revisions: usize,
    /// Predicted multipath of the frames, by time in nanoseconds of the device's clock.
    biases: BTreeMap<i64, RangeBias>,
}

/// A scan fused again with its depth corrected otherwise.
pub struct Revised {
    /// The model.
    pub fusion: Fusion,
    /// How far every pose is moved, by time.
    pub correction: PoseCorrection,
}

/// Most frames whose views are compared at the end of a scan.
const MAX_VIEWS: usize = 60;
/// A revision that loses more than this share of the frames is not used.
const MAX_LOST_SHARE: f64 = 0.05;
/// Where frames are missing for longer, seconds, another place may follow.
const MAX_GAP_SECS: f64 = 0.2;
/// Predictions are thinned out to those of the frames that fusion still holds when they are so many times as many.
const MAX_BIASES_A_FRAME: usize = 2;
/// ... but not below this number.
const MIN_BIASES: usize = 256;

impl DepthCorrection {
    /// A correction for a camera whose depth suffers from multipath; `None` for any other, or where it is not wanted.
    pub fn new(
        info: &CameraInfo,
        calibration: &Calibration,
        params: &MultipathParams,
    ) -> Option<Self> {
        if !params.enabled {
            return None;
        }
        let measured = calibration.light.white_level;
        Some(DepthCorrection {
            multipath: Multipath::new(info, calibration)?,
            white: measured.map(WhiteLevel),
            live: measured.map(WhiteLevel),
            is_measured: measured.is_some(),
            max_revisions: params.max_revisions,
            biases: BTreeMap::new(),
        })
    }

    /// A frame without its multipath; `None` if nothing can be predicted for it.
    pub fn correct(&mut self, frame: &Frame) -> Option<Frame> {
        let prediction = self.multipath.predict(frame)?;
        let is_first = self.biases.is_empty() && !self.is_measured;
        if is_first {
            self.live = Some(prediction.plausible_white);
            self.white = self.live;
        }
        let bias = prediction.bias;
        let depth = frame.depth.as_ref()?;
        let depth = self.multipath.corrected(depth, &bias, None, self.live);
        self.biases.insert(nanos(frame.device_time_secs), bias);
        Some(Frame {
            frame_id: frame.frame_id,
            device_time_secs: frame.device_time_secs,
            host_time: frame.host_time,
            depth: Some(depth),
            ir: frame.ir.clone(),
        })
    }

    /// Forgets the predictions of frames that fusion does not hold any more.
    pub fn thin_out(&mut self, fusion: &Fusion) {
        let frames = fusion.keyframes();
        if self.biases.len() > MIN_BIASES.max(MAX_BIASES_A_FRAME * frames.len()) {
            let held = frames.iter().map(|frame| nanos(frame.time_secs));
            let held: BTreeSet<i64> = held.collect();
            self.biases.retain(|time, _| held.contains(time));
        }
    }

    /// Compares the views of a fused scan, and fuses it again where that tells another white level than it was fused with.
    /// `None` if it stays as it is.
    pub fn revise(
        &mut self,
        fusion: &Fusion,
        info: &CameraInfo,
        params: &FusionParams,
    ) -> Option<Revised> {
        let mut search = WhiteSearch::from(self.live?);
        let mut revised: Option<Revised> = None;
        for revision in 0..=self.max_revisions {
            let current = revised.as_ref().map_or(fusion, |revised| &revised.fusion);
            let evidence = self.evidence(current)?;
            tracing::info!(
                white_level = self.white.map(|white| white.0),
                strength_change = evidence.slope,
                sigma = evidence.sigma,
                disagreement_mm = 1e3 * evidence.residual_m,
                patches = evidence.n_patches,
                "multipath: how well the views of one place agree"
            );
            if self.is_measured || revision == self.max_revisions {
                break;
            }
            let Some(next) = search.next(self.white, evidence) else {
                break;
            };
            let again = self.fuse_again(current, next, info, params, revised.as_ref())?;
            self.white = next;
            revised = Some(again);
        }
        revised
    }

    /// The depth (m) of a frame of the scan, corrected for what was known at its end.
    pub fn revised_depth(&self, depth_m: &Image<f32>, time_secs: f64) -> Image<f32> {
        match self.bias_near(time_secs) {
            Some(bias) => self
                .multipath
                .corrected(depth_m, bias, self.live, self.white),
            None => depth_m.clone(),
        }
    }

    /// The prediction nearest in time.
    fn bias_near(&self, time_secs: f64) -> Option<&RangeBias> {
        let time = nanos(time_secs);
        let before = self.biases.range(..=time).next_back();
        let after = self.biases.range(time..).next();
        let nearest = before
            .into_iter()
            .chain(after)
            .min_by_key(|(t, _)| (*t - time).abs());
        nearest.map(|(_, bias)| bias)
    }

    fn evidence(&self, fusion: &Fusion) -> Option<Evidence> {
        let frames = fusion.keyframes();
        let every = frames.len().div_ceil(MAX_VIEWS).max(1);
        let views: Vec<_> = frames
            .iter()
            .step_by(every)
            .filter_map(|frame| {
                Some((
                    frame.depth_m(),
                    frame.world_from_camera,
                    self.bias_near(frame.time_secs)?,
                ))
            })
            .collect();
        let seen: Vec<Seen> = views
            .iter()
            .map(|(depth_m, world_from_camera, bias)| Seen {
                depth_m,
                world_from_camera,
                bias,
            })
            .collect();
        self.multipath
            .evidence(&seen, self.white, |point| fusion.signed_distance(point))
    }

    /// Fuses all frames again with the multipath of another white level; `None` if too many are lost that way.
    fn fuse_again(
        &self,
        before: &Fusion,
        white: Option<WhiteLevel>,
        info: &CameraInfo,
        params: &FusionParams,
        revised: Option<&Revised>,
    ) -> Option<Revised> {
        let camera = CameraModel::new(info.intrinsics);
        let noise = DepthNoise::of_sensor(info.sensor);
        let mut fusion = Fusion::new(camera, noise, params.clone());
        let (mut knots, mut last) = (Vec::new(), None);
        let frames = before.keyframes();
        for frame in frames {
            let is_apart = last.is_some_and(|(time_secs, stretch)| {
                frame.time_secs - time_secs > MAX_GAP_SECS || frame.stretch != stretch
            });
            if is_apart {
                fusion.interrupt();
            }
            last = Some((frame.time_secs, frame.stretch));
            let depth = frame.depth_m();
            let depth = match self.bias_near(frame.time_secs) {
                Some(bias) => self.multipath.corrected(&depth, bias, self.white, white),
                None => depth,
            };
            let outcome = fusion.fuse(&depth, frame.time_secs);
            if let TrackingOutcome::Tracked {
                world_from_camera, ..
            } = outcome
            {
                let earlier = revised.map_or_else(Pose::identity, |revised| {
                    revised.correction.at(frame.time_secs)
                });
                let moved = world_from_camera * frame.world_from_camera.inverse() * earlier;
                knots.push((frame.time_secs, moved));
            }
        }
        let n_lost = frames.len() - knots.len();
        if n_lost as f64 > MAX_LOST_SHARE * frames.len() as f64 {
            tracing::warn!(
                n_lost,
                "multipath: fused again, the scan loses its track, and stays as it was"
            );
            return None;
        }
        Some(Revised {
            fusion,
            correction: PoseCorrection::of_knots(knots),
        })
    }
}

fn nanos(time_secs: f64) -> i64 {
    (1e9 * time_secs).round() as i64
}
