//! What a sensor gets wrong, taken off the depth of a scan as well as it is known while the scan goes on, and, when the scan
//! itself has told more, once more at its end.

use crate::{
    fusion::{
        DepthField, DepthNoise, Fusion, FusionParams, GoesOn, Keyframe, PoseCorrection,
        TrackingOutcome,
    },
    geometry::{CameraModel, Pose, RayGrid},
    interreflection::WhiteLevel,
    multipath::{Evidence, Multipath, RangeBias, Seen, WhiteSearch},
    shading::Calibration,
};
use depth_camera::{CameraInfo, Frame, Image, Sensor};
use std::collections::{BTreeMap, BTreeSet};

/// Corrects the depth of one scan.
pub struct DepthCorrection {
    info: CameraInfo,
    rays: RayGrid,
    fusion: FusionParams,
    /// `None` for a sensor that suffers from none, or where it is not wanted.
    multipath: Option<Multipath>,
    /// The white level that frames are corrected for while the scan goes on; `None` before the first.
    live: Option<WhiteLevel>,
    /// Whether the device's calibration tells it.
    is_measured: bool,
    /// Predicted multipath of the frames, by time in nanoseconds of the device's clock.
    biases: BTreeMap<i64, RangeBias>,
}

/// A scan fused again with its depth corrected otherwise.
pub struct Revised {
    /// The model.
    pub fusion: Fusion,
    /// How far every pose is moved, by time.
    pub correction: PoseCorrection,
    white: Option<WhiteLevel>,
    field: Option<DepthField>,
}

/// How far revising a scan came.
struct Settled {
    revised: Option<Revised>,
    search: Option<WhiteSearch>,
    /// What the scan tells as it now is; `None` if that was not asked since it was fused last.
    evidence: Option<Evidence>,
}

/// A device's white level as one scan tells it.
#[derive(Clone, Copy, Debug)]
pub struct MeasuredWhite {
    /// The white level.
    pub white: WhiteLevel,
    /// Its standard deviation as a share of it: what views tell and what is plausible together.
    pub relative_sigma: f64,
    /// How well views agree with it.
    pub evidence: Evidence,
}

