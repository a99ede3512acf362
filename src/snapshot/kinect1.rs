//! Kinect I: the shading sequence. The operator holds still, covers the projector (depth goes empty), lights the lamp, and
//! uncovers the projector again; nobody tells the program, the images do.
//!
//! *Exposures* are IR images without depth and without speckle that the lamp lights. Those between two tracked frames form a
//! *group*: they become one shading image at the pose that [`HeldPose`] says; those of the group that the lamp does not light
//! become its ambient light. A group that is less than a quarter as bright as the brightest of the scan, distance allowed for,
//! was taken without the lamp in a lit room, and becomes nothing: the first ones too, as soon as a brighter one tells. When
//! there are more groups than `max_snapshots`, those that tell most are kept, as for the Kinect II; up to that number each pose
//! that the operator took the trouble to hold is kept, however little it adds.

use super::candidates::Candidates;
use super::exposures::{Agreeing, Exposure, agreeing, mean_counts, saturated_share};
use super::guide::{Guidance, Guide};
use super::information::{ViewInformation, view_information};
use super::lamp_group::{LampGroup, is_lit, unlit};
use super::pause::MAX_WAY;
use super::rejection::RejectReason;
use super::speckle::{Texture, texture};
use super::{HeldPose, Placed, ShadingSnapshot, SnapshotParams, TrackedFrame};
use crate::fusion::{PoseCorrection, TrackingOutcome};
use crate::geometry::{Pose, mean_pose, motion_between};
use depth_camera::{Frame, Image};

/// A pose that is older than this when the exposures begin does not count as held, and one so much later than their end does not tell
/// whether it was; arbitrary, recorded sequences take 0.53.
const MAX_HOLD_SECS: f64 = 1.0;
/// A tracked frame with a smaller share of the depth that there was within [`MAX_HOLD_SECS`] is taken while something covers or uncovers
/// the projector; arbitrary, the frames of a held pose differ by hundredths.
const UNCOVERED_SHARE: f64 = 0.5;

/// The stream of a sensor whose lamp is lit at shading poses only.
#[derive(Default)]
pub(super) struct ShadingSequence {
    /// The last tracked frame of which little was covered; `None` while the pose is not known.
    before: Option<Before>,
    /// The group that is open.
    group: LampGroup,
    guide: Guide,
    /// How bright the lamp made a pose at most, counts at 1 m; 0 before the first. A lit room is not taken for it.
    lamp_counts_at_1_m: f64,
}

/// A tracked frame.
struct Before {
    at: Placed,
    depth_m: Image<f32>,
    /// The most that was seen of late, at most [`MAX_HOLD_SECS`] earlier.
    fullest: Fullest,
}

/// How much depth a frame had, and when that was on the device's clock.
#[derive(Clone, Copy)]
struct Fullest {
    depth_share: f64,
    device_time_secs: f64,
}

impl ShadingSequence {
    pub(super) fn observe(&mut self, tracked: &TrackedFrame, to: &mut Candidates) {
        let frame = tracked.frame;
        let covered = frame.depth_share() <= to.params.max_covered_depth_share;
        let full_scale = to.optics.full_scale;
        let texture = frame.ir.as_ref().map(|ir| texture(ir, full_scale));
        match (Placed::of(tracked), *tracked.outcome) {
            (Some(at), _) => {
                self.close(&at, tracked, to);
                refuse_uncovered(frame, texture.as_ref(), to);
                self.guide
                    .tracked(&at.world_from_camera, at.device_time_secs);
                self.remember(at, frame);
            }
            (None, TrackingOutcome::Lost(_)) if !covered => {
                self.abandon(RejectReason::LostAfter, to);
                refuse_uncovered(frame, texture.as_ref(), to);
                self.guide.lost();
                self.before = None;
            }
            (None, _) if covered => self.expose(frame, texture.as_ref(), to),
            (None, _) => refuse_uncovered(frame, texture.as_ref(), to),
        }
        if let Some(texture) = &texture {
            self.guide.saw(texture);
        }
    }

    pub(super) fn guidance(&self) -> Guidance {
        self.guide.guidance()
    }

    /// Whether exposures of a pose are being taken.
    pub(super) fn is_exposing(&self) -> bool {
        !self.group.exposures().is_empty()
    }

