//! The end of a scan: loops are closed, depth is corrected once more, and the base mesh is taken out of the volume. A scan that
//! is told to stop, and not only to end, is not improved: that may take as long as the scan took.

use super::{FusedScan, FusionStage, FusionSummary, loops::tell_of};
use crate::{
    capture::Tracked,
    fusion::{GoesOn, PoseCorrection},
    geometry::{CameraModel, Pose, RayGrid},
    pipeline::{state::State, status::Phase, timing::StageClock},
    snapshot::{SnapshotSelection, SnapshotSelector, place_on_their_ways},
};
use std::sync::Arc;

/// Why a scan was not improved at its end.
const STOPPED: &str = "the run was told to stop: loops may be left open, and depth corrected no better than while the scan went on; \
                       a recording of it can be played again";

impl FusionStage {
    /// Closes loops and takes the mesh out of the volume, whose memory is free before refinement begins.
    pub(super) fn finish(mut self) -> FusionSummary {
        let mut thinning_clock = StageClock::new("thin parts");
        let mut meshing_clock = StageClock::new("mesh extraction");
        self.summary.n_relocalised = self.fusion.n_relocalised() as u64;
        self.summary.n_unpolished = self.fusion.n_unpolished() as u64;
        self.operator.interim.join();
        self.loops.give_up();
        self.status.update(|status| {
            status.phase = Phase::Meshing;
            status.state = State::Draining;
        });
        if !self.trajectory.is_empty() {
            let mut snapshots = self.selector.take().map(SnapshotSelector::finish);
            let (stop, told) = (self.stop.clone(), self.status.clone());
            let goes_on = |improvement| {
                told.update(|status| status.improvement = Some(improvement));
                !stop.is_stopped()
            };
            self.settle_beginning(snapshots.as_mut());
            self.recalibrate(snapshots.as_ref());
            self.revise(snapshots.as_mut(), &goes_on);
            let closure = self.closing_clock.time(|| {
                let (fusion, pool) = (&mut self.fusion, &self.pool);
                pool.install(|| {
                    let closure = fusion.close_loops(&goes_on);
                    fusion.complete(&goes_on);
                    closure
                })
            });
            if let Some(closure) = &closure {
                tell_of(closure);
                self.correct(&closure.correction, snapshots.as_mut());
            }
            let correction = closure.map_or_else(PoseCorrection::default, |c| c.correction);
            let n_thin = thinning_clock.time(|| {
                let (fusion, pool) = (&mut self.fusion, &self.pool);
                pool.install(|| fusion.separate_thin_parts(&correction, &goes_on))
            });
            tracing::info!(n_bricks = n_thin, "thin parts fused with a narrow band");
            if self.poses.is_none() {
                self.settle(snapshots.as_mut());
            }
            self.place_on_their_ways(snapshots.as_mut());
            self.status.update(|status| status.improvement = None);
            self.summary.unimproved_reason = stop.is_stopped().then(|| STOPPED.to_owned());
            self.summary.refusal = self.fusion.refusal();
            let (fusion, pool) = (&self.fusion, &self.pool);
            let base = meshing_clock.time(|| pool.install(|| fusion.mesh()));
            tracing::info!(
                n_fused = self.trajectory.len(),
                volume_mib = fusion.memory_bytes() >> 20,
                vertices = base.vertices.len(),
                faces = base.faces.len(),
                "base mesh extracted"
            );
            let is_empty = base.faces.is_empty();
            self.summary.no_surface_reason = is_empty.then(|| {
                let refusal = self.summary.refusal.as_deref();
                let why = refusal.unwrap_or(
                    "no place was seen often enough (fusion.min_surface_weight): scan for longer",
                );
                format!("the model has no surface: {why}")
            });
            let trajectory = std::mem::take(&mut self.trajectory);
            self.summary.scan = Some(Arc::new(FusedScan {
                base,
                world_from_cameras: trajectory.iter().map(|(_, pose)| *pose).collect(),
                snapshots,
                intrinsics: self.intrinsics,
                last_depth: self.last_depth.take(),
                delivered: None,
                warnings: Vec::new(),
            }));
            self.send(Tracked::Trajectory(trajectory));
        }
        self.summary.timings = [
            self.correction_clock,
            self.fusion_clock,
            self.selection_clock,
            self.revision_clock,
            self.closing_clock,
            thinning_clock,
            meshing_clock,
        ]
        .iter()
        .filter_map(StageClock::timing)
        .collect();
        self.summary
    }

    /// Puts the first frames where the finished model has them.
    fn settle_beginning(&mut self, snapshots: Option<&mut SnapshotSelection>) {
        if self.stop.is_stopped() {
            return;
        }
        let (fusion, pool) = (&mut self.fusion, &self.pool);
        if let Some(correction) = pool.install(|| fusion.settle_beginning()) {
            tracing::info!(
                "the scan began in motion: its first frames are moved to where the model has them"
            );
            self.correct(&correction, snapshots);
        }
    }

