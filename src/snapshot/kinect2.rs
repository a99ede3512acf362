//! Kinect II: the emitter lights every IR frame, so every tracked frame is a candidate, and the best ones are kept.

use super::candidates::Candidates;
use super::exposures::saturated_share;
use super::information::{ViewInformation, view_information};
use super::rejection::RejectReason;
use super::{Placed, ShadingSnapshot, TrackedFrame};
use crate::fusion::PoseCorrection;
use crate::geometry::{Pose, motion_between};
use nalgebra::{Point3, Vector2};

/// An image counts less by this power of how much faster than the limits the camera was: it is chosen where slower ones tell
/// little, and hardly where they tell much. The power is arbitrary.
const HASTE_POWER: i32 = 4;
/// Images taken faster than the limits by this factor are not used: their blur would be three pixels.
const MAX_HASTE: f64 = 2.0;

/// The stream of a sensor whose own light is always on.
#[derive(Default)]
pub(super) struct EmitterStream {
    before: Before,
}

/// A frame that may become a shading image.
struct Candidate {
    snapshot: ShadingSnapshot,
    view: ViewInformation,
    /// Whether the camera moved within the limits.
    is_sharp: bool,
}

/// What is known of the frame before.
#[derive(Clone, Copy, Default)]
enum Before {
    /// There was none: the camera is taken to be still.
    #[default]
    None,
    /// It was not tracked, or is forgotten: nothing is known of how fast the camera moved.
    Untracked,
    /// Where the camera was.
    At(Placed),
}

impl EmitterStream {
    pub(super) fn observe(&mut self, tracked: &TrackedFrame, to: &mut Candidates) {
        match self.judge(tracked, to) {
            Ok(None) => {}
            Ok(Some(Candidate {
                snapshot,
                view,
                is_sharp: true,
            })) => to.offer(snapshot, &view),
            Ok(Some(Candidate { snapshot, view, .. })) => {
                // What was asked for is a sharp one, which is still to come.
                let outdone = to.pool.offer(snapshot, &view);
                to.rejected.extend(outdone);
            }
            Err(reason) => to.reject(tracked.frame.frame_id, reason),
        }
    }

    /// Forgets where the camera was.
    pub(super) fn interrupt(&mut self) {
        self.before = Before::Untracked;
    }

    pub(super) fn correct(&mut self, correction: &PoseCorrection) {
        if let Before::At(before) = &mut self.before {
            before.correct(correction);
        }
    }

    /// The frame as a candidate; `Ok(None)` if it has no IR.
    fn judge(
        &mut self,
        tracked: &TrackedFrame,
        to: &Candidates,
    ) -> Result<Option<Candidate>, RejectReason> {
        let now = Placed::of(tracked);
        let before = std::mem::replace(&mut self.before, now.map_or(Before::Untracked, Before::At));
        if tracked.frame.ir.is_none() {
            return Ok(None);
        }
        let now = now.ok_or(RejectReason::NotTracked)?;
        let snapshot = ShadingSnapshot::of_frame(tracked.frame, now.world_from_camera)
            .ok_or(RejectReason::NoDepth)?;
        let share = saturated_share(&snapshot.ir_counts, to.optics.full_scale);
        if share > to.params.max_saturated_share {
            return Err(RejectReason::Saturated { share });
        }
        let model = tracked.model.ok_or(RejectReason::NoInformation)?;
        let view = view_information(&snapshot, model, &to.optics);
        let target = view.target_world.ok_or(RejectReason::NoInformation)?;
        let haste = match before {
            Before::At(before) => haste(&before, &now, &target, to)?,
            Before::Untracked => MAX_HASTE,
            Before::None => 0.0,
        };
        if view.patches.is_empty() {
            return Err(RejectReason::NoInformation);
        }
        Ok(Some(Candidate {
            snapshot,
            view: view.scaled(haste.max(1.0).powi(-HASTE_POWER)),
            is_sharp: haste <= 1.0,
        }))
    }
}

/// How much faster than the limits the camera moved since the tracked frame before, over whatever time has passed.
fn haste(
    before: &Placed,
    now: &Placed,
    target_world: &Point3<f64>,
    to: &Candidates,
) -> Result<f64, RejectReason> {
    let elapsed = now.device_time_secs - before.device_time_secs;
    if elapsed <= 0.0 {
        return Ok(0.0);
    }
    let motion = motion_between(&before.world_from_camera, &now.world_from_camera);
    let [fx, fy] = to.optics.focal_px;
    let moved = ray_to(target_world, &now.world_from_camera)
        - ray_to(target_world, &before.world_from_camera);
    let rotation_rad_per_s = motion.rotation_rad / elapsed;
    let speed_m_per_s = motion.translation_m / elapsed;
    let image_speed_px_per_s = Vector2::new(fx * moved.x, fy * moved.y).norm() / elapsed;
    let params = &to.params;
    let haste = (rotation_rad_per_s / params.max_rotation_rad_per_s)
        .max(speed_m_per_s / params.max_speed_m_per_s)
        .max(image_speed_px_per_s / params.max_image_speed_px_per_s);
    if haste > MAX_HASTE {
        return Err(RejectReason::TooFast {
            rotation_rad_per_s,
            speed_m_per_s,
            image_speed_px_per_s,
        });
    }
    Ok(haste)
}

/// Normalised coordinates of a point in front of a camera; the lens is left out, speeds need no such accuracy.
fn ray_to(point_world: &Point3<f64>, world_from_camera: &Pose) -> Vector2<f64> {
    let point = world_from_camera.inverse_transform_point(point_world);
    point.coords.xy() / point.z.max(0.05)
}

#[cfg(test)]
mod tests;
