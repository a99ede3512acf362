//! What somebody who looks on sees, made only while somebody looks and no more often than an eye needs.

use super::{FusionStage, surface_round::SurfaceRound};
use crate::{
    geometry::Pose,
    pipeline::{
        accounts::FrameAccounts,
        conditions::WEAK_FITNESS,
        edges::FrameReceiver,
        live::{
            InterimScan, Live, LivePose, Slot, next_view,
            preview::{PREVIEW_COLUMNS, of_depth, of_infrared},
            snapshot_list::SnapshotList,
            surface::SurfaceUpdate,
        },
    },
    snapshot::{Coverage, Rejections},
};
use crossbeam::channel::Sender;
use depth_camera::Frame;
use std::time::Duration;

/// Previews are this far apart at least.
const BETWEEN_PREVIEWS: Duration = Duration::from_millis(90);
/// ... and what changes slowly.
const BETWEEN_PATHS: Duration = Duration::from_millis(500);
/// ... and the strip of shading images, for which the choice among them is made.
const BETWEEN_STRIPS: Duration = Duration::from_secs(1);
/// Most poses of a path.
const MAX_PATH: usize = 2000;

/// What is shown, and what is kept to show it.
pub(super) struct Showing {
    live: Live,
    surfaces: Sender<SurfaceUpdate>,
    /// The working range, metres.
    range: [f32; 2],
    full_scale: Option<f64>,
    round: SurfaceRound,
    snapshots: SnapshotList,
    /// Where the camera was tracked well last.
    last_good: Option<Pose>,
}

impl Showing {
    pub(super) fn new(
        live: Live,
        surfaces: Sender<SurfaceUpdate>,
        range: [f32; 2],
        full_scale: Option<f64>,
    ) -> Self {
        Showing {
            live,
            surfaces,
            range,
            full_scale,
            round: SurfaceRound::default(),
            snapshots: SnapshotList::default(),
            last_good: None,
        }
    }

    /// Takes in what the selector of shading images said of a frame.
    pub(super) fn note(&mut self, frame: &Frame, rejected: &Rejections) {
        let is_watched = self.live.snapshots.is_watched();
        let full_scale = self.full_scale.filter(|_| is_watched);
        self.snapshots.note(frame, rejected, full_scale);
    }

    /// Forgets what was shown: the model is another one.
    pub(super) fn begin_anew(&mut self) {
        self.snapshots.forget();
        self.move_with_model();
    }

    /// Forgets what was shown of the surface: the model has moved.
    pub(super) fn move_with_model(&mut self) {
        self.last_good = None;
        self.round.begin_anew();
    }

    pub(super) fn interim_slot(&self) -> Slot<InterimScan> {
        self.live.interim.clone()
    }

    fn images(&self, frame: &Frame) {
        let live = &self.live;
        if let Some(depth) = &frame.depth
            && live.depth.is_due(BETWEEN_PREVIEWS)
        {
            let preview = of_depth(frame.frame_id, depth, self.range);
            live.depth.write(Some(preview));
        }
        if let (Some(ir), Some(full_scale)) = (&frame.ir, self.full_scale)
            && live.infrared.is_due(BETWEEN_PREVIEWS)
        {
            let preview = of_infrared(frame.frame_id, ir, full_scale, PREVIEW_COLUMNS);
            live.infrared.write(Some(preview));
        }
    }
}

impl FusionStage {
    /// Brings up to date what somebody looks at.
    pub(super) fn show(&mut self, frame: Option<&Frame>) {
        if let Some(frame) = frame {
            self.showing.images(frame);
        }
        self.show_pose();
        self.show_path();
        self.show_snapshots();
        self.show_next_view();
        self.show_surface();
    }

    fn show_pose(&mut self) {
        let Some((_, newest)) = self.trajectory.last() else {
            return self.show_nowhere();
        };
        let is_lost = self.summary.losses.is_lost();
        let is_weak = self.fitness.is_some_and(|fitness| fitness < WEAK_FITNESS);
        let showing = &mut self.showing;
        if !is_lost && !is_weak {
            showing.last_good = Some(*newest);
        }
        if showing.live.pose.is_due(BETWEEN_PREVIEWS) {
            showing.live.pose.write(Some(LivePose {
                frame_id: self.last_frame_id,
                world_from_camera: *newest,
                last_good: showing.last_good.unwrap_or(*newest),
                is_lost,
            }));
        }
    }

