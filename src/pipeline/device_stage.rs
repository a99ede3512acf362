//! The device thread: the camera's frames to fusion and recorder.

use super::{
    edges::{FrameSender, RecordingSender, TrackedSender},
    status::{StatusSlot, StopToken},
};
use crate::capture::{
    CaptureParams, CaptureSummary, Delivery, DeviceHealth, Event, EventKind, IrOffset,
    SharedFrames, Tracked, run_device,
};
use depth_camera::{DepthCamera, Frame};

/// What the device thread needs to know.
pub struct DeviceSetup {
    /// The camera.
    pub camera: Box<dyn DepthCamera>,
    /// Its timeouts.
    pub capture: CaptureParams,
    /// Whether the recorder gets the frames, as the camera delivers them.
    pub record: bool,
    /// Where the camera's IR image lies; fusion gets frames without the offset.
    pub ir_offset: IrOffset,
    /// Ends capture.
    pub end: StopToken,
    /// Where the accounts of the frames are.
    pub status: StatusSlot,
}

/// Runs the camera to the end of its stream.
pub fn run(
    mut setup: DeviceSetup,
    frames: &FrameSender,
    recording: &RecordingSender,
    events: &TrackedSender,
) -> CaptureSummary {
    let end = setup.end.flag();
    let mut last_frame_id = 0;
    let mut shared = SharedFrames::default();
    let (record, ir_offset) = (setup.record, setup.ir_offset);
    let mut pass_on = |frame: Frame| {
        if !record {
            return frames.send(shared.share(ir_offset.remove_from(frame)));
        }
        // Recorded as the camera delivers it; fusion gets the same frame with its IR moved.
        let delivered = shared.share_without(ir_offset, frame);
        recording.send(delivered.clone());
        frames.send(delivered.frame)
    };
    run_device(
        setup.camera.as_mut(),
        &setup.capture,
        end,
        |delivery| match delivery {
            Delivery::Event(event) => {
                if let EventKind::Damaged { .. } = event.kind {
                    setup.status.update(|status| status.frames.damaged());
                }
                events.send(Tracked::Event(event));
                true
            }
            Delivery::Health(health) => {
                setup.status.update(|status| {
                    status.device = health;
                    status.n_device_gaps += u64::from(health == DeviceHealth::Streaming);
                });
                events.send(Tracked::Event(Event {
                    frame_id: last_frame_id,
                    device_time_secs: None,
                    kind: EventKind::Device { health },
                }));
                true
            }
            Delivery::Missed(total) => {
                setup.status.update(|status| status.frames.missed = total);
                true
            }
            Delivery::Frame(frame) => {
                last_frame_id = frame.frame_id;
                pass_on(frame)
            }
        },
    )
}

