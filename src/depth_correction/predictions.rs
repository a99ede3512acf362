//! The multipath that was predicted for the frames of a scan.

use crate::{
    fusion::Fusion,
    geometry::Pose,
    multipath::{Multipath, Prediction, RangeBias},
};
use depth_camera::Image;
use std::collections::{BTreeMap, BTreeSet};

/// One a frame, by time in nanoseconds of the device's clock.
#[derive(Default)]
pub(super) struct Predictions(pub(super) BTreeMap<i64, Prediction>);

/// What was predicted for a frame, or for one near it whose own was forgotten.
pub(super) struct Nearest<'a> {
    pub(super) prediction: &'a Prediction,
    is_its_own: bool,
}

/// They are thinned out to those of the frames that fusion still holds when there are so many more; arbitrary.
const MAX_SPARE: usize = 256;

impl Predictions {
    /// Keeps that of a frame.
    pub(super) fn insert(&mut self, time_secs: f64, prediction: Prediction) {
        self.0.insert(nanos(time_secs), prediction);
    }

    /// Whether a frame has its own.
    pub(super) fn has(&self, time_secs: f64) -> bool {
        self.0.contains_key(&nanos(time_secs))
    }

    /// The nearest in time.
    pub(super) fn near(&self, time_secs: f64) -> Option<Nearest<'_>> {
        let time = nanos(time_secs);
        let before = self.0.range(..=time).next_back();
        let after = self.0.range(time..).next();
        let both = before.into_iter().chain(after);
        let nearest = both.min_by_key(|(other, _)| (**other - time).abs());
        nearest.map(|(&other, prediction)| Nearest {
            prediction,
            is_its_own: other == time,
        })
    }

    /// Lets all tell what they would by another calibration.
    pub(super) fn recalibrate(&mut self, before: &Multipath, by: &Multipath) {
        for prediction in self.0.values_mut() {
            before.recalibrate(prediction, by);
        }
    }

    /// Forgets those of frames that fusion does not hold any more.
    pub(super) fn thin_out(&mut self, fusion: &Fusion) {
        let frames = fusion.keyframes();
        if self.0.len() > frames.len() + MAX_SPARE {
            let held: BTreeSet<i64> = frames.iter().map(|frame| nanos(frame.time_secs)).collect();
            self.0.retain(|time, _| held.contains(time));
        }
    }
}

impl Nearest<'_> {
    /// The multipath of the frame by the slant of a model's surface at a pose.
    pub(super) fn bias_on(
        &self,
        model: &Fusion,
        multipath: &Multipath,
        depth_m: &Image<f32>,
        world_from_camera: &Pose,
    ) -> RangeBias {
        let to_camera = world_from_camera.rotation.inverse();
        multipath.predict_on(depth_m, self.prediction, self.is_its_own, |point| {
            let measured = world_from_camera * point;
            let (distance, gradient) = model.signed_distance(&measured)?;
            // On the surface itself, for noise lifts points off it.
            let on_surface = model.signed_distance(&(measured - distance * gradient));
            let gradient = on_surface.map_or(gradient, |(_, gradient)| gradient);
            Some(to_camera * gradient)
        })
    }
}

pub(super) fn nanos(time_secs: f64) -> i64 {
    (1e9 * time_secs).round() as i64
}
