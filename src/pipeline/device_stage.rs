//! The device thread: the camera's frames to fusion and recorder.

use super::{
    edges::{FrameSender, RecordingSender, TrackedSender},
    status::{StatusSlot, StopToken},
};
use crate::capture::{
    CaptureParams, CaptureSummary, Delivery, DeviceHealth, Event, EventKind, IrOffset, Tracked,
    run_device,
};
use depth_camera::DepthCamera;

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
            Delivery::Frame(frame) => {
                last_frame_id = frame.frame_id;
                if setup.record {
                    recording.send(frame.clone());
                }
                frames.send(setup.ir_offset.remove_from(frame))
            }
        },
    )
}
