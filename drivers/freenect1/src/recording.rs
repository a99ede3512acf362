//! Recordings of raw disparity and IR: what the device sent, to be turned into frames again.
//!
//! A recording is one folder. `kinect1.toml` holds serial, zero plane, gain and lamp; `disparity.txt` and `ir.txt` list the images as
//! `timestamp filename`, one a line, as sessions list theirs; images are 16-bit greyscale PNG: disparity 640×480 with values 0 to
//! 2047, 2047 for none, IR 640×488 or 1280×1024 with values 0 to 1023.

use std::{
    io::Write,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame, Image, Light};
use replay::{ListFile, Moment, Pacer, Pacing, PngEffort, WriteError};
use serde::{Deserialize, Serialize};

use crate::{
    assembly::RawFrame,
    disparity::ZeroPlane,
    frames::{DeviceRecord, FrameDecoder},
    streams::{DEPTH_SIZE, IrSize},
};

/// The description of the device in a recording's folder.
pub const RAW_DEVICE_FILE: &str = "kinect1.toml";

const DISPARITY_LIST: &str = "disparity.txt";
const IR_LIST: &str = "ir.txt";

fn ir_sizes() -> [(usize, usize); 2] {
    [IrSize::Medium, IrSize::High].map(IrSize::pixels)
}

/// The hash of what a recording holds, as [`replay::content_hash`] is that of a session.
///
/// # Errors
/// [`CameraError::Invalid`] for a description or list that cannot be read.
pub fn content_hash(folder: &Path) -> Result<String, CameraError> {
    replay::hash_of_files(folder, &[RAW_DEVICE_FILE], &[DISPARITY_LIST, IR_LIST])
}

/// The contents of `kinect1.toml`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct DeviceFile {
    serial: String,
    ir_gain: u16,
    ir_offset_px: [f64; 2],
    #[serde(skip_serializing_if = "Option::is_none")]
    lamp_position_m: Option<[f64; 3]>,
    zero_plane: ZeroPlaneEntry,
}

/// The constants of triangulation, in the device's own units.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ZeroPlaneEntry {
    emitter_distance_cm: f64,
    reference_distance_mm: f64,
    reference_pixel_size_mm: f64,
    const_shift: f64,
}

impl DeviceFile {
    fn of_device(device: &DeviceRecord) -> Self {
        let plane = &device.zero_plane;
        DeviceFile {
            serial: device.serial.clone(),
            ir_gain: device.ir_gain,
            ir_offset_px: device.ir_offset_px,
            lamp_position_m: device.lamp_position_m,
            zero_plane: ZeroPlaneEntry {
                emitter_distance_cm: plane.emitter_distance_cm,
                reference_distance_mm: plane.reference_distance_mm,
                reference_pixel_size_mm: plane.reference_pixel_size_mm,
                const_shift: plane.const_shift,
            },
        }
    }

    fn device(self) -> DeviceRecord {
        let plane = self.zero_plane;
        DeviceRecord {
            serial: self.serial,
            zero_plane: ZeroPlane {
                emitter_distance_cm: plane.emitter_distance_cm,
                reference_distance_mm: plane.reference_distance_mm,
                reference_pixel_size_mm: plane.reference_pixel_size_mm,
                const_shift: plane.const_shift,
            },
            ir_gain: self.ir_gain,
            ir_offset_px: self.ir_offset_px,
            lamp_position_m: self.lamp_position_m,
        }
    }
}

/// A recording of raw disparity and IR, turned into frames as it is played.
///
/// `frame_id` counts the moments of the recording from 0; an image that cannot be read costs its moment.
#[derive(Debug)]
pub struct RawDisparityCamera {
    folder: PathBuf,
    info: CameraInfo,
    decoder: FrameDecoder,
    moments: Vec<Moment>,
    next: usize,
    pacer: Pacer,
}

