//! What a Kinect of the stand-in is, and what happens to it: the files of its folder.
//!
//! `device.txt` holds lines `key = value`:
//!
//! | key | meaning | if left out |
//! |---|---|---|
//! | `model` | `1414`, `1473` or `k4w` | `1414` |
//! | `serial` | of the camera, or of the audio part where the camera has none | `A00000000000000A` |
//! | `frame_rate_hz` | of both streams; 0 runs as fast as packets are taken | 30 |
//! | `first_ticks` | the device clock when it is plugged in | 0 |
//! | `emitter_distance_cm`, `reference_distance_mm`, `reference_pixel_size_mm`, `const_shift` | zero plane | typical |
//! | `first_depth_after_ms`, `first_ir_after_ms` | from the start of a stream to its first frame | 0 |
//! | `lose_depth_every`, `lose_ir_every` | of so many packets the first ones are lost; 0 loses none | 0 |
//! | `lose_run` | how many | 1 |
//! | `free_step_us` | time that passes at each look where `frame_rate_hz` is 0: less is slower | 500 |
//! | `play_once` | `true`: frames are played once, from the first one on, and stamps count from there; then packets are empty | `false` |
//! | `freeze_ir_clock` | `true`: stamps of IR stand still while depth is off | `false` |
//!
//! `depth11.u16` and `ir10.u16` hold frames of 640×480 and 640×488 values, little-endian, played over and over; frame n of one
//! goes with frame n of the other. At 1280×1024 IR is `ir10-high.u16`, which comes with depth off alone. Where there is an `ir10-alone.u16`, its frames come in
//! place of the other smaller ones while depth is off, and while the file `covered` is there: the projector is dark then, or hidden.
//!
//! A program that has claimed the camera holds a lock on the file `claimed`: another one finds it busy.
//!
//! Files whose presence is looked at while the device is in use: `unplugged`, `denied` (opening is not permitted), `busy` (the
//! interface is claimed by another), `no-memory` (transfers cannot be submitted), `wedged` (control transfers do not
//! return), `silent-depth`, `silent-ir`, `covered` (depth goes on and finds nothing). `frame-limit` holds a number: where `frame_rate_hz` is 0, time stands still before the depth
//! frame of that number.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// The models that differ in what they report.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Model {
    /// The first one: its camera has a serial number.
    Xbox1414,
    /// Its camera's serial number is zeros; that of the audio part counts.
    Xbox1473,
    /// Kinect for Windows, likewise, with product ids of its own.
    KinectForWindows,
}

/// The contents of `device.txt`.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs, reason = "the table above")]
pub struct Device {
    pub model: Model,
    pub serial: String,
    pub frame_rate_hz: f64,
    pub first_ticks: u32,
    pub emitter_distance_cm: f32,
    pub reference_distance_mm: f32,
    pub reference_pixel_size_mm: f32,
    pub const_shift: u16,
    pub first_depth_after_ms: f64,
    pub first_ir_after_ms: f64,
    pub lose_depth_every: u64,
    pub lose_ir_every: u64,
    pub lose_run: u64,
    pub free_step_us: u64,
    pub play_once: bool,
    pub freeze_ir_clock: bool,
}

impl Default for Device {
    fn default() -> Self {
        Device {
            model: Model::Xbox1414,
            serial: "A00000000000000A".to_owned(),
            frame_rate_hz: 30.0,
            first_ticks: 0,
            emitter_distance_cm: 7.5,
            reference_distance_mm: 120.0,
            reference_pixel_size_mm: 0.1042,
            const_shift: 200,
            first_depth_after_ms: 0.0,
            first_ir_after_ms: 0.0,
            lose_depth_every: 0,
            lose_ir_every: 0,
            lose_run: 1,
            free_step_us: 500,
            play_once: false,
            freeze_ir_clock: false,
        }
    }
}

