//! Kinect I: the shading sequence. The operator holds still, covers the projector (depth goes empty), lights the lamp, and
//! uncovers the projector again; nobody tells the program, the images do.
//!
//! *Exposures* are IR images without depth and without speckle that the lamp lights. Those between two tracked frames form
//! a *group*: they become one shading image at the pose that [`HeldPose`] says; those of the group that the lamp does not light become its
//! ambient light. When there are more groups than `max_snapshots`, those that tell most are kept, as for the Kinect II; up to that number each pose that the operator
//! took the trouble to hold is kept, however little it adds.

use super::exposures::{Agreeing, Exposure, agreeing, saturated_share};
use super::guide::{Guidance, Guide};
use super::information::{Optics, ViewInformation, view_information};
use super::lamp_group::LampGroup;
use super::pool::Pool;
use super::rejection::{RejectReason, Rejection, Rejections};
use super::speckle::{Texture, texture};
use super::{HeldPose, ShadingSnapshot, SnapshotParams, SnapshotSelection, TrackedFrame};
use crate::fusion::{ModelMap, PoseCorrection, TrackingOutcome};
use crate::geometry::{Pose, mean_pose, motion_between};
use depth_camera::{Frame, Image};

/// A pose that is older than this when the exposures begin does not count as held; arbitrary, recorded sequences take 0.53.
const MAX_HOLD_SECS: f64 = 1.0;

/// The stream of a sensor whose lamp is lit at shading poses only.
pub(super) struct ShadingSequence {
    optics: Optics,
    params: SnapshotParams,
    /// The last tracked frame; `None` while the pose is not known.
    before: Option<Placed>,
    /// The group that is open.
    group: LampGroup,
    pool: Pool,
    rejected: Rejections,
    guide: Guide,
    /// How bright the lamp made a pose at most, counts at 1 m; 0 before the first. A lit room is not taken for it.
    lamp_counts_at_1_m: f64,
    /// Whether the operator asked for the next group.
    is_requested: bool,
}

/// A tracked frame.
struct Placed {
    device_time_secs: f64,
    world_from_camera: Pose,
    depth_m: Image<f32>,
}

impl Placed {
    /// By which light falls off: the squared mean of the depths, m²; 1 where there are none.
    fn squared_distance_m2(&self) -> f64 {
        let measured = self.depth_m.data().iter().filter(|z| **z > 0.0);
        let (sum, n) = measured.fold((0.0, 0usize), |(sum, n), &z| (sum + f64::from(z), n + 1));
        match n {
            0 => 1.0,
            n => (sum / n as f64).powi(2),
        }
    }
}

impl ShadingSequence {
    pub(super) fn new(optics: Optics, params: SnapshotParams) -> Self {
        ShadingSequence {
            optics,
            pool: Pool::new(2 * params.max_snapshots),
            params,
            before: None,
            group: LampGroup::default(),
            rejected: Rejections::default(),
            guide: Guide::default(),
            lamp_counts_at_1_m: 0.0,
            is_requested: false,
        }
    }

    pub(super) fn observe(&mut self, tracked: &TrackedFrame) {
        let frame = tracked.frame;
        let covered = depth_share(frame) <= self.params.max_covered_depth_share;
        let texture = frame
            .ir
            .as_ref()
            .map(|ir| texture(ir, self.optics.full_scale));
        match *tracked.outcome {
            TrackingOutcome::Tracked {
                world_from_camera, ..
            } => {
                self.close(&world_from_camera, tracked.model);
                self.refuse_uncovered(frame, texture.as_ref());
                self.guide
                    .tracked(&world_from_camera, frame.device_time_secs);
                self.before = frame.depth.clone().map(|depth_m| Placed {
                    device_time_secs: frame.device_time_secs,
                    world_from_camera,
                    depth_m,
                });
            }
            TrackingOutcome::Lost(_) if !covered => {
                self.abandon(RejectReason::LostAfter);
                self.refuse_uncovered(frame, texture.as_ref());
                self.guide.lost();
                self.before = None;
            }
            TrackingOutcome::Lost(_) | TrackingOutcome::NoDepth if covered => {
                self.expose(frame, texture.as_ref());
            }
            TrackingOutcome::Lost(_) | TrackingOutcome::NoDepth => {
                self.refuse_uncovered(frame, texture.as_ref());
            }
        }
        if let Some(texture) = &texture {
            self.guide.saw(texture);
        }
    }