    /// Forgets where the camera was, the open group, and of the lamp all but what the candidates tell that are `left`.
    pub(super) fn interrupt(&mut self, left: &Candidates) {
        self.group = LampGroup::default();
        self.before = None;
        self.guide.lost();
        let levels = left.pool.snapshots().map(counts_at_1_m);
        self.lamp_counts_at_1_m = levels.fold(0.0, f64::max);
    }

    pub(super) fn correct(&mut self, correction: &PoseCorrection) {
        if let Some(before) = &mut self.before {
            before.at.correct(correction);
        }
    }

    /// Gives the open group up.
    pub(super) fn abandon(&mut self, reason: RejectReason, to: &mut Candidates) {
        for exposure in std::mem::take(&mut self.group).exposures() {
            to.reject(exposure.frame_id, reason);
        }
    }

    /// Takes in where the camera is and what it sees from there, unless a hand or a shutter is on its way across the projector: what
    /// is left of the depth tells neither what hides the object nor how much light arrives.
    fn remember(&mut self, at: Placed, frame: &Frame) {
        let Some(depth_m) = &frame.depth else {
            self.before = None;
            return;
        };
        let now = Fullest {
            depth_share: frame.depth_share(),
            device_time_secs: at.device_time_secs,
        };
        let lately = self.before.as_ref().map(|before| before.fullest);
        let fuller = lately.filter(|then| {
            now.device_time_secs - then.device_time_secs <= MAX_HOLD_SECS
                && then.depth_share > now.depth_share
        });
        let fullest = fuller.unwrap_or(now);
        if now.depth_share >= UNCOVERED_SHARE * fullest.depth_share {
            self.before = Some(Before {
                at,
                depth_m: depth_m.clone(),
                fullest,
            });
        }
    }

    /// Takes in a frame without depth: an exposure, if the lamp and nothing else lights it.
    fn expose(&mut self, frame: &Frame, texture: Option<&Texture>, to: &mut Candidates) {
        let (Some(ir), Some(texture)) = (&frame.ir, texture) else {
            return;
        };
        let depth_m = self.before.as_ref().map(|before| &before.depth_m);
        let image = || Exposure::new(frame.frame_id, frame.device_time_secs, ir.clone(), depth_m);
        let max_exposures = to.params.max_exposures;
        if texture.is_speckled() {
            let energy = texture.speckle_energy;
            to.reject(frame.frame_id, RejectReason::Speckle { energy });
        } else if texture.is_dark() {
            self.group.add_unlit(image(), max_exposures);
            let lit_share = texture.lit_share;
            to.reject(frame.frame_id, RejectReason::Dark { lit_share });
        } else if self.before.is_none() {
            to.reject(frame.frame_id, RejectReason::NotTracked);
        } else {
            let refused = self.group.add(image(), max_exposures);
            to.rejected.extend(refused);
        }
        let n_lit = self.group.n_lit(self.lamp_counts());
        self.guide.covered(texture, n_lit, to.params.min_exposures);
    }

    /// How bright the lamp would make the brightest of poses from where the camera was, counts.
    fn lamp_counts(&self) -> f64 {
        let before = self.before.as_ref();
        self.lamp_counts_at_1_m * before.map_or(1.0, |before| arriving(&before.depth_m))
    }

    /// Ends the open group at the first frame that is tracked again, `after`.
    fn close(&mut self, after: &Placed, tracked: &TrackedFrame, to: &mut Candidates) {
        let mut group = std::mem::take(&mut self.group);
        if group.exposures().is_empty() {
            return;
        }
        to.rejected.extend(group.drop_unlit(self.lamp_counts()));
        if group.exposures().is_empty() {
            return;
        }
        let (agreeing, changed) = agreeing(
            group.exposures(),
            to.optics.full_scale,
            to.params.max_changed_share,
        );
        to.rejected.extend(changed);
        match self.develop(&agreeing, after, to) {
            Ok(mut snapshot) => {
                snapshot.unlit_counts = group.unlit_counts();
                self.learn_lamp(&snapshot, to);
                let view = tracked
                    .model
                    .map_or_else(ViewInformation::default, |model| {
                        view_information(&snapshot, model, &to.optics)
                    });
                to.offer(snapshot, &view);
            }
            Err(reason) => {
                for exposure in agreeing.exposures {
                    to.reject(exposure.frame_id, reason);
                }
            }
        }
    }