impl Device {
    /// Reads the lines of `device.txt`.
    ///
    /// # Errors
    /// Names the line that makes no sense.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut device = Device::default();
        for line in text.lines().filter(|line| !line.trim().is_empty()) {
            let (key, value) = line
                .split_once('=')
                .ok_or_else(|| format!("no = in {line:?}"))?;
            let known = device.set(key.trim(), value.trim());
            known.ok_or_else(|| format!("{line:?} makes no sense"))?;
        }
        Ok(device)
    }

    fn set(&mut self, key: &str, value: &str) -> Option<()> {
        match key {
            "model" => {
                self.model = match value {
                    "1414" => Model::Xbox1414,
                    "1473" => Model::Xbox1473,
                    "k4w" => Model::KinectForWindows,
                    _ => return None,
                }
            }
            "serial" => value.clone_into(&mut self.serial),
            "frame_rate_hz" => self.frame_rate_hz = value.parse().ok()?,
            "first_ticks" => self.first_ticks = value.parse().ok()?,
            "emitter_distance_cm" => self.emitter_distance_cm = value.parse().ok()?,
            "reference_distance_mm" => self.reference_distance_mm = value.parse().ok()?,
            "reference_pixel_size_mm" => self.reference_pixel_size_mm = value.parse().ok()?,
            "const_shift" => self.const_shift = value.parse().ok()?,
            "first_depth_after_ms" => self.first_depth_after_ms = value.parse().ok()?,
            "first_ir_after_ms" => self.first_ir_after_ms = value.parse().ok()?,
            "lose_depth_every" => self.lose_depth_every = value.parse().ok()?,
            "lose_ir_every" => self.lose_ir_every = value.parse().ok()?,
            "lose_run" => self.lose_run = value.parse().ok()?,
            "free_step_us" => self.free_step_us = value.parse().ok()?,
            "play_once" => self.play_once = value.parse().ok()?,
            "freeze_ir_clock" => self.freeze_ir_clock = value.parse().ok()?,
            _ => return None,
        }
        Some(())
    }
}

/// The folder of one Kinect.
#[derive(Clone, Debug)]
pub(crate) struct Folder {
    path: PathBuf,
}

impl Folder {
    /// Folders of all Kinects.
    pub(crate) fn all(root: &Path) -> Vec<Folder> {
        let entries = fs::read_dir(root).into_iter().flatten().flatten();
        let mut paths: Vec<_> = entries.map(|entry| entry.path()).collect();
        paths.retain(|path| path.join("device.txt").exists());
        paths.sort();
        paths.into_iter().map(|path| Folder { path }).collect()
    }

    /// Whether a file of that name is there.
    pub(crate) fn has(&self, name: &str) -> bool {
        self.path.join(name).exists()
    }

    pub(crate) fn device(&self) -> Result<Device, String> {
        let path = self.path.join("device.txt");
        let text = fs::read_to_string(&path).map_err(|error| error.to_string());
        text.and_then(|text| Device::parse(&text))
            .map_err(|what| format!("{}: {what}", path.display()))
    }

    /// The values of a file of 16-bit frames; none if it is not there.
    pub(crate) fn values(&self, name: &str) -> Vec<u16> {
        let bytes = fs::read(self.path.join(name)).unwrap_or_default();
        let values = bytes.chunks_exact(2);
        values.map(|b| u16::from_le_bytes([b[0], b[1]])).collect()
    }

    /// The number that a file holds; `None` if there is none.
    pub(crate) fn number(&self, name: &str) -> Option<u64> {
        let text = fs::read_to_string(self.path.join(name)).ok()?;
        text.trim().parse().ok()
    }

    pub(crate) fn claim_path(&self) -> PathBuf {
        self.path.join("claimed")
    }

    pub(crate) fn trace_path(&self) -> PathBuf {
        self.path.join("trace.txt")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_read_and_others_refused() {
        let device = Device::parse("model = k4w\n\nserial=B1\nlose_run = 7\n").unwrap();
        assert_eq!(device.model, Model::KinectForWindows);
        assert_eq!((device.serial.as_str(), device.lose_run), ("B1", 7));
        assert_eq!(device.frame_rate_hz, 30.0);
        for line in ["model = 1520", "speed = 3", "serial", "first_ticks = -1"] {
            assert!(Device::parse(line).is_err(), "{line}");
        }
    }
}