#[cfg(test)]
mod ending_tests;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::DeliveredFrame;
    use crate::pipeline::{
        edges::{self, DropCounts, FrameReceiver, WhenFull},
        event_log::EventLog,
    };
    use counting_allocator::{CountingAllocator, n_of_thread};
    use crossbeam::channel::Receiver;
    use depth_camera::{CameraError, CameraInfo, Image, ImagePool};
    use simulated::SimulatedCamera;
    use std::{
        collections::VecDeque,
        sync::{Arc, Mutex},
        time::{Duration, Instant},
    };

    #[global_allocator]
    static ALLOCATOR: CountingAllocator = CountingAllocator;

    const WIDTH: usize = 64;
    const HEIGHT: usize = 48;
    const N_FRAMES: usize = 60;

    /// A camera as the drivers are, which asks for no memory. Before it delivers a frame it takes an older one out of the edges,
    /// as fusion and recorder would.
    struct Pooled {
        info: CameraInfo,
        depth: ImagePool<f32>,
        ir: ImagePool<u16>,
        fusion: FrameReceiver,
        recorder: Receiver<DeliveredFrame>,
        is_moved: bool,
        /// Where the images are that were delivered and not taken out yet: depth and IR.
        delivered: VecDeque<[usize; 2]>,
        /// The thread's requests for memory so far, at each frame.
        n_allocations: Arc<Mutex<Vec<u64>>>,
    }

    impl Pooled {
        /// Looks at what arrives, and that no image was copied but IR, once, where recorder and fusion need different ones.
        fn take_frames_out(&mut self) {
            if self.fusion.channel().len() < 3 {
                return;
            }
            let fused = self.fusion.channel().try_recv().unwrap();
            let corners = |ir: &Image<u16>| [*ir.at(0, 0), *ir.at(WIDTH - 1, HEIGHT - 1)];
            let shown = fused.frame_id as u16;
            let ir = fused.ir.as_ref().unwrap();
            let expected = if self.is_moved { 0 } else { shown };
            assert_eq!(corners(ir), [shown, expected], "moved up and to the left");
            let places = |frame: &Frame, ir: &Image<u16>| {
                let depth = frame.depth.as_ref().unwrap();
                [depth.data().as_ptr().addr(), ir.data().as_ptr().addr()]
            };
            let delivered = self.delivered.pop_front().unwrap();
            assert_eq!(
                places(&fused, ir),
                delivered,
                "not copied on the way to fusion"
            );
            if let Ok(recorded) = self.recorder.try_recv() {
                assert_eq!(recorded.frame.frame_id, fused.frame_id);
                let ir = recorded.infrared().unwrap();
                assert_eq!(corners(ir), [shown, shown], "as it was delivered");
                let [depth_place, ir_place] = places(&recorded.frame, ir);
                assert_eq!(depth_place, delivered[0], "one depth image for both");
                assert_eq!(ir_place != delivered[1], self.is_moved);
            }
        }
    }

    impl DepthCamera for Pooled {
        fn info(&self) -> &CameraInfo {
            &self.info
        }

        fn grab(&mut self, _timeout: Duration) -> Result<Option<Frame>, CameraError> {
            self.take_frames_out();
            let mut n_allocations = self.n_allocations.lock().unwrap();
            if n_allocations.len() == N_FRAMES {
                return Ok(None);
            }
            n_allocations.push(n_of_thread());
            let frame_id = n_allocations.len() as u64;
            let mut ir = self.ir.take(WIDTH * HEIGHT);
            ir.fill(frame_id as u16);
            let depth = self.depth.take(WIDTH * HEIGHT);
            self.delivered
                .push_back([depth.as_ptr().addr(), ir.as_ptr().addr()]);
            Ok(Some(Frame {
                frame_id,
                device_time_secs: frame_id as f64,
                host_time: Instant::now(),
                depth: Some(self.depth.image(WIDTH, HEIGHT, depth)),
                ir: Some(self.ir.image(WIDTH, HEIGHT, ir)),
            }))
        }
    }

    /// Requests for memory in the first and in the second half of the frames.
    fn n_allocations(record: bool, ir_offset: IrOffset) -> (u64, u64) {
        let status = StatusSlot::default();
        let (frames, fusion) = edges::frames(WhenFull::Block, &status);
        let (recording, recorder) =
            edges::recording(WhenFull::Block, &Arc::new(DropCounts::default()));
        let (events, _events) = edges::tracked(&EventLog::default());
        let n_allocations = Arc::new(Mutex::new(Vec::with_capacity(N_FRAMES)));
        let setup = DeviceSetup {
            camera: Box::new(Pooled {
                info: SimulatedCamera::kinect1_plaque(1, 0).info().clone(),
                depth: ImagePool::new(16),
                ir: ImagePool::new(16),
                fusion,
                recorder,
                is_moved: !ir_offset.is_zero(),
                delivered: VecDeque::with_capacity(N_FRAMES),
                n_allocations: n_allocations.clone(),
            }),
            capture: CaptureParams::default(),
            record,
            ir_offset,
            end: StopToken::default(),
            status,
        };
        run(setup, &frames, &recording, &events);
        let counts = n_allocations.lock().unwrap();
        let middle = counts[N_FRAMES / 2];
        (middle - counts[0], counts[N_FRAMES - 1] - middle)
    }

    #[test]
    fn frames_go_on_without_copies_or_asking_for_memory_once_they_flow() {
        for (record, offset_px) in [(false, [5.0, 4.0]), (true, [5.0, 4.0]), (true, [0.0; 2])] {
            let (warming_up, steady) = n_allocations(record, IrOffset::nearest(offset_px));
            assert!(warming_up > 0, "the counter counts");
            assert_eq!(steady, 0, "recording: {record}, offset {offset_px:?}");
        }
    }
}