    pub(super) fn pool(&self) -> &Pool {
        &self.pool
    }

    pub(super) fn rejected(&self) -> &Rejections {
        &self.rejected
    }

    pub(super) fn guidance(&self) -> Guidance {
        self.guide.guidance()
    }

    /// Whether exposures of a pose are being taken.
    pub(super) fn is_exposing(&self) -> bool {
        !self.group.exposures().is_empty()
    }

    pub(super) fn request(&mut self, is_requested: bool) {
        self.is_requested = is_requested;
    }

    pub(super) fn is_requested(&self) -> bool {
        self.is_requested
    }

    pub(super) fn forget_after(&mut self, after_secs: f64) {
        self.pool.forget_after(after_secs);
        self.group = LampGroup::default();
        self.before = None;
        self.guide.lost();
    }

    pub(super) fn correct(&mut self, correction: &PoseCorrection) {
        self.pool.correct(correction);
        if let Some(before) = &mut self.before {
            let moved = correction.apply(before.device_time_secs, &before.world_from_camera);
            before.world_from_camera = moved;
        }
    }

    pub(super) fn n_accepted(&self) -> usize {
        self.pool.len().min(self.params.max_snapshots)
    }

    /// How many images are chosen at most, and that the last of them need add nothing.
    pub(super) fn bounds(&self) -> (usize, f64) {
        (self.params.max_snapshots, 0.0)
    }

    pub(super) fn finish(mut self) -> SnapshotSelection {
        self.abandon(RejectReason::Unfinished);
        let (n, min_gain_share) = self.bounds();
        let (accepted, outdone) = self.pool.choose(n, min_gain_share);
        self.rejected.extend(outdone);
        SnapshotSelection {
            accepted,
            rejected: self.rejected.by_frame(),
        }
    }

    /// Takes in a frame without depth: an exposure, if the lamp and nothing else lights it.
    fn expose(&mut self, frame: &Frame, texture: Option<&Texture>) {
        let (Some(ir), Some(texture)) = (&frame.ir, texture) else {
            return;
        };
        let image = || Exposure::new(frame.frame_id, frame.device_time_secs, ir.clone());
        let max_exposures = self.params.max_exposures;
        if texture.is_speckled() {
            let energy = texture.speckle_energy;
            self.reject(frame.frame_id, RejectReason::Speckle { energy });
        } else if texture.is_dark() {
            self.group.add_unlit(image(), max_exposures);
            let lit_share = texture.lit_share;
            self.reject(frame.frame_id, RejectReason::Dark { lit_share });
        } else if self.before.is_none() {
            self.reject(frame.frame_id, RejectReason::NotTracked);
        } else {
            let refused = self.group.add(image(), max_exposures);
            self.rejected.extend(refused);
        }
        let before = self.before.as_ref();
        let distance_m2 = before.map_or(1.0, Placed::squared_distance_m2);
        let lamp_counts = self.lamp_counts_at_1_m / distance_m2;
        let n_lit = self.group.n_lit(lamp_counts);
        self.guide
            .covered(texture, n_lit, self.params.min_exposures);
    }

    /// Says why the IR image of a frame with depth is none under the lamp.
    fn refuse_uncovered(&mut self, frame: &Frame, texture: Option<&Texture>) {
        let Some(texture) = texture else { return };
        let reason = match texture.is_speckled() {
            true => RejectReason::Speckle {
                energy: texture.speckle_energy,
            },
            false => RejectReason::Uncovered {
                depth_share: depth_share(frame),
            },
        };
        self.reject(frame.frame_id, reason);
    }