impl RawDisparityCamera {
    /// Opens a recording's folder; everything but the images is read and checked.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] naming file, key or line, value and bound.
    pub fn open(folder: &Path) -> Result<Self, CameraError> {
        let path = folder.join(RAW_DEVICE_FILE);
        let text = replay::read_ordinary_text(&path).map_err(|error| invalid(&path, error))?;
        let device: DeviceFile =
            toml::from_str(&text).map_err(|error| invalid(&path, error.to_string().trim_end()))?;
        let device = device.device();
        let decoder =
            FrameDecoder::new(&device.zero_plane).map_err(|error| invalid(&path, error))?;
        check_lamp(&device).map_err(|error| invalid(&path, error))?;
        let in_image = |offset: f64, side: usize| offset.abs() < side as f64 / 2.0;
        let [right, down] = device.ir_offset_px;
        if !in_image(right, DEPTH_SIZE.0) || !in_image(down, DEPTH_SIZE.1) {
            return Err(invalid(
                &path,
                format!("ir_offset_px is [{right}, {down}], must be less than half of the image"),
            ));
        }
        let list_path = folder.join(DISPARITY_LIST);
        let disparity = replay::read_list(&list_path)?;
        let ir = replay::read_list(&folder.join(IR_LIST))?;
        let moments = replay::merge_lists(disparity, ir);
        if moments.is_empty() {
            return Err(invalid(&list_path, "holds no frame"));
        }
        Ok(RawDisparityCamera {
            folder: folder.to_owned(),
            info: device.camera_info(Some(moments.len())),
            decoder,
            moments,
            next: 0,
            pacer: Pacer::default(),
        })
    }

    /// The same recording at another pace.
    pub fn with_pacing(self, pacing: Pacing) -> Self {
        RawDisparityCamera {
            pacer: Pacer::new(pacing),
            ..self
        }
    }

    fn read(&self, index: usize) -> Result<RawFrame, String> {
        let moment = &self.moments[index];
        let image = |name: &Option<String>, sizes: &[(usize, usize)]| {
            let path = name.as_ref().map(|name| self.folder.join(name));
            path.map(|path| {
                replay::read_png_of_size(&path, sizes)
                    .map_err(|what| format!("{}: {what}", path.display()))
            })
            .transpose()
        };
        Ok(RawFrame {
            frame_id: index as u64,
            device_time_secs: moment.time_secs,
            host_time: Instant::now(),
            disparity: image(&moment.depth, &[DEPTH_SIZE])?,
            ir: image(&moment.ir, &ir_sizes())?,
        })
    }
}

impl DepthCamera for RawDisparityCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        let index = self.next;
        let Some(moment) = self.moments.get(index) else {
            return Ok(None);
        };
        self.pacer.wait_until_due(moment.time_secs, timeout)?;
        self.next += 1;
        let frame_id = index as u64;
        let raw = self
            .read(index)
            .map_err(|reason| CameraError::DamagedFrame { frame_id, reason })?;
        Ok(Some(self.decoder.frame(raw)))
    }
}

/// A recording of raw disparity and IR being written.
///
/// The folder is a whole recording after every call: an image is written beside its name, renamed, and only then listed.
#[derive(Debug)]
pub struct RawDisparityWriter {
    folder: PathBuf,
    disparity_list: ListFile,
    ir_list: ListFile,
    n_moments: usize,
    last_time_secs: Option<f64>,
}

impl RawDisparityWriter {
    /// Begins a recording in `folder`, which is created and must be empty otherwise.
    ///
    /// # Errors
    /// [`WriteError::NotEmpty`], [`WriteError::Io`], or [`WriteError::Camera`] for constants or a lamp that make no sense.
    pub fn create(folder: &Path, device: &DeviceRecord) -> Result<Self, WriteError> {
        let path = folder.join(RAW_DEVICE_FILE);
        let constants = device.zero_plane.validate();
        constants.map_err(|error| invalid(&path, error))?;
        check_lamp(device).map_err(|error| invalid(&path, error))?;
        let text = toml::to_string(&DeviceFile::of_device(device));
        let text = text.map_err(|error| invalid(&path, error))?;
        replay::create_empty_folder(folder)?;
        for images in ["disparity", "ir"] {
            replay::create_folder(&folder.join(images))?;
        }
        replay::write_whole_file(&path, |out| out.write_all(text.as_bytes()))?;
        Ok(RawDisparityWriter {
            folder: folder.to_owned(),
            disparity_list: ListFile::create(folder.join(DISPARITY_LIST))?,
            ir_list: ListFile::create(folder.join(IR_LIST))?,
            n_moments: 0,
            last_time_secs: None,
        })
    }

