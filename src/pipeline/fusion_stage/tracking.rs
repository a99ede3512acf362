//! What becomes of a frame: it is tracked and fused, or not, and considered for shading.

use super::FusionStage;
use crate::{
    capture::{EventKind, Tracked},
    fusion::TrackingOutcome,
    geometry::{Pose, motion_between},
    pipeline::{accounts::Place, conditions::WEAK_FITNESS, losses::sentence},
    snapshot::{PartOfModel, TrackedFrame},
};
use depth_camera::Frame;
use std::sync::Arc;

impl FusionStage {
    /// What became of a frame; `None` where poses are given, none is near, and it would be needed.
    pub(super) fn fuse(&mut self, frame: &Frame) -> Option<TrackingOutcome> {
        let Some(depth) = &frame.depth else {
            return Some(TrackingOutcome::NoDepth);
        };
        let time_secs = frame.device_time_secs;
        let given = self.poses.as_ref().and_then(|poses| poses.at(time_secs));
        let (fusion, pool, polish) = (&mut self.fusion, &self.pool, self.polish);
        if self.poses.is_some() && given.is_none() {
            // While the projector is covered nobody may have measured where the camera is, and shading images come all the same.
            let sees_depth = pool.install(|| fusion.sees_depth(depth));
            return (!sees_depth).then_some(TrackingOutcome::NoDepth);
        }
        if let (Some(ir), None) = (&frame.ir, &given) {
            fusion.see(ir);
        }
        let outcome = self.fusion_clock.time(|| {
            pool.install(|| match given {
                Some(pose) if polish => fusion.fuse_near(depth, time_secs, &pose),
                Some(pose) => fusion.fuse_at(depth, time_secs, &pose),
                None => fusion.fuse(depth, time_secs),
            })
        });
        Some(outcome)
    }

    /// Tells what became of a frame.
    pub(super) fn account(&mut self, frame: &Frame, outcome: Option<&TrackingOutcome>) -> Place {
        match outcome {
            Some(TrackingOutcome::Tracked {
                world_from_camera,
                fit,
            }) => {
                self.found(frame, world_from_camera);
                self.note_fitness(frame, fit.map(|fit| fit.fitness));
                Place::Fused
            }
            Some(TrackingOutcome::NoDepth) => {
                self.summary.n_without_depth += 1;
                if std::mem::replace(&mut self.had_depth, false) {
                    self.tell(frame, EventKind::NoDepth);
                }
                Place::WithoutDepth
            }
            Some(TrackingOutcome::Lost(reason)) => self.lost(frame, sentence(reason)),
            None => self.lost(frame, "no given pose within 20 ms".to_owned()),
        }
    }

    fn found(&mut self, frame: &Frame, world_from_camera: &Pose) {
        self.had_depth = true;
        self.summary.n_fused += 1;
        if self.summary.losses.end() {
            tracing::info!(frame_id = frame.frame_id, "tracking found back");
            self.tell(frame, EventKind::Found);
        }
        if let Some((_, previous)) = self.trajectory.last() {
            self.summary.path_length_m += motion_between(previous, world_from_camera).translation_m;
        }
        self.trajectory
            .push((frame.device_time_secs, *world_from_camera));
        self.send(Tracked::Pose(frame.device_time_secs, *world_from_camera));
        self.last_depth.clone_from(&frame.depth);
    }

    /// Tells when the camera is about to be lost, once each time.
    fn note_fitness(&mut self, frame: &Frame, fitness: Option<f64>) {
        let is_weak = |fitness: Option<f64>| fitness.is_some_and(|fitness| fitness < WEAK_FITNESS);
        let was_weak = is_weak(std::mem::replace(&mut self.fitness, fitness));
        if let Some(fitness) = fitness
            && is_weak(self.fitness)
            && !was_weak
        {
            self.tell(frame, EventKind::Weak { fitness });
        }
    }

