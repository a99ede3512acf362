//! How capture ends, whatever happens while it waits for a frame: random steps, in the order in which they are given.

use super::*;
use crate::{
    capture::CaptureEnd,
    pipeline::{
        accounts::Place,
        edges::{self, DropCounts, FrameReceiver, WhenFull},
        event_log::EventLog,
    },
};
use depth_camera::{CameraError, CameraInfo};
use proptest::{collection::vec, prelude::*};
use simulated::SimulatedCamera;
use std::{
    sync::{Arc, LazyLock, Mutex},
    time::{Duration, Instant},
};

/// A live device's: how many frames will come is not known.
static INFO: LazyLock<CameraInfo> = LazyLock::new(|| CameraInfo {
    n_frames: None,
    ..SimulatedCamera::kinect1_plaque(1, 0).info().clone()
});

/// What happens while the device thread is in its camera.
#[derive(Clone, Copy, Debug)]
enum Step {
    /// The camera delivers a frame ...
    Frame,
    /// ... or a damaged one ...
    Damaged,
    /// ... or nothing in time.
    Silence,
    /// Fusion takes a frame.
    Take,
    /// Somebody stops the run.
    Stop,
    /// The fusion thread ends.
    Leave,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        16 => Just(Step::Frame),
        4 => Just(Step::Damaged),
        4 => Just(Step::Silence),
        8 => Just(Step::Take),
        1 => Just(Step::Stop),
        1 => Just(Step::Leave),
    ]
}

/// What the camera saw of it.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    n_frames: u64,
    n_damaged: u64,
    n_taken: u64,
    is_stopped: bool,
    is_left: bool,
    /// Whether it was asked for a frame though the last one was not wanted, or the run was stopped.
    is_asked_in_vain: bool,
}

/// A camera that lets steps happen until one of them is an answer of its own; after the last its stream is over.
struct Scripted {
    info: CameraInfo,
    steps: std::vec::IntoIter<Step>,
    when_full: WhenFull,
    fusion: Option<FrameReceiver>,
    end: StopToken,
    status: StatusSlot,
    seen: Arc<Mutex<Seen>>,
    is_last_unwanted: bool,
}

impl Scripted {
    fn take(&self, seen: &mut Seen) {
        if let Some(fusion) = &self.fusion
            && fusion.channel().try_recv().is_ok()
        {
            self.status
                .update(|status| status.frames.arrived(Place::Fused));
            seen.n_taken += 1;
        }
    }

    fn frame(&mut self, seen: &mut Seen) -> Frame {
        // Else the thread would wait: that is tried with the edge itself, in `handover`.
        if self.when_full == WhenFull::Block && self.status.get().frames.in_flight == 4 {
            self.take(seen);
        }
        seen.n_frames += 1;
        self.is_last_unwanted = seen.is_left;
        Frame {
            frame_id: seen.n_frames + seen.n_damaged,
            device_time_secs: seen.n_frames as f64,
            host_time: Instant::now(),
            depth: None,
            ir: None,
        }
    }
}

impl DepthCamera for Scripted {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        let seen = self.seen.clone();
        let mut seen = seen.lock().unwrap();
        seen.is_asked_in_vain |= seen.is_stopped || self.is_last_unwanted;
        while let Some(step) = self.steps.next() {
            match step {
                Step::Frame => return Ok(Some(self.frame(&mut seen))),
                Step::Damaged => {
                    seen.n_damaged += 1;
                    return Err(CameraError::DamagedFrame {
                        frame_id: seen.n_frames + seen.n_damaged,
                        reason: "half of it".to_owned(),
                    });
                }
                Step::Silence => return Err(CameraError::Timeout { waited: timeout }),
                Step::Take => self.take(&mut seen),
                Step::Stop => {
                    self.end.stop();
                    seen.is_stopped = true;
                }
                Step::Leave => {
                    self.fusion = None;
                    seen.is_left = true;
                }
            }
        }
        Ok(None)
    }

    /// Three with each frame.
    fn n_missed(&self) -> u64 {
        3 * self.seen.lock().unwrap().n_frames
    }
}

fn run_with(steps: Vec<Step>, when_full: WhenFull) -> (CaptureSummary, Seen, StatusSlot) {
    let (status, end) = (StatusSlot::default(), StopToken::default());
    let (frames, fusion) = edges::frames(when_full, &status);
    let (recording, _recorder) = edges::recording(when_full, &Arc::new(DropCounts::default()));
    let (events, _events) = edges::tracked(&EventLog::default());
    let seen = Arc::new(Mutex::new(Seen::default()));
    let setup = DeviceSetup {
        camera: Box::new(Scripted {
            info: INFO.clone(),
            steps: steps.into_iter(),
            when_full,
            fusion: Some(fusion),
            end: end.clone(),
            status: status.clone(),
            seen: seen.clone(),
            is_last_unwanted: false,
        }),
        capture: CaptureParams::default(),
        record: false,
        ir_offset: IrOffset::nearest([0.0, 0.0]),
        end,
        status: status.clone(),
    };
    let summary = run(setup, &frames, &recording, &events);
    let seen = *seen.lock().unwrap();
    (summary, seen, status)
}

proptest! {
    #[test]
    fn capture_ends_with_the_frame_in_hand_and_every_frame_is_accounted_for(
        steps in vec(step(), 0..60),
        may_drop in any::<bool>(),
    ) {
        let when_full = if may_drop { WhenFull::Drop } else { WhenFull::Block };
        let (summary, seen, status) = run_with(steps, when_full);
        prop_assert!(!seen.is_asked_in_vain);
        match summary.end {
            CaptureEnd::Stopped => prop_assert!(seen.is_stopped),
            CaptureEnd::Unwanted => prop_assert!(seen.is_left),
            CaptureEnd::EndOfStream => {}
            CaptureEnd::Failed(error) => prop_assert!(false, "{}", error),
        }
        let accounts = status.get().frames;
        prop_assert_eq!(accounts.produced, seen.n_frames + seen.n_damaged);
        prop_assert_eq!(accounts.produced, summary.n_frames);
        prop_assert_eq!((accounts.fused, accounts.damaged), (seen.n_taken, seen.n_damaged));
        prop_assert_eq!(accounts.missed, summary.n_missed);
        // The camera, and with it the end that fusion has of the edge, is gone.
        prop_assert_eq!((accounts.in_flight, accounts.unaccounted()), (0, 0));
    }
}
