//! The device thread: the camera's frames to fusion and recorder.

use super::{
    edges::{FrameSender, RecordingSender},
    status::StopToken,
};
use crate::capture::{CaptureParams, CaptureSummary, Delivery, IrOffset, Tracked, run_device};
use crossbeam::channel::Sender;
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
    pub stop: StopToken,
}

/// Runs the camera to the end of its stream.
pub fn run(
    mut setup: DeviceSetup,
    frames: &FrameSender,
    recording: &RecordingSender,
    events: &Sender<Tracked>,
) -> CaptureSummary {
    let stop = setup.stop.flag();
    run_device(
        setup.camera.as_mut(),
        &setup.capture,
        stop,
        |delivery| match delivery {
            // A recorder that is gone is told of where its thread is joined; fusion goes on without it.
            Delivery::Event(event) => {
                let _ = events.send(Tracked::Event(event));
                true
            }
            Delivery::Frame(frame) => {
                if setup.record {
                    recording.send(frame.clone());
                }
                frames.send(setup.ir_offset.remove_from(frame))
            }
        },
    )
}
