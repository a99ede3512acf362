//! The ends of the pipeline that touch the outside: the device thread, which takes frames from a camera, and the recorder,
//! which writes frames and events to the disk.
//!
//! Both are plain loops over what they are given; threads and channels are made by `pipeline`.

mod continuity;
mod device;
mod event;
mod event_file;
mod frame_recorder;
mod infrared_rate;
mod ir_offset;
mod recorder;
mod shared_frames;
mod unrecorded;

pub use device::{CaptureEnd, CaptureSummary, Delivery, DeviceHealth, run_device};
pub use event::{Event, EventKind, Tracked};
pub use event_file::EVENTS_FILE;
pub use frame_recorder::{RecordFormat, RecordingStanding};
pub use infrared_rate::InfraredRate;
pub use ir_offset::IrOffset;
pub use recorder::{Recorder, RecorderSummary};
pub use shared_frames::{DeliveredFrame, SharedFrames};
pub use unrecorded::Unrecorded;

use serde::{Deserialize, Serialize};
use std::time::Duration;

/// What the device thread and the recorder need to know.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct CaptureParams {
    /// How long to wait for one frame before looking whether to stop, seconds.
    pub grab_timeout_secs: f64,
    /// A device that is silent for longer is given up, seconds; a live one counts as gone.
    pub max_silence_secs: f64,
    /// A live device that is gone is awaited for so long, seconds, once it has delivered a frame.
    pub reconnect_secs: f64,
    /// Depth of a recording is stored in steps of 1 / this many metres, in 16 bits: [`CaptureParams::check_depth_range`].
    pub record_depth_units_per_metre: f64,
    /// Kinect I: how the projector's speckle is kept out of shading images.
    pub shading: ShadingStrategy,
    /// What frames are recorded as.
    pub record_format: RecordFormat,
    /// Which infrared images are recorded, with [`RecordFormat::Mcap`].
    pub record_ir: InfraredRate,
    /// Recording stops before there is less room on the disk, and the daemon starts no scan, megabytes (10⁶ bytes), 0 to 1000000.
    pub min_free_disk_mb: u32,
}

/// How a Kinect I comes by IR images without its projector's speckle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ShadingStrategy {
    /// The operator covers the projector.
    #[default]
    Shutter,
    /// The program stops depth, which is said to switch the projector off on some devices; images that show speckle all the same
    /// are refused.
    StopDepth,
}

/// More than any disk's reserve.
const MAX_FREE_DISK_MB: u32 = 1_000_000;

impl Default for CaptureParams {
    fn default() -> Self {
        CaptureParams {
            grab_timeout_secs: 0.5,
            max_silence_secs: 10.0,
            reconnect_secs: 600.0,
            record_depth_units_per_metre: 5000.0,
            shading: ShadingStrategy::default(),
            record_format: RecordFormat::default(),
            record_ir: InfraredRate::default(),
            min_free_disk_mb: 1000,
        }
    }
}

impl CaptureParams {
    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        for (key, value, low, high) in [
            ("grab_timeout_secs", self.grab_timeout_secs, 0.01, 5.0),
            ("max_silence_secs", self.max_silence_secs, 0.1, 3600.0),
            ("reconnect_secs", self.reconnect_secs, 0.0, 86_400.0),
            (
                "record_depth_units_per_metre",
                self.record_depth_units_per_metre,
                1000.0,
                50_000.0,
            ),
        ] {
            if !(value >= low && value <= high) {
                return Err(format!("capture.{key} is {value}, must be {low} to {high}"));
            }
        }
        if self.min_free_disk_mb > MAX_FREE_DISK_MB {
            return Err(format!(
                "capture.min_free_disk_mb is {}, must be at most {MAX_FREE_DISK_MB}",
                self.min_free_disk_mb
            ));
        }
        Ok(())
    }

    /// Checks that recorded depth, which has 16 bits, holds all that is fused: what is farther away would be recorded as none.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn check_depth_range(&self, depth_max_m: f64) -> Result<(), String> {
        let units = self.record_depth_units_per_metre;
        let high = f64::from(u16::MAX) / depth_max_m;
        match units <= high {
            true => Ok(()),
            false => Err(format!(
                "capture.record_depth_units_per_metre is {units}, must be at most {high:.1}: depth is recorded in 16 bits, \
                 and fusion.depth_max_m is {depth_max_m}"
            )),
        }
    }

    /// The room that the disk must have, bytes.
    pub fn min_free_bytes(&self) -> u64 {
        u64::from(self.min_free_disk_mb) * 1_000_000
    }

    fn grab_timeout(&self) -> Duration {
        Duration::from_secs_f64(self.grab_timeout_secs)
    }

    fn reconnect(&self) -> Duration {
        Duration::from_secs_f64(self.reconnect_secs)
    }

    fn max_silence(&self) -> Duration {
        Duration::from_secs_f64(self.max_silence_secs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_that_is_fused_must_find_room_in_a_recording() {
        let fine = CaptureParams {
            record_depth_units_per_metre: 50_000.0,
            ..CaptureParams::default()
        };
        fine.validate().unwrap();
        fine.check_depth_range(1.3).unwrap();
        let refused = fine.check_depth_range(2.0).unwrap_err();
        let expected =
            "capture.record_depth_units_per_metre is 50000, must be at most 32767.5: depth is";
        assert!(refused.starts_with(expected), "{refused}");
        // The farthest that fusion takes, by default.
        CaptureParams::default().check_depth_range(12.0).unwrap();
    }
}