/// Most frames whose views are compared at the end of a scan.
const MAX_VIEWS: usize = 60;
/// A revision that loses more than this share of the frames is not used.
const MAX_LOST_SHARE: f64 = 0.05;
/// Where frames are missing for longer, seconds, another place may follow.
const MAX_GAP_SECS: f64 = 0.2;
/// A field that changes by less, metres at a metre, is not worth fusing again.
const MIN_FIELD_M: f64 = 1e-4;
/// Predictions are thinned out to those of the frames that fusion still holds when there are so many more; arbitrary.
const MAX_SPARE_BIASES: usize = 256;

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
        DepthCorrection {
            info: info.clone(),
            rays: RayGrid::new(CameraModel::new(info.intrinsics)),
            fusion: fusion.clone(),
            multipath: multipath.flatten(),
            live: measured.map(WhiteLevel),
            is_measured: measured.is_some(),
            biases: BTreeMap::new(),
        }
    }

    /// A frame without its multipath; `None` if nothing can be predicted for it.
    pub fn correct(&mut self, frame: &Frame) -> Option<Frame> {
        let multipath = self.multipath.as_ref()?;
        let prediction = multipath.predict(frame)?;
        self.live.get_or_insert(prediction.plausible_white);
        let bias = prediction.bias;
        let depth = multipath.corrected(frame.depth.as_ref()?, &bias, None, self.live);
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
        if self.biases.len() > frames.len() + MAX_SPARE_BIASES {
            let held: BTreeSet<i64> = frames.iter().map(|frame| nanos(frame.time_secs)).collect();
            self.biases.retain(|time, _| held.contains(time));
        }
    }

    /// The white level of the device by a scan that was fused as corrected here, refined by how its views agree; `None` where
    /// views agree best without multipath, or show none.
    pub fn measure_white(&self, fusion: &Fusion) -> Option<MeasuredWhite> {
        let Settled {
            revised,
            search,
            evidence,
        } = self.settled(fusion, &|| true);
        let fused_again = revised.as_ref().map_or(fusion, |revised| &revised.fusion);
        let white = revised
            .as_ref()
            .map_or(self.live, |revised| revised.white)?;
        let evidence = evidence.or_else(|| self.evidence(fused_again, Some(white), None))?;
        Some(MeasuredWhite {
            white,
            relative_sigma: search?.relative_sigma(white),
            evidence,
        })
    }

    /// Compares the views of a fused scan with its model, and fuses it again as long as that tells of errors that were not
    /// taken off. `None` if it stays as it is; as soon as `goes_on` says no, what was fused again in whole counts.
    pub fn revise(&self, fusion: &Fusion, goes_on: &GoesOn) -> Option<Revised> {
        self.settled(fusion, goes_on).revised
    }

    fn settled(&self, fusion: &Fusion, goes_on: &GoesOn) -> Settled {
        let mut search = self.live.map(WhiteSearch::from);
        let mut revised: Option<Revised> = None;
        let mut told = None;
        for _ in 0..self.fusion.max_revisions {
            if !goes_on() {
                break;
            }
            let white = revised.as_ref().map_or(self.live, |revised| revised.white);
            let current = revised.as_ref().map_or(fusion, |revised| &revised.fusion);
            let field = self.field(current);
            told = self.evidence(current, white, field.as_ref());
            let next_white = told
                .zip(search.as_mut())
                .and_then(|(evidence, search)| search.next(white, evidence));
            if field.is_none() && next_white.is_none() {
                break;
            }
            let change = Change {
                from: white,
                to: next_white.unwrap_or(white),
                field,
            };
            match self.fuse_again(current, change, revised.as_ref(), goes_on) {
                Some(again) => (revised, told) = (Some(again), None),
                None => break,
            }
        }
        Settled {
            revised,
            search,
            evidence: told,
        }
    }

    /// The depth (m) of a frame of the scan as it was corrected while the scan went on, corrected for what a revision knows.
    pub fn revised_depth(
        &self,
        depth_m: &Image<f32>,
        time_secs: f64,
        revised: &Revised,
    ) -> Image<f32> {
        let change = Change {
            from: self.live,
            to: revised.white,
            field: revised.field.clone(),
        };
        self.changed(depth_m, time_secs, &change)
    }

    fn changed(&self, depth_m: &Image<f32>, time_secs: f64, change: &Change) -> Image<f32> {
        let bias = self.multipath.as_ref().zip(self.bias_near(time_secs));
        let depth = bias.map_or_else(
            || depth_m.clone(),
            |(multipath, bias)| multipath.corrected(depth_m, bias, change.from, change.to),
        );
        match &change.field {
            Some(field) => field.corrected(&depth),
            None => depth,
        }
    }

    /// The prediction nearest in time.
    fn bias_near(&self, time_secs: f64) -> Option<&RangeBias> {
        let time = nanos(time_secs);
        let before = self.biases.range(..=time).next_back();
        let after = self.biases.range(time..).next();
        let both = before.into_iter().chain(after);
        let nearest = both.min_by_key(|(other, _)| (**other - time).abs());
        nearest.map(|(_, bias)| bias)
    }

    /// The sensor's slow error that the frames of a scan still show.
    fn field(&self, fusion: &Fusion) -> Option<DepthField> {
        let is_wanted = self.fusion.depth_field && self.info.sensor == Sensor::Kinect1;
        let field = is_wanted.then(|| fusion.depth_field(&self.rays));
        field.flatten().filter(|field| field.rms() > MIN_FIELD_M)
    }

    /// What the views of a scan tell of its white level once a field is taken off.
    fn evidence(
        &self,
        fusion: &Fusion,
        white: Option<WhiteLevel>,
        field: Option<&DepthField>,
    ) -> Option<Evidence> {
        let multipath = self.multipath.as_ref().filter(|_| !self.is_measured)?;
        let frames = fusion.keyframes();
        let every = frames.len().div_ceil(MAX_VIEWS).max(1);
        let view = |frame: &Keyframe| {
            let depth = frame.depth_m();
            let corrected = field.map(|field| field.corrected(&depth));
            (corrected.unwrap_or(depth), frame.world_from_camera)
        };
        let frames = frames.iter().step_by(every);
        let views: Vec<_> = frames
            .filter_map(|frame| Some((view(frame), self.bias_near(frame.time_secs)?)))
            .collect();
        let seen: Vec<Seen> = views
            .iter()
            .map(|((depth_m, world_from_camera), bias)| Seen {
                depth_m,
                world_from_camera,
                bias,
            })
            .collect();
        let evidence = multipath.evidence(&seen, white, |point| fusion.signed_distance(point))?;
        tracing::info!(
            white_level = white.map(|white| white.0),
            strength_change = evidence.slope,
            sigma = evidence.sigma,
            disagreement_mm = 1e3 * evidence.residual_m,
            patches = evidence.n_patches,
            "multipath: how well the views of one place agree"
        );
        Some(evidence)
    }

    /// Fuses all frames again, corrected otherwise; `None` if too many are lost that way, or it shall not go on.
    fn fuse_again(
        &self,
        before: &Fusion,
        change: Change,
        revised: Option<&Revised>,
        goes_on: &GoesOn,
    ) -> Option<Revised> {
        let camera = CameraModel::new(self.info.intrinsics);
        let noise = DepthNoise::of_sensor(self.info.sensor);
        let mut fusion = Fusion::new(camera, noise, self.fusion.clone());
        let mut knots = Vec::new();
        let mut last: Option<&Keyframe> = None;
        let frames = before.keyframes();
        for frame in frames {
            if !goes_on() {
                return None;
            }
            let is_apart = last.is_some_and(|last| {
                frame.time_secs - last.time_secs > MAX_GAP_SECS || frame.stretch != last.stretch
            });
            if is_apart {
                fusion.interrupt();
            }
            last = Some(frame);
            let depth = self.changed(&frame.depth_m(), frame.time_secs, &change);
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
                "fused again with its depth corrected, the scan loses its track, and stays as it was"
            );
            return None;
        }
        let field_before = revised.and_then(|revised| revised.field.clone());
        let field = match (field_before, change.field) {
            (Some(before), Some(further)) => Some(before.plus(&further)),
            (before, further) => before.or(further),
        };
        tracing::info!(
            white_level = change.to.map(|white| white.0),
            field_rms_mm = field.as_ref().map(|field| 1e3 * field.rms()),
            "fused again with its depth corrected"
        );
        Some(Revised {
            fusion,
            correction: PoseCorrection::of_knots(knots),
            white: change.to,
            field,
        })
    }
}

/// From what depth was corrected for to what it is to be corrected for.
struct Change {
    from: Option<WhiteLevel>,
    to: Option<WhiteLevel>,
    /// What is to be taken off beside.
    field: Option<DepthField>,
}

fn nanos(time_secs: f64) -> i64 {
    (1e9 * time_secs).round() as i64
}
