//! Kinect II: the emitter lights every IR frame, so every tracked frame is a candidate, and the best ones are kept.

use super::exposures::saturated_share;
use super::information::{Optics, ViewInformation, view_information};
use super::pool::Pool;
use super::rejection::{RejectReason, Rejection, Rejections};
use super::{ShadingSnapshot, SnapshotParams, SnapshotSelection, TrackedFrame};
use crate::fusion::{PoseCorrection, TrackingOutcome};
use crate::geometry::{Pose, motion_between};
use depth_camera::{Frame, Image};
use nalgebra::{Point3, Vector2};

/// An image counts less by this power of how much faster than the limits the camera was: it is chosen where slower ones tell
/// little, and hardly where they tell much. The power is arbitrary.
const HASTE_POWER: i32 = 4;
/// Images taken faster than the limits by this factor are not used: their blur would be three pixels.
const MAX_HASTE: f64 = 2.0;

/// The stream of a sensor whose own light is always on.
pub(super) struct EmitterStream {
    optics: Optics,
    params: SnapshotParams,
    pool: Pool,
    before: Before,
    rejected: Rejections,
    /// Whether the operator asked for the next good frame.
    is_requested: bool,
}

/// A frame that may become a shading image.
struct Candidate {
    snapshot: ShadingSnapshot,
    view: ViewInformation,
    /// Whether the camera moved within the limits.
    is_sharp: bool,
}

/// What is known of the frame before.
#[derive(Clone, Copy)]
enum Before {
    /// There was none: the camera is taken to be still.
    None,
    /// It was not tracked, or is forgotten: nothing is known of how fast the camera moved.
    Untracked,
    /// Where the camera was.
    At(Placed),
}

/// Where the camera was, and when.
#[derive(Clone, Copy)]
struct Placed {
    world_from_camera: Pose,
    device_time_secs: f64,
}

impl EmitterStream {
    pub(super) fn new(optics: Optics, params: SnapshotParams) -> Self {
        EmitterStream {
            optics,
            pool: Pool::new(2 * params.max_snapshots),
            params,
            before: Before::None,
            rejected: Rejections::default(),
            is_requested: false,
        }
    }

    pub(super) fn observe(&mut self, tracked: &TrackedFrame) {
        let outcome = self.judge(tracked);
        let rejection = match outcome {
            Ok(None) => None,
            Ok(Some(Candidate {
                snapshot,
                view,
                is_sharp,
            })) => match self.is_requested && is_sharp {
                true => {
                    self.is_requested = false;
                    self.pool.pin(snapshot, &view)
                }
                false => self.pool.offer(snapshot, &view),
            },
            Err(reason) => Some(Rejection {
                frame_id: tracked.frame.frame_id,
                reason,
            }),
        };
        self.rejected.extend(rejection);
    }

    pub(super) fn pool(&self) -> &Pool {
        &self.pool
    }

    pub(super) fn rejected(&self) -> &Rejections {
        &self.rejected
    }

    pub(super) fn request(&mut self, is_requested: bool) {
        self.is_requested = is_requested;
    }

    pub(super) fn is_requested(&self) -> bool {
        self.is_requested
    }

    pub(super) fn forget_after(&mut self, after_secs: f64) {
        self.pool.forget_after(after_secs);
        self.before = Before::Untracked;
    }

    pub(super) fn correct(&mut self, correction: &PoseCorrection) {
        self.pool.correct(correction);
        if let Before::At(before) = &mut self.before {
            let moved = correction.apply(before.device_time_secs, &before.world_from_camera);
            before.world_from_camera = moved;
        }
    }

    pub(super) fn n_accepted(&self) -> usize {
        self.pool.len().min(self.params.max_snapshots)
    }

    /// How many images are chosen at most, and what the last of them must add.
    pub(super) fn bounds(&self) -> (usize, f64) {
        (self.params.max_snapshots, self.params.min_gain_share)
    }

    pub(super) fn finish(mut self) -> SnapshotSelection {
        let (n, min_gain_share) = self.bounds();
        let (accepted, outdone) = self.pool.choose(n, min_gain_share);
        self.rejected.extend(outdone);
        SnapshotSelection {
            accepted,
            rejected: self.rejected.by_frame(),
        }
    }

    /// The frame as a candidate; `Ok(None)` if it has no IR.
    fn judge(&mut self, tracked: &TrackedFrame) -> Result<Option<Candidate>, RejectReason> {
        let frame = tracked.frame;
        let before = self.before;
        match *tracked.outcome {
            TrackingOutcome::Tracked {
                world_from_camera, ..
            } => {
                self.before = Before::At(Placed {
                    world_from_camera,
                    device_time_secs: frame.device_time_secs,
                });
            }
            TrackingOutcome::Lost(_) | TrackingOutcome::NoDepth => self.before = Before::Untracked,
        }
        let Some(ir) = &frame.ir else {
            return Ok(None);
        };
        let TrackingOutcome::Tracked {
            world_from_camera, ..
        } = *tracked.outcome
        else {
            return Err(RejectReason::NotTracked);
        };
        let snapshot = shading_image(frame, ir, world_from_camera).ok_or(RejectReason::NoDepth)?;
        let share = saturated_share(&snapshot.ir_counts, self.optics.full_scale);
        if share > self.params.max_saturated_share {
            return Err(RejectReason::Saturated { share });
        }
        let model = tracked.model.ok_or(RejectReason::NoInformation)?;
        let view = view_information(&snapshot, model, &self.optics);
        let target = view.target_world.ok_or(RejectReason::NoInformation)?;
        let haste = match before {
            Before::At(before) => self.haste(&before, &snapshot, &target)?,
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

    /// How much faster than the limits the camera moved since the tracked frame before, over whatever time has passed.
    fn haste(
        &self,
        before: &Placed,
        now: &ShadingSnapshot,
        target_world: &Point3<f64>,
    ) -> Result<f64, RejectReason> {
        let elapsed = now.device_time_secs - before.device_time_secs;
        if elapsed <= 0.0 {
            return Ok(0.0);
        }
        let motion = motion_between(&before.world_from_camera, &now.world_from_camera);
        let [fx, fy] = self.optics.focal_px;
        let moved = ray_to(target_world, &now.world_from_camera)
            - ray_to(target_world, &before.world_from_camera);
        let rotation_rad_per_s = motion.rotation_rad / elapsed;
        let speed_m_per_s = motion.translation_m / elapsed;
        let image_speed_px_per_s = Vector2::new(fx * moved.x, fy * moved.y).norm() / elapsed;
        let params = &self.params;
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
}

/// The frame as a shading image, `None` without depth.
fn shading_image(
    frame: &Frame,
    ir: &Image<u16>,
    world_from_camera: Pose,
) -> Option<ShadingSnapshot> {
    Some(ShadingSnapshot {
        frame_id: frame.frame_id,
        device_time_secs: frame.device_time_secs,
        n_exposures: 1,
        ir_counts: ir.map(|&counts| f32::from(counts)),
        unlit_counts: None,
        depth_m: frame.depth.clone()?,
        world_from_camera,
    })
}

/// Normalised coordinates of a point in front of a camera; the lens is left out, speeds need no such accuracy.
fn ray_to(point_world: &Point3<f64>, world_from_camera: &Pose) -> Vector2<f64> {
    let point = world_from_camera.inverse_transform_point(point_world);
    point.coords.xy() / point.z.max(0.05)
}

#[cfg(test)]
mod tests;