    /// Takes in how bright the lamp made a pose. If none was as bright before, it tells which of those were without the lamp; one of them
    /// that was asked for leaves its request to this pose.
    fn learn_lamp(&mut self, snapshot: &ShadingSnapshot, to: &mut Candidates) {
        let at_1_m = counts_at_1_m(snapshot);
        if at_1_m <= self.lamp_counts_at_1_m {
            return;
        }
        self.lamp_counts_at_1_m = at_1_m;
        to.revoke(|held| {
            let counts = counts_at_1_m(held);
            (!is_lit(counts, at_1_m)).then(|| unlit(held.frame_id, counts / at_1_m))
        });
    }

    /// One shading image of the exposures of a group.
    fn develop(
        &self,
        agreeing: &Agreeing,
        after: &Placed,
        to: &Candidates,
    ) -> Result<ShadingSnapshot, RejectReason> {
        let before = self.before.as_ref().ok_or(RejectReason::NotTracked)?;
        let exposures = &agreeing.exposures;
        let n_exposures = exposures.len();
        let (first, last) = match (exposures.first(), exposures.last()) {
            (Some(first), Some(last)) if n_exposures >= to.params.min_exposures => (first, last),
            _ => return Err(RejectReason::FewExposures { n_exposures }),
        };
        let is_recent = first.device_time_secs - before.at.device_time_secs <= MAX_HOLD_SECS;
        let is_late = after.device_time_secs - last.device_time_secs > MAX_HOLD_SECS;
        let between = pose_between(&before.at, after, &to.params);
        let before_pause = before.at.world_from_camera;
        let (world_from_camera, moved) = match (between, to.params.held_pose) {
            (Ok(pose), _) => (pose, None),
            (Err(_), HeldPose::BetweenOrBefore) if is_recent => {
                let moved = before_pause.inverse() * after.world_from_camera;
                let is_way = motion_between(&Pose::identity(), &moved).is_within(&MAX_WAY);
                (before_pause, is_way.then_some(moved))
            }
            (Err(_), HeldPose::BetweenUnlessLate) if is_recent && is_late => (before_pause, None),
            (Err(moved), _) => return Err(moved),
        };
        let full_scale = to.optics.full_scale;
        let ir_counts = agreeing.average(full_scale);
        let share = saturated_share(&ir_counts, full_scale);
        if share > to.params.max_saturated_share {
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
            moved,
        })
    }
}

/// Says why the IR image of a frame with depth is none under the lamp.
fn refuse_uncovered(frame: &Frame, texture: Option<&Texture>, to: &mut Candidates) {
    let Some(texture) = texture else { return };
    let reason = match texture.is_speckled() {
        true => RejectReason::Speckle {
            energy: texture.speckle_energy,
        },
        false => RejectReason::Uncovered {
            depth_share: frame.depth_share(),
        },
    };
    to.reject(frame.frame_id, reason);
}

/// The pose halfway between the two, if they agree.
fn pose_between(
    before: &Placed,
    after: &Placed,
    params: &SnapshotParams,
) -> Result<Pose, RejectReason> {
    let (before, after) = (&before.world_from_camera, &after.world_from_camera);
    let motion = motion_between(before, after);
    if motion.rotation_rad > params.max_still_rotation_rad
        || motion.translation_m > params.max_still_translation_m
    {
        return Err(RejectReason::NotStill {
            rotation_rad: motion.rotation_rad,
            translation_m: motion.translation_m,
        });
    }
    Ok(mean_pose(before, after))
}

/// How much of a light at 1 m arrives at a pose: the mean of 1/z² over the pixels with depth, 1 without any. Brightness is the mean
/// over the same pixels ([`mean_counts`]), so that it does not matter how many there are.
fn arriving(depth_m: &Image<f32>) -> f64 {
    let measured = depth_m.data().iter().filter(|z| **z > 0.0);
    let (sum, n) = measured.fold((0.0, 0_usize), |(sum, n), &z| {
        (sum + f64::from(z).powi(-2), n + 1)
    });
    match n {
        0 => 1.0,
        n => sum / n as f64,
    }
}

/// How bright a pose would be from 1 m, mean counts.
fn counts_at_1_m(snapshot: &ShadingSnapshot) -> f64 {
    let depth_m = &snapshot.depth_m;
    mean_counts(&snapshot.ir_counts, Some(depth_m)) / arriving(depth_m)
}

#[cfg(test)]
mod tests;