    /// Lets the shading images settle on the finished model: each goes as its depth does, which is of the last frame that was
    /// fused by then. A Kinect I took that one before its projector was covered, from a little beside the image's pose.
    pub(super) fn settle(&mut self, snapshots: Option<&mut SnapshotSelection>) {
        let (fusion, pool, stop) = (&mut self.fusion, &self.pool, &self.stop);
        let snapshots = snapshots.into_iter().flat_map(|s| &mut s.accepted);
        for snapshot in snapshots.take_while(|_| !stop.is_stopped()) {
            let until_secs = snapshot.device_time_secs;
            let is_by_then = |(time_secs, _): &&(f64, Pose)| *time_secs <= until_secs;
            let last = || self.trajectory.iter().rfind(is_by_then);
            let world_from_depth = match snapshot.moved {
                // It lies where its depth does as yet, which is not of a frame that a hand half covered.
                Some(_) => Some(snapshot.world_from_camera),
                None => last().map(|(_, pose)| *pose),
            };
            let Some(world_from_depth) = world_from_depth else {
                continue;
            };
            let settled = pool.install(|| fusion.settle(&snapshot.depth_m, &world_from_depth));
            if let Some(settled) = settled {
                let depth_from_image = world_from_depth.inverse() * snapshot.world_from_camera;
                snapshot.world_from_camera = settled * depth_from_image;
            }
        }
    }

    /// Puts shading images whose camera did not rest over the pause where on their ways their light says that they were taken.
    pub(super) fn place_on_their_ways(&mut self, snapshots: Option<&mut SnapshotSelection>) {
        let Some((lamp, selection)) = self.lamp.as_ref().zip(snapshots) else {
            return;
        };
        if self.stop.is_stopped() {
            return;
        }
        let rays = RayGrid::new(CameraModel::new(self.intrinsics));
        let (fusion, accepted) = (&self.fusion, &mut selection.accepted);
        let seen_from = |pose: &Pose| fusion.seen_from(pose);
        let shares = self
            .pool
            .install(|| place_on_their_ways(accepted, &rays, lamp, seen_from));
        for (snapshot, share) in accepted.iter().zip(shares) {
            if let Some((moved, share)) = snapshot.moved.zip(share) {
                let (frame_id, way_mm) = (snapshot.frame_id, 1e3 * moved.translation.vector.norm());
                tracing::info!(
                    frame_id,
                    way_mm,
                    share,
                    "the camera moved over the pause: where on its way the shading image was taken"
                );
            }
        }
    }

    /// Lets depth be corrected by what the images say of response and light, where that is not what the calibration says.
    pub(super) fn recalibrate(&mut self, snapshots: Option<&SnapshotSelection>) {
        let (Some(asked), Some(selection)) = (&self.self_calibration, snapshots) else {
            return;
        };
        if self.stop.is_stopped() || selection.accepted.is_empty() {
            return;
        }
        let poses: Vec<Pose> = self.trajectory.iter().map(|(_, pose)| *pose).collect();
        let (fusion, correction) = (&self.fusion, &mut self.correction);
        self.revision_clock.time(|| {
            self.pool.install(|| {
                let base = fusion.mesh();
                let found = asked.contradiction(&base, &poses, &selection.accepted);
                if let Some(calibration) = found {
                    correction.recalibrate(&calibration);
                }
            });
        });
    }

    /// Fuses the scan again if it tells of errors of its depth that were not taken off.
    fn revise(&mut self, mut snapshots: Option<&mut SnapshotSelection>, goes_on: &GoesOn) {
        let (correction, fusion, pool) = (&self.correction, &self.fusion, &self.pool);
        let revised = self
            .revision_clock
            .time(|| pool.install(|| correction.revise(fusion, goes_on)));
        let Some(revised) = revised else {
            return;
        };
        for sentence in revised.put_right() {
            tracing::warn!("{sentence}");
            self.summary.put_right.push(sentence);
        }
        if let Some(intrinsics) = revised.intrinsics() {
            self.intrinsics = *intrinsics;
        }
        for snapshot in snapshots.iter_mut().flat_map(|s| &mut s.accepted) {
            let time_secs = snapshot.device_time_secs;
            let tracked = &snapshot.world_from_camera;
            let here = revised.correction.apply(time_secs, tracked);
            let depth = correction.revised_depth(&snapshot.depth_m, time_secs, &here, &revised);
            snapshot.depth_m = depth;
        }
        self.fusion = revised.fusion;
        self.correct(&revised.correction, snapshots.as_deref_mut());
        self.settle_beginning(snapshots);
    }

    /// Moves all poses that were handed out.
    fn correct(&mut self, correction: &PoseCorrection, snapshots: Option<&mut SnapshotSelection>) {
        self.move_path(correction);
        for snapshot in snapshots.into_iter().flat_map(|s| &mut s.accepted) {
            snapshot.world_from_camera =
                correction.apply(snapshot.device_time_secs, &snapshot.world_from_camera);
        }
    }

    /// Moves the path of the camera.
    pub(super) fn move_path(&mut self, correction: &PoseCorrection) {
        for (time_secs, pose) in &mut self.trajectory {
            *pose = correction.apply(*time_secs, pose);
        }
        self.measure_path();
    }
}