    /// There is no pose, or none any more.
    fn show_nowhere(&self) {
        let live = &self.showing.live;
        if live.pose.is_due(BETWEEN_PREVIEWS) {
            live.pose.write(None);
        }
    }

    fn show_path(&self) {
        let path = &self.showing.live.path;
        if path.is_due(BETWEEN_PATHS) {
            let every = self.trajectory.len().div_ceil(MAX_PATH).max(1);
            let poses = self.trajectory.iter().step_by(every);
            path.write(Some(poses.map(|(_, pose)| *pose).collect()));
        }
    }

    fn show_snapshots(&mut self) {
        let showing = &mut self.showing;
        if let (Some(selector), Some(full_scale)) = (&self.selector, showing.full_scale)
            && showing.live.snapshots.is_due(BETWEEN_STRIPS)
        {
            let strip = showing.snapshots.strip(selector, full_scale);
            showing.live.snapshots.write(Some(strip));
        }
    }

    fn show_next_view(&mut self) {
        let slot = &self.showing.live.next_view;
        if !slot.is_due(BETWEEN_PATHS) {
            return;
        }
        let (pool, fusion) = (&self.pool, &mut self.fusion);
        let mut view = || {
            let (_, pose) = self.trajectory.last()?;
            let selector = self.selector.as_ref()?;
            let model = pool.install(|| fusion.model())?;
            let viewpoint = selector.next_viewpoint(model, pose)?;
            Some(next_view::told(&viewpoint, pose))
        };
        let is_lost = self.summary.losses.is_lost();
        slot.write(view().filter(|_| !is_lost));
    }

    /// Goes on with the round that brings the surface up to the model, and hands over what it has changed when it ends. One
    /// begins when it is time, unless what was handed over last is still being sewn.
    fn show_surface(&mut self) {
        let showing = &mut self.showing;
        let round = &mut showing.round;
        let is_due = showing.live.surface.is_due(round.between()) && !showing.surfaces.is_full();
        if !round.is_under_way() && !is_due {
            return;
        }
        round.go_on(&self.fusion, &self.pool);
        if round.is_under_way() {
            return;
        }
        let selector = self.selector.as_ref();
        let coverage = selector.map_or_else(Coverage::default, |selector| selector.coverage());
        // There was room when the round began, and this is the only sender; a thread that is gone shows nothing any more.
        let _ = showing.surfaces.try_send(round.end(coverage));
    }

    /// Checks once a second that every frame is accounted for; what is wrong is told of once.
    pub(super) fn check_accounts(&mut self, frames: &FrameReceiver) {
        if self.pulse.is_told || !self.pulse.is_check_due() {
            return;
        }
        let n_waiting = frames.channel().len() as u64;
        let accounts = self.status.get().frames;
        if !adds_up(&accounts, n_waiting) {
            self.pulse.is_told = true;
            tracing::error!(?accounts, n_waiting, "frames are unaccounted for");
        }
    }
}

/// Whether accounts agree with how many frames wait while none is in the hands of fusion: the device may have one in hand,
/// and may have sent one since they were counted.
fn adds_up(accounts: &FrameAccounts, n_waiting: u64) -> bool {
    accounts.unaccounted() == 0 && (n_waiting..=n_waiting + 2).contains(&accounts.in_flight)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_that_vanishes_shows_in_the_accounts() {
        let accounts = FrameAccounts {
            produced: 20,
            fused: 10,
            paused: 4,
            dropped: 1,
            damaged: 1,
            in_flight: 4,
            ..FrameAccounts::default()
        };
        assert!(adds_up(&accounts, 4) && adds_up(&accounts, 2));
        assert!(!adds_up(&accounts, 1), "three that nobody has");
        assert!(!adds_up(&accounts, 5));
        let counted_twice = FrameAccounts {
            lost: 1,
            ..accounts
        };
        assert!(!adds_up(&counted_twice, 4));
    }
}