    /// Appends what a moment holds.
    ///
    /// # Errors
    /// [`WriteError::Frame`] for images of another size, for none at all, and for a time that is not finite or not at least a
    /// microsecond after the last one; [`WriteError::Io`].
    pub fn write(&mut self, raw: &RawFrame) -> Result<(), WriteError> {
        self.check(raw).map_err(|reason| WriteError::Frame {
            frame_id: raw.frame_id,
            reason,
        })?;
        let disparity_name = format!("disparity/{:06}.png", self.n_moments);
        let ir_name = format!("ir/{:06}.png", self.n_moments);
        // Two images at 30 Hz, beside decoding: no more effort than that allows.
        if let Some(disparity) = &raw.disparity {
            let path = self.folder.join(&disparity_name);
            replay::write_png(&path, disparity, PngEffort::Live)?;
        }
        if let Some(ir) = &raw.ir {
            replay::write_png(&self.folder.join(&ir_name), ir, PngEffort::Live)?;
        }
        // Number and time are used up even if the lists are not written: a second try never meets half a first one.
        self.n_moments += 1;
        self.last_time_secs = Some(raw.device_time_secs);
        if raw.disparity.is_some() {
            self.disparity_list
                .append(raw.device_time_secs, &disparity_name)?;
        }
        if raw.ir.is_some() {
            self.ir_list.append(raw.device_time_secs, &ir_name)?;
        }
        Ok(())
    }

    fn check(&self, raw: &RawFrame) -> Result<(), String> {
        check_size("disparity", raw.disparity.as_ref(), &[DEPTH_SIZE])?;
        check_size("IR", raw.ir.as_ref(), &ir_sizes())?;
        if raw.disparity.is_none() && raw.ir.is_none() {
            return Err("it holds no image".to_owned());
        }
        let time_secs = raw.device_time_secs;
        // The lists keep microseconds; half of one is for the rounding of a difference.
        let follows = |last_secs: f64| time_secs - last_secs > 0.5e-6;
        match time_secs.is_finite() && self.last_time_secs.is_none_or(follows) {
            true => Ok(()),
            false => Err(format!(
                "its time is {time_secs} s, must be finite and follow {:?} s",
                self.last_time_secs.unwrap_or(f64::NEG_INFINITY)
            )),
        }
    }

    /// Ends the recording: hands the lists to the disk and returns how many moments there are.
    ///
    /// # Errors
    /// [`WriteError::Io`].
    pub fn finish(self) -> Result<usize, WriteError> {
        self.disparity_list.sync()?;
        self.ir_list.sync()?;
        Ok(self.n_moments)
    }
}

fn check_lamp(device: &DeviceRecord) -> Result<(), String> {
    match device.lamp_position_m {
        Some(position_m) => Light::check_position("lamp_position_m", position_m),
        None => Ok(()),
    }
}

fn check_size(
    what: &str,
    image: Option<&Image<u16>>,
    sizes: &[(usize, usize)],
) -> Result<(), String> {
    match image.map(|image| (image.width(), image.height())) {
        Some((width, height)) if !sizes.contains(&(width, height)) => Err(format!(
            "{what} is {width}×{height}, must be {}",
            replay::any_of_sizes(sizes)
        )),
        _ => Ok(()),
    }
}

/// An error that begins with the file's name.
fn invalid(path: &Path, what: impl std::fmt::Display) -> CameraError {
    CameraError::Invalid(format!("{}: {what}", path.display()))
}

#[cfg(test)]
mod tests;