    fn lost(&mut self, frame: &Frame, reason: String) -> Place {
        self.had_depth = true;
        self.fitness = Some(0.0);
        self.summary.n_lost += 1;
        let time_secs = frame.device_time_secs;
        let is_new = self
            .summary
            .losses
            .extend(frame.frame_id, time_secs, &reason);
        if is_new {
            tracing::warn!(frame_id = frame.frame_id, reason, "tracking lost");
            let code = self.of_frames.reason().unwrap_or(self.of_frames.code());
            self.tell(frame, EventKind::Lost { reason, code });
        }
        Place::Lost
    }

    /// Shows a frame to the selector of shading images.
    pub(super) fn consider(&mut self, frame: &Arc<Frame>, outcome: &TrackingOutcome) {
        let Some(selector) = &mut self.selector else {
            return;
        };
        let (n_before, was_requested) = (selector.n_accepted(), selector.is_requested());
        let n_revoked = selector.n_revoked();
        let (pool, fusion) = (&self.pool, &mut self.fusion);
        self.selection_clock.time(|| {
            pool.install(|| {
                let model = match selector.looks_at(frame) {
                    PartOfModel::Nothing => None,
                    PartOfModel::NearAxis(reach_rad) => fusion.model_near_axis(reach_rad),
                    PartOfModel::All => fusion.model(),
                };
                selector.observe(&TrackedFrame {
                    frame,
                    outcome,
                    model,
                });
            });
        });
        let n_snapshots = selector.n_accepted();
        let is_granted = was_requested && !selector.is_requested();
        // A lit pose in place of an unlit one leaves the number as it was.
        let has_replaced = selector.n_revoked() != n_revoked;
        let is_candidate = selector.holds(frame.frame_id);
        self.showing.note(frame, selector.rejected());
        if is_candidate {
            self.send(Tracked::Candidate(frame.frame_id));
        }
        if n_snapshots != n_before || is_granted || has_replaced {
            self.tell(frame, EventKind::Snapshot { n_snapshots });
        }
        self.give_up_request(frame);
    }

