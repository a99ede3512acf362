//! What a sensor gets wrong, taken off the depth of a scan as well as it is known while the scan goes on, and, since the scan
//! itself tells more, once more at its end: how strong multipath is, and what surface it falls on.

mod carry;

use crate::{
    fusion::{
        DepthField, DepthNoise, Fusion, FusionParams, GoesOn, PoseCorrection, RollingShutter,
        TrackingOutcome, Waypoint, Work, velocities,
    },
    geometry::{CameraModel, Motion, Pose, RayGrid},
    interreflection::WhiteLevel,
    multipath::{Evidence, Multipath, Prediction, RangeBias, Seen, WhiteSearch},
    shading::Calibration,
};
use carry::Carry;
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
    /// The white level that revisions begin with, where another calibration was found since.
    recalibrated: Option<WhiteLevel>,
    /// Whether the device's calibration tells it.
    is_measured: bool,
    /// Predicted multipath of the frames, by time in nanoseconds of the device's clock.
    predictions: BTreeMap<i64, Prediction>,
}

/// A scan fused again with its depth corrected otherwise.
pub struct Revised {
    /// The model.
    pub fusion: Fusion,
    /// How far every pose is moved, by time.
    pub correction: PoseCorrection,
    known: Known,
}

/// What is taken off the depth of a scan.
#[derive(Clone)]
struct Known {
    /// `None` is no multipath.
    white: Option<WhiteLevel>,
    /// `None` is no slow error.
    field: Option<DepthField>,
    /// `None` is all rows at once.
    shutter: Option<RollingShutter>,
}

