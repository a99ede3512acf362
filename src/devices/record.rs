//! Recording what a device sends, nothing decoded, while its frames go on to whoever grabs them.

use super::LiveCamera;
use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame};
use freenect1::RawDisparityWriter;
use freenect2::RawPacketWriter;
use replay::WriteError;
use std::{path::Path, time::Duration};

/// A recording of raw data being written.
#[derive(Debug)]
pub enum RawRecording {
    /// Disparity and IR of a Kinect I.
    Kinect1(RawDisparityWriter),
    /// Packets of a Kinect II.
    Kinect2(RawPacketWriter),
}

impl RawRecording {
    /// Begins a recording of that camera in a folder, new or empty.
    fn create(camera: &LiveCamera, folder: &Path) -> Result<Self, WriteError> {
        match camera {
            #[cfg(feature = "kinect1")]
            LiveCamera::Kinect1(camera) => {
                RawDisparityWriter::create(folder, camera.device()).map(RawRecording::Kinect1)
            }
            LiveCamera::Kinect2(camera) => {
                RawPacketWriter::create(folder, camera.device()).map(RawRecording::Kinect2)
            }
        }
    }

    fn finish(self) -> Result<(), WriteError> {
        match self {
            RawRecording::Kinect1(writer) => writer.finish().map(|_| ()),
            RawRecording::Kinect2(writer) => writer.finish().map(|_| ()),
        }
    }
}

/// A live camera whose raw data are recorded: a replay of the recording delivers the frames that were grabbed, bit by bit.
///
/// A recording that cannot be written any more is ended and told of; frames go on.
#[derive(Debug)]
pub struct RecordedCamera {
    camera: LiveCamera,
    recording: Option<RawRecording>,
    n_recorded: usize,
    failure: Option<WriteError>,
}

impl RecordedCamera {
    /// Begins a recording in a folder, new or empty.
    ///
    /// # Errors
    /// [`WriteError`].
    pub fn create(camera: LiveCamera, folder: &Path) -> Result<Self, WriteError> {
        Ok(RecordedCamera {
            recording: Some(RawRecording::create(&camera, folder)?),
            camera,
            n_recorded: 0,
            failure: None,
        })
    }

    /// Whether the recording goes on.
    pub fn is_recording(&self) -> bool {
        self.recording.is_some()
    }

    /// How many moments the recording holds.
    pub fn n_recorded(&self) -> usize {
        self.n_recorded
    }

    /// Ends the recording.
    ///
    /// # Errors
    /// What ended the recording before, or keeps it from being safe on the disk.
    pub fn finish(self) -> Result<(), WriteError> {
        match (self.failure, self.recording) {
            (Some(failure), _) => Err(failure),
            (None, recording) => recording.map_or(Ok(()), RawRecording::finish),
        }
    }

    /// Ends a recording that cannot be written any more: what there is stays whole.
    fn end_with(&mut self, failure: WriteError) {
        tracing::error!(error = %failure, "raw recording stopped");
        let ended = self.recording.take().map(RawRecording::finish);
        if let Some(Err(error)) = ended {
            tracing::error!(%error, "the raw recording may not be safe on the disk");
        }
        self.failure = Some(failure);
    }

    /// Grabs and records; what could not be written comes beside the frame.
    fn grab_and_write(
        &mut self,
        timeout: Duration,
    ) -> Result<(Option<Frame>, Result<(), WriteError>), CameraError> {
        match (&mut self.camera, &mut self.recording) {
            #[cfg(feature = "kinect1")]
            (LiveCamera::Kinect1(camera), Some(RawRecording::Kinect1(writer))) => {
                let raw = camera.grab_raw(timeout)?;
                let written = writer.write(&raw);
                Ok((Some(camera.decode(raw)), written))
            }
            (LiveCamera::Kinect2(camera), Some(RawRecording::Kinect2(writer))) => {
                let frame = camera.grab(timeout)?;
                let written = frame.as_ref().map_or(Ok(()), |frame| {
                    writer.write(camera.last_packet(), frame.device_time_secs)
                });
                Ok((frame, written))
            }
            (camera, _) => Ok((camera.grab(timeout)?, Ok(()))),
        }
    }
}

impl DepthCamera for RecordedCamera {
    fn info(&self) -> &CameraInfo {
        self.camera.info()
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        let (frame, written) = self.grab_and_write(timeout)?;
        match written {
            Ok(()) => self.n_recorded += usize::from(self.is_recording() && frame.is_some()),
            Err(error @ WriteError::Frame { .. }) => tracing::warn!(%error, "not recorded"),
            Err(error) => self.end_with(error),
        }
        Ok(frame)
    }

    fn n_missed(&self) -> u64 {
        self.camera.n_missed()
    }

    fn pause_depth(&mut self) -> Result<(), CameraError> {
        self.camera.pause_depth()
    }

    fn resume_depth(&mut self) -> Result<(), CameraError> {
        self.camera.resume_depth()
    }
}