    /// Ends the open group at the first frame that is tracked again.
    fn close(&mut self, world_from_after: &Pose, model: Option<&ModelMap>) {
        let group = std::mem::take(&mut self.group);
        if group.exposures().is_empty() {
            return;
        }
        let (agreeing, changed) = agreeing(
            group.exposures(),
            self.optics.full_scale,
            self.params.max_changed_share,
        );
        self.rejected.extend(changed);
        match self.develop(&agreeing, world_from_after) {
            Ok(mut snapshot) => {
                snapshot.unlit_counts = group.unlit_counts();
                if let Some(before) = &self.before {
                    let at_1_m = group.brightest() * before.squared_distance_m2();
                    self.lamp_counts_at_1_m = self.lamp_counts_at_1_m.max(at_1_m);
                }
                let view = model.map_or_else(ViewInformation::default, |model| {
                    view_information(&snapshot, model, &self.optics)
                });
                let is_requested = std::mem::take(&mut self.is_requested);
                let outdone = match is_requested {
                    true => self.pool.pin(snapshot, &view),
                    false => self.pool.offer(snapshot, &view),
                };
                self.rejected.extend(outdone);
            }
            Err(reason) => {
                for exposure in agreeing.exposures {
                    self.reject(exposure.frame_id, reason);
                }
            }
        }
    }

    /// One shading image of the exposures of a group.
    fn develop(
        &self,
        agreeing: &Agreeing,
        world_from_after: &Pose,
    ) -> Result<ShadingSnapshot, RejectReason> {
        let before = self.before.as_ref().ok_or(RejectReason::NotTracked)?;
        let n_exposures = agreeing.exposures.len();
        let first = match agreeing.exposures.first() {
            Some(first) if n_exposures >= self.params.min_exposures => first,
            _ => return Err(RejectReason::FewExposures { n_exposures }),
        };
        let is_recent = first.device_time_secs - before.device_time_secs <= MAX_HOLD_SECS;
        let between = self.pose_between(&before.world_from_camera, world_from_after);
        let world_from_camera = match (between, self.params.held_pose) {
            (Err(_), HeldPose::BetweenOrBefore) if is_recent => before.world_from_camera,
            (between, _) => between?,
        };
        let ir_counts = agreeing.average(self.optics.full_scale);
        let share = saturated_share(&ir_counts, self.optics.full_scale);
        if share > self.params.max_saturated_share {
            return Err(RejectReason::Saturated { share });
        }
        Ok(ShadingSnapshot {
            frame_id: first.frame_id,
            device_time_secs: first.device_time_secs,
            n_exposures,
            ir_counts,
            unlit_counts: None,
            depth_m: before.depth_m.clone(),
            world_from_camera,
        })
    }

    /// The pose halfway between the two, if they agree.
    fn pose_between(&self, before: &Pose, after: &Pose) -> Result<Pose, RejectReason> {
        let motion = motion_between(before, after);
        if motion.rotation_rad > self.params.max_still_rotation_rad
            || motion.translation_m > self.params.max_still_translation_m
        {
            return Err(RejectReason::NotStill {
                rotation_rad: motion.rotation_rad,
                translation_m: motion.translation_m,
            });
        }
        Ok(mean_pose(before, after))
    }

    /// Gives the open group up.
    fn abandon(&mut self, reason: RejectReason) {
        for exposure in std::mem::take(&mut self.group).exposures() {
            self.reject(exposure.frame_id, reason);
        }
    }

    fn reject(&mut self, frame_id: u64, reason: RejectReason) {
        self.rejected.extend([Rejection { frame_id, reason }]);
    }
}

/// Share of the pixels with depth.
fn depth_share(frame: &Frame) -> f64 {
    frame.depth.as_ref().map_or(0.0, |depth| {
        let n_valid = depth.data().iter().filter(|z| **z > 0.0).count();
        n_valid as f64 / depth.data().len().max(1) as f64
    })
}

#[cfg(test)]
mod tests;