/// What was predicted for a frame, or for one near it whose own was forgotten.
struct Nearest<'a> {
    prediction: &'a Prediction,
    is_its_own: bool,
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
/// The first so many revisions free depth of multipath on the model, whatever the views tell: the first model still shows what the
/// live prediction left.
const MODEL_ROUNDS: usize = 2;
/// What a Kinect I gets wrong is asked for before the first so many revisions. After three, what the frames still show of it is noise:
/// with a fourth the base mesh of `pot-k1` lies 0.40 mm off for 0.38.
const FIELD_ROUNDS: usize = 3;
/// A revision that loses more than this share of the frames is not used.
const MAX_LOST_SHARE: f64 = 0.05;
/// A field that changes by less, metres at a metre, is not worth fusing again.
const MIN_FIELD_M: f64 = 1e-4;
/// How far a frame whose rows are put right may lie from where it would by its motion since the one before: where tracking had slid
/// along a far surface for want of a rigid image, it was off by 4 cm and 0.08 rad.
const SHUTTER_REACH: Motion = Motion {
    rotation_rad: 0.15,
    translation_m: 0.08,
};
/// Predictions are thinned out to those of the frames that fusion still holds when there are so many more; arbitrary.
const MAX_SPARE_PREDICTIONS: usize = 256;

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
            recalibrated: None,
            is_measured: measured.is_some(),
            predictions: BTreeMap::new(),
        }
    }

    /// A frame without its multipath; `None` if nothing can be predicted for it.
    pub fn correct(&mut self, frame: &Frame) -> Option<Frame> {
        let multipath = self.multipath.as_ref()?;
        let prediction = multipath.predict(frame)?;
        self.live.get_or_insert(prediction.plausible_white);
        let depth = multipath.corrected(frame.depth.as_ref()?, &prediction.bias, None, self.live);
        self.predictions
            .insert(nanos(frame.device_time_secs), prediction);
        Some(Frame {
            frame_id: frame.frame_id,
            device_time_secs: frame.device_time_secs,
            host_time: frame.host_time,
            depth: Some(depth),
            ir: frame.ir.clone(),
        })
    }

    /// Goes on with another calibration, by which the scan is to be revised; frames that were corrected stay as they are.
    pub fn recalibrate(&mut self, calibration: &Calibration, fusion: &Fusion) {
        let by = Multipath::new(&self.info, calibration);
        let (Some(before), Some(by)) = (&self.multipath, by) else {
            return;
        };
        for prediction in self.predictions.values_mut() {
            before.recalibrate(prediction, &by);
        }
        if self.is_measured {
            self.recalibrated = calibration.light.white_level.map(WhiteLevel);
        } else if let Some(first) = fusion.keyframes().first() {
            let nearest = self.prediction_near(first.time_secs);
            self.recalibrated =
                nearest.and_then(|near| by.plausible_white(&first.depth_m(), near.prediction));
        }
        self.multipath = Some(by);
    }

    /// Forgets the predictions of frames that fusion does not hold any more.
    pub fn thin_out(&mut self, fusion: &Fusion) {
        let frames = fusion.keyframes();
        if self.predictions.len() > frames.len() + MAX_SPARE_PREDICTIONS {
            let held: BTreeSet<i64> = frames.iter().map(|frame| nanos(frame.time_secs)).collect();
            self.predictions.retain(|time, _| held.contains(time));
        }
    }

    /// The white level of the device by a scan that was fused as corrected here, refined by how its views agree; `None` where
    /// views agree best without multipath, or show none.
    pub fn measure_white(&self, fusion: &Fusion) -> Option<MeasuredWhite> {
        let Settled {
            revised,
            search,
            evidence,
        } = self.settled(fusion, &|_| true);
        let fused_again = revised.as_ref().map_or(fusion, |revised| &revised.fusion);
        let white = revised
            .as_ref()
            .map_or(self.live, |revised| revised.known.white)?;
        let evidence = evidence.or_else(|| self.evidence(fused_again, Some(white)))?;
        Some(MeasuredWhite {
            white,
            relative_sigma: search?.relative_sigma(white),
            evidence,
        })
    }

    /// Fuses a scan again as long as it tells of errors that were not taken off: multipath at least twice, for a model tells
    /// the slant of the surface better than single frames do, and what was fused on one is a better one; after that its views tell
    /// how strong it is. `None` if it stays as
    /// it is; as soon as `goes_on` says no, what was fused again in whole counts.
    pub fn revise(&self, fusion: &Fusion, goes_on: &GoesOn) -> Option<Revised> {
        self.settled(fusion, goes_on).revised
    }

    fn settled(&self, fusion: &Fusion, goes_on: &GoesOn) -> Settled {
        let start = self.recalibrated.or(self.live);
        let mut search = start.map(WhiteSearch::from);
        let mut revised: Option<Revised> = None;
        let mut told = None;
        // Without memory for them no frames are kept; and a white level may be known of a sensor whose depth is not freed of multipath.
        let can_be_fused = !fusion.keyframes().is_empty();
        let has_multipath = self.multipath.is_some() && self.live.is_some() && can_be_fused;
        for round in 0..self.fusion.max_revisions {
            let work = Work::CorrectDepth(round + 1);
            if !goes_on(work.at(0, fusion.keyframes().len())) {
                break;
            }
            let current = revised.as_ref().map_or(fusion, |revised| &revised.fusion);
            let mut known = revised.as_ref().map_or_else(
                || Known {
                    white: start,
                    field: None,
                    shutter: None,
                },
                |revised| revised.known.clone(),
            );
            let mut has_more = has_multipath && round < MODEL_ROUNDS;
            let asks_field = round < FIELD_ROUNDS;
            if let Some(shown) = asks_field.then(|| self.field(current)).flatten() {
                has_more = true;
                let further = shown.in_full();
                known.field = Some(match &known.field {
                    Some(before) => before.plus(&further),
                    None => further,
                });
            }
            if let Some(further) = asks_field.then(|| self.shutter(current)).flatten() {
                has_more = true;
                known.shutter = Some(
                    known
                        .shutter
                        .map_or(further, |before| before.plus(&further)),
                );
            }
            if revised.is_some() {
                told = self.evidence(current, known.white);
                if let Some((evidence, search)) = told.zip(search.as_mut()) {
                    let next = search.next(known.white, evidence);
                    has_more |= !next.will_do;
                    known.white = next.white;
                }
            }
            if !has_more {
                break;
            }
            match self.fuse_again(fusion, revised.as_ref(), known, work, goes_on) {
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
        let is_predicted = self.predictions.contains_key(&nanos(time_secs));
        self.live.filter(|_| is_predicted)
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
        let predicted = self.multipath.as_ref().zip(self.prediction_near(time_secs));
        let depth = predicted.map_or_else(
            || depth_m.clone(),
            |(multipath, nearest)| {
                let bias = bias_on(model, multipath, depth_m, &nearest, world_from_camera);
                let raw = multipath.corrected(depth_m, &nearest.prediction.bias, by, None);
                multipath.corrected(&raw, &bias, None, known.white)
            },
        );
        match &known.field {
            Some(field) => field.corrected(&depth),
            None => depth,
        }
    }

    /// The prediction nearest in time.
    fn prediction_near(&self, time_secs: f64) -> Option<Nearest<'_>> {
        let time = nanos(time_secs);
        let before = self.predictions.range(..=time).next_back();
        let after = self.predictions.range(time..).next();
        let both = before.into_iter().chain(after);
        let nearest = both.min_by_key(|(other, _)| (**other - time).abs());
        nearest.map(|(&other, prediction)| Nearest {
            prediction,
            is_its_own: other == time,
        })
    }

    /// The sensor's slow error that the frames of a scan still show.
    fn field(&self, fusion: &Fusion) -> Option<DepthField> {
        let is_wanted = self.fusion.depth_field && self.info.sensor == Sensor::Kinect1;
        let field = is_wanted.then(|| fusion.depth_field(&self.rays));
        field.flatten().filter(|field| field.rms() > MIN_FIELD_M)
    }

    /// How long the sensor takes to read its rows, as far as the frames of a scan still show it.
    fn shutter(&self, fusion: &Fusion) -> Option<RollingShutter> {
        let is_wanted = self.fusion.rolling_shutter && self.info.sensor == Sensor::Kinect1;
        is_wanted
            .then(|| fusion.rolling_shutter(&self.rays))
            .flatten()
    }

    /// What the views of a scan that was fused with a white level tell of it.
    fn evidence(&self, fusion: &Fusion, white: Option<WhiteLevel>) -> Option<Evidence> {
        let multipath = self.multipath.as_ref().filter(|_| !self.is_measured)?;
        let frames = fusion.keyframes();
        let every = frames.len().div_ceil(MAX_VIEWS).max(1);
        let views: Vec<(Image<f32>, &Pose, RangeBias)> = frames
            .iter()
            .step_by(every)
            .filter_map(|frame| {
                let nearest = self.prediction_near(frame.time_secs)?;
                let (depth, pose) = (frame.depth_m(), &frame.world_from_camera);
                let bias = bias_on(fusion, multipath, &depth, &nearest, pose);
                let bias = multipath.by_patches(&bias);
                Some((depth, pose, bias))
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
        let evidence = multipath.evidence(&seen, white, |point| fusion.signed_distance(point))?;
        tracing::info!(
            white_level = white.map(|white| white.0),
            strength_change = evidence.slope,
            sigma = evidence.sigma,
            predicted_mm = 1e3 * evidence.predicted_m,
            disagreement_mm = 1e3 * evidence.residual_m,
            patches = evidence.n_patches,
            "multipath: how well the views of one place agree"
        );
        Some(evidence)
    }

    /// Fuses all frames again, near where they lie by now, with what is known taken off; `None` if too many are lost that way, or
    /// it shall not go on.
    fn fuse_again(
        &self,
        original: &Fusion,
        revised: Option<&Revised>,
        known: Known,
        work: Work,
        goes_on: &GoesOn,
    ) -> Option<Revised> {
        let model = revised.map_or(original, |revised| &revised.fusion);
        let camera = CameraModel::new(self.info.intrinsics);
        let noise = DepthNoise::of_sensor(self.info.sensor);
        let mut fusion = Fusion::new(camera, noise, self.fusion.clone());
        let mut knots = Vec::new();
        let mut n_lost = 0;
        let frames = original.keyframes();
        let path: Vec<Waypoint> = frames
            .iter()
            .map(|frame| {
                let (time_secs, tracked) = (frame.time_secs, &frame.world_from_camera);
                let here = revised.map_or(*tracked, |revised| {
                    revised.correction.apply(time_secs, tracked)
                });
                Waypoint::of(frame, here)
            })
            .collect();
        let velocities = velocities(&path);
        let is_given = original.is_at_given_poses();
        let reach = known.shutter.filter(|_| !is_given).map(|_| SHUTTER_REACH);
        let mut carry = Carry::default();
        for (n_done, (frame, velocity)) in frames.iter().zip(&velocities).enumerate() {
            if !goes_on(work.at(n_done, frames.len())) {
                return None;
            }
            let (time_secs, tracked) = (frame.time_secs, &frame.world_from_camera);
            let before = path[n_done].world_from_camera;
            let seen = (&frame.depth_m(), self.corrected_by(time_secs));
            let mut depth = self.anew(seen, time_secs, &before, model, &known);
            if let Some(shutter) = &known.shutter {
                depth = shutter.corrected(&depth, velocity, &self.rays, &noise);
            }
            let here = carry.to(frame.stretch, &before) * before;
            let outcome = match is_given && !self.fusion.polish.enabled {
                true => fusion.fuse_anew_at(&depth, frame, &here),
                false => fusion.fuse_anew(&depth, frame, &here, reach),
            };
            let TrackingOutcome::Tracked {
                world_from_camera,
                fit,
            } = outcome
            else {
                n_lost += 1;
                continue;
            };
            n_lost += usize::from(fit.is_none() && !knots.is_empty() && !is_given);
            if reach.is_some() {
                carry.note(frame.stretch, before, &world_from_camera);
            }
            knots.push((time_secs, world_from_camera * tracked.inverse()));
        }
        if n_lost as f64 > MAX_LOST_SHARE * frames.len() as f64 {
            tracing::warn!(
                n_lost,
                "fused again with its depth corrected, the scan loses its track, and stays as it was"
            );
            return None;
        }
        tracing::info!(
            white_level = known.white.map(|white| white.0),
            field_rms_mm = known.field.as_ref().map(|field| 1e3 * field.rms()),
            readout_ms = known.shutter.map(|shutter| 1e3 * shutter.readout_secs),
            "fused again with its depth corrected"
        );
        Some(Revised {
            fusion,
            correction: PoseCorrection::of_knots(knots),
            known,
        })
    }
}

/// The multipath of a frame by the slant of a model's surface at a pose.
fn bias_on(
    model: &Fusion,
    multipath: &Multipath,
    depth_m: &Image<f32>,
    nearest: &Nearest,
    world_from_camera: &Pose,
) -> RangeBias {
    let Nearest {
        prediction,
        is_its_own,
    } = *nearest;
    let to_camera = world_from_camera.rotation.inverse();
    multipath.predict_on(depth_m, prediction, is_its_own, |point| {
        let measured = world_from_camera * point;
        let (distance, gradient) = model.signed_distance(&measured)?;
        // On the surface itself, for noise lifts points off it.
        let on_surface = model.signed_distance(&(measured - distance * gradient));
        let gradient = on_surface.map_or(gradient, |(_, gradient)| gradient);
        Some(to_camera * gradient)
    })
}

fn nanos(time_secs: f64) -> i64 {
    (1e9 * time_secs).round() as i64
}

#[cfg(test)]
mod tests;