    /// Says once that the model takes nothing more.
    pub(super) fn note_refusal(&mut self) {
        if self.summary.refusal.is_some() {
            return;
        }
        self.summary.refusal = self.fusion.refusal();
        if let Some(refusal) = &self.summary.refusal {
            tracing::warn!("{refusal}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{FusionSetup, ending_tests::setup};
    use super::*;
    use crate::{
        fusion::FusionParams,
        pipeline::{
            command::Command,
            edges,
            event_log::EventLog,
            given_poses::GivenPoses,
            stop_depth::{ShadingOutcome, ShadingRequest},
        },
    };
    use depth_camera::{DepthCamera, Image};
    use replay::TimedPose;
    use simulated::SimulatedCamera;
    use std::time::{Duration, Instant};

    #[test]
    fn a_covered_frame_without_a_given_pose_shows_no_depth_and_is_not_lost() {
        let mut camera = SimulatedCamera::kinect1_plaque(1, 7);
        let info = camera.info().clone();
        let frame = camera.grab(Duration::ZERO).expect("no errors");
        let frame = frame.expect("not the last");
        let first = TimedPose {
            time_secs: frame.device_time_secs,
            translation_m: [0.0; 3],
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        };
        let fusion = FusionParams {
            voxel_size_m: 0.004,
            ..FusionParams::default()
        };
        let (surfaces, _) = edges::surfaces();
        let setup = FusionSetup {
            poses: Some(GivenPoses::new(&[first])),
            ..setup(info, fusion, surfaces)
        };
        let (tracked, _told) = edges::tracked(&EventLog::default());
        let mut stage = FusionStage::new(setup, tracked);
        let outcome = stage.fuse(&frame);
        assert!(matches!(outcome, Some(TrackingOutcome::Tracked { .. })));
        let later = |depth: Image<f32>| Frame {
            frame_id: 1,
            device_time_secs: frame.device_time_secs + 1.0,
            host_time: frame.host_time,
            depth: Some(depth),
            ir: None,
        };
        let depth = frame.depth.clone().expect("a Kinect I");
        let covered = later(depth.map(|_| 0.0));
        assert_eq!(stage.fuse(&covered), Some(TrackingOutcome::NoDepth));
        assert_eq!(stage.fuse(&later(depth)), None);
    }

    /// Shows a stage the first pose of a Kinect I, held still before and after two exposures of these counts without depth.
    fn hold(stage: &mut FusionStage, first_id: u64, counts: u16) {
        let held = TrackingOutcome::Tracked {
            world_from_camera: Pose::identity(),
            fit: None,
        };
        for (counts, frame_id) in [None, Some(counts), Some(counts), None]
            .iter()
            .zip(first_id..)
        {
            let frame = Frame {
                frame_id,
                device_time_secs: frame_id as f64 / 30.0,
                host_time: Instant::now(),
                depth: counts.is_none().then(|| Image::filled(640, 480, 0.6)),
                ir: counts.map(|counts| Image::filled(640, 480, counts)),
            };
            let outcome = match counts {
                Some(_) => TrackingOutcome::NoDepth,
                None => held,
            };
            stage.consider(&Arc::new(frame), &outcome);
        }
    }

    /// The shading images that were told of, and why others were refused.
    fn told(log: &EventLog) -> Vec<EventKind> {
        let kinds = log
            .since(0)
            .into_iter()
            .map(|(_, event)| event.kind.clone());
        let of_shading = kinds
            .filter(|kind| matches!(kind, EventKind::Snapshot { .. } | EventKind::Refused { .. }));
        of_shading.collect()
    }

    const TAKEN: EventKind = EventKind::Snapshot { n_snapshots: 1 };

    #[test]
    fn a_lit_pose_in_place_of_an_unlit_one_is_told() {
        let info = SimulatedCamera::kinect1_plaque(1, 7).info().clone();
        let (surfaces, _) = edges::surfaces();
        let setup = setup(info, FusionParams::default(), surfaces);
        let log = EventLog::default();
        let (tracked, _told) = edges::tracked(&log);
        let mut stage = FusionStage::new(setup, tracked);
        hold(&mut stage, 0, 60);
        hold(&mut stage, 4, 400);
        assert_eq!(told(&log), [TAKEN, TAKEN]);
    }

    #[test]
    fn the_recorder_hears_of_candidates() {
        let mut camera = SimulatedCamera::kinect2_plaque(1, 7);
        let info = camera.info().clone();
        let frame = camera.grab(Duration::ZERO).expect("no errors");
        let frame = Arc::new(frame.expect("not the last"));
        let fusion = FusionParams {
            voxel_size_m: 0.004,
            ..FusionParams::default()
        };
        let (surfaces, _) = edges::surfaces();
        let (tracked, told) = edges::tracked(&EventLog::default());
        let mut stage = FusionStage::new(setup(info, fusion, surfaces), tracked);
        let outcome = stage.fuse(&frame).expect("no given poses");
        stage.consider(&frame, &outcome);
        let candidate = Tracked::Candidate(frame.frame_id);
        assert!(told.try_iter().any(|told| told == candidate));
    }

    #[test]
    fn exposures_with_depth_stopped_that_come_to_nothing_are_refused() {
        let info = SimulatedCamera::kinect1_plaque(1, 7).info().clone();
        let (surfaces, _) = edges::surfaces();
        let request = ShadingRequest::default();
        let setup = FusionSetup {
            shading: Some(request.clone()),
            ..setup(info, FusionParams::default(), surfaces)
        };
        let log = EventLog::default();
        let (tracked, _told) = edges::tracked(&log);
        let mut stage = FusionStage::new(setup, tracked);
        hold(&mut stage, 0, 400);
        stage.obey(Command::Snapshot);
        request.answer(ShadingOutcome::Taken { n_exposures: 2 });
        // The lamp is out.
        hold(&mut stage, 4, 60);
        let refused = EventKind::Refused {
            command: "snapshot",
            reason: "without the lamp, 15.0 % as bright as with it. Light the lamp.".to_owned(),
        };
        assert_eq!(told(&log), [TAKEN, refused]);
        assert!(stage.selector.is_some_and(|s| !s.is_requested()));
    }
}
