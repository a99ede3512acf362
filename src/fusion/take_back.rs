//! Taking frames back: the model as if the last ones had not been fused.
//!
//! A volume does not remember what each frame brought, so that those which stay are fused anew, from their packed depth and
//! at the poses at which they were fused. Where memory was short, those of them that are kept count for those that are not.

use super::fused_volume::FusedVolume;
use super::improvement::{Counted, Improvement, Work};
use super::locate::Before;
use super::track::Track;
use super::{Fusion, PoseCorrection};
use crate::geometry::Pose;

impl Fusion {
    /// Takes back every frame later than `after_secs` of the device's clock. The next frame is tracked as after an
    /// interruption, or begins the model anew if none is left. False, and nothing is changed, if some frames are to stay
    /// and none was kept. `told` hears how far it is: after a long scan it takes a minute.
    pub fn take_back(&mut self, after_secs: f64, told: &(dyn Fn(Improvement) + Sync)) -> bool {
        let n_left = self.n_kept_until(after_secs);
        if after_secs > f64::NEG_INFINITY && self.keyframes.frames().is_empty() {
            return false;
        }
        self.keyframes.truncate(n_left);
        self.places.forget_after(after_secs);
        self.revisits.forget_after(after_secs);
        if let Some(infrared) = &mut self.infrared {
            infrared.forget_after(after_secs);
        }
        // The old volume goes first: two of them might not find room.
        self.replace_volume(FusedVolume::untouched(self.params.empty_volume()));
        let (frames, nowhere) = (self.keyframes.frames(), PoseCorrection::default());
        // What is half taken back is no model: it cannot be stopped.
        let goes_on = |improvement| {
            told(improvement);
            true
        };
        let step = Counted::new(Work::TakeBack, frames.len(), &goes_on);
        self.fused
            .fuse_again(frames, &nowhere, &self.eye, &|| step.goes_on());
        self.stretch = self.n_fused;
        self.interrupt();
        self.stand_at_last();
        true
    }

    fn n_kept_until(&self, after_secs: f64) -> usize {
        self.keyframes.frames().len() - self.keyframes.after(after_secs).len()
    }

    /// Stands where the last frame that is left was taken.
    fn stand_at_last(&mut self) {
        let Some(last) = self.keyframes.frames().last() else {
            self.seen = None;
            (self.n_fused, self.stretch) = (0, 0);
            self.track = Track::at(Pose::identity(), 0.0);
            self.before = Before::Tracked;
            return;
        };
        let (pose, time_secs) = (last.world_from_camera, last.time_secs);
        self.eye.take_kept(&last.depth_m(), last.n_frames);
        self.stand_at(&pose);
        self.track = Track::at(pose, time_secs);
    }
}

#[cfg(test)]
mod tests {
    use crate::fusion::tests::{frames, small_params};
    use crate::fusion::{DepthNoise, Fusion, Improvement, LiveMesh, TrackingOutcome, Work};
    use crate::geometry::{CameraModel, motion_between};
    use depth_camera::{Frame, Sensor};
    use std::sync::atomic::{AtomicUsize, Ordering};

    fn fused(frames: &[Frame], camera: CameraModel) -> Fusion {
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let mut fusion = Fusion::new(camera, noise, small_params());
        for frame in frames {
            fuse(&mut fusion, frame);
        }
        fusion
    }

    fn fuse(fusion: &mut Fusion, frame: &Frame) -> TrackingOutcome {
        let depth = frame.depth.as_ref().expect("Kinect II");
        fusion.fuse(depth, frame.device_time_secs)
    }

    #[test]
    fn what_is_left_is_the_model_of_the_frames_before_and_tracking_goes_on() {
        let (frames, truth, camera) = frames(9);
        let before = fused(&frames[..5], camera);
        let mut fusion = fused(&frames[..8], camera);
        let mut live = LiveMesh::default();
        fusion.refresh(&mut live);
        let cut = 0.5 * (frames[4].device_time_secs + frames[5].device_time_secs);
        let n_told = AtomicUsize::new(0);
        let told = |at: Improvement| {
            assert_eq!((at.work, at.n_in_all), (Work::TakeBack, 5));
            n_told.fetch_add(1, Ordering::Relaxed);
        };
        assert!(fusion.take_back(cut, &told));
        assert_eq!(n_told.into_inner(), 5);
        assert_eq!(fusion.keyframes().len(), 5);
        let (left, expected) = (fusion.mesh(), before.mesh());
        // Depth was packed in steps of 0.1 mm: surface appears and vanishes at the rims alone.
        let ratio = left.area_m2() / expected.area_m2();
        assert!((ratio - 1.0).abs() < 0.01, "{ratio}");
        let n_far = left.vertices.iter().filter(|vertex| {
            let off = before.signed_distance(vertex);
            off.is_none_or(|(distance, _)| distance.abs() > 2e-4)
        });
        assert!(n_far.count() * 100 < left.vertices.len());
        // A mesh of the model as it was is made anew.
        fusion.refresh(&mut live);
        assert_eq!(live.mesh().faces.len(), left.faces.len());

        let TrackingOutcome::Tracked {
            world_from_camera, ..
        } = fuse(&mut fusion, &frames[5])
        else {
            panic!("the next frame is tracked");
        };
        let off = motion_between(&truth[5], &world_from_camera);
        assert!(off.translation_m < 0.002, "{off:?}");
    }

    #[test]
    fn a_model_of_which_nothing_is_left_begins_anew() {
        let (frames, _, camera) = frames(3);
        let mut fusion = fused(&frames, camera);
        assert!(fusion.take_back(f64::NEG_INFINITY, &|_| {}));
        assert!(fusion.mesh().faces.is_empty() && fusion.model().is_none());
        assert_eq!(fusion.n_fused(), 0);
        assert!(matches!(
            fuse(&mut fusion, &frames[2]),
            TrackingOutcome::Tracked { fit: None, .. }
        ));
        assert_eq!(fusion.n_fused(), 1);
    }

    #[test]
    fn frames_at_given_poses_are_taken_back_and_none_where_none_is_kept() {
        let (frames, truth, camera) = frames(6);
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let taken_back = |max_memory_mb: usize| {
            let mut params = small_params();
            params.loop_closing.max_memory_mb = max_memory_mb;
            let mut given = Fusion::new(camera, noise, params);
            for (k, frame) in frames.iter().enumerate() {
                given.fuse_at(
                    frame.depth.as_ref().expect("Kinect II"),
                    k as f64,
                    &truth[k],
                );
            }
            let before = given.mesh().faces.len();
            (
                given.take_back(3.5, &|_| {}),
                before,
                given.mesh().faces.len(),
            )
        };
        let (is_done, before, after) = taken_back(512);
        assert!(
            is_done && after > 0 && after != before,
            "{before} -> {after}"
        );
        let (is_done, before, after) = taken_back(0);
        assert!(!is_done && after == before);
    }
}
