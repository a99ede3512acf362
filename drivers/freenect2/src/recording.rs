//! Recordings of raw packets: everything the device said, to be decoded again and better.
//!
//! A recording is one folder. `ir_parameters.toml` holds serial, firmware and IR camera, `p0.bin` the device's answer with
//! its phase tables, `packets.txt` lists the packets as `timestamp filename`, one a line, as sessions list their images, and
//! `packets/000000.k2` and so on are the packets themselves, 2 984 960 bytes each: 90 MB a second.

use std::{
    io::Write,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame};
use replay::{Entry, ListFile, Pacer, Pacing, WriteError};
use serde::{Deserialize, Serialize};

use crate::{
    frames::{self, FrameDecoder},
    ir_parameters::IrParameters,
    options::DecoderOptions,
    p0_tables::{P0LengthError, P0Tables},
    packet::RawPacket,
};

/// The description of the device in a recording's folder.
pub const RAW_DEVICE_FILE: &str = "ir_parameters.toml";

const TABLES_FILE: &str = "p0.bin";
const LIST_FILE: &str = "packets.txt";
const PACKET_FOLDER: &str = "packets";

/// The hash of what a recording holds, as [`replay::content_hash`] is that of a session.
///
/// # Errors
/// [`CameraError::Invalid`] for a description or list that cannot be read.
pub fn content_hash(folder: &Path) -> Result<String, CameraError> {
    replay::hash_of_files(folder, &[RAW_DEVICE_FILE, TABLES_FILE], &[LIST_FILE])
}

/// What a device says of itself, all that decoding needs.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceRecord {
    /// The device's serial number.
    pub serial: String,
    /// Version of its firmware.
    pub firmware: String,
    /// Its IR camera.
    pub ir_parameters: IrParameters,
    /// Its answer to the command for the phase tables.
    pub p0_response: Vec<u8>,
}

/// The contents of `ir_parameters.toml`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct DeviceFile {
    serial: String,
    firmware: String,
    ir_camera: IrParameters,
}

impl DeviceRecord {
    /// Reads the device's part of a recording.
    fn read(folder: &Path) -> Result<Self, CameraError> {
        let device_path = folder.join(RAW_DEVICE_FILE);
        let text = replay::read_ordinary_text(&device_path)
            .map_err(|error| invalid(&device_path, error))?;
        let device: DeviceFile = toml::from_str(&text)
            .map_err(|error| invalid(&device_path, error.to_string().trim_end()))?;
        device
            .ir_camera
            .validate()
            .map_err(|error| invalid(&device_path, error))?;
        let tables_path = folder.join(TABLES_FILE);
        let p0_response = replay::read_ordinary_file(&tables_path)
            .map_err(|error| invalid(&tables_path, error))?;
        Ok(DeviceRecord {
            serial: device.serial,
            firmware: device.firmware,
            ir_parameters: device.ir_camera,
            p0_response,
        })
    }

    /// The phase tables in the answer.
    ///
    /// # Errors
    /// [`P0LengthError`] if it is not whole.
    pub fn p0_tables(&self) -> Result<P0Tables, P0LengthError> {
        P0Tables::from_response(&self.p0_response)
    }
}

/// A recording of raw packets, decoded as it is played.
///
/// `frame_id` counts the packets of the recording from 0; a packet that cannot be read or is not whole costs its frame.
/// Frames are not mirrored.
#[derive(Debug)]
pub struct RawPacketCamera {
    folder: PathBuf,
    info: CameraInfo,
    decoder: FrameDecoder,
    packets: Vec<Entry>,
    next: usize,
    pacer: Pacer,
}

impl RawPacketCamera {
    /// Opens a recording's folder; everything but the packets is read and checked.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] naming file, key or line, value and bound, or the option.
    pub fn open(folder: &Path, options: DecoderOptions) -> Result<Self, CameraError> {
        let device = DeviceRecord::read(folder)?;
        let tables = device
            .p0_tables()
            .map_err(|error| invalid(&folder.join(TABLES_FILE), error))?;
        let list_path = folder.join(LIST_FILE);
        let packets = replay::read_list(&list_path)?;
        if packets.is_empty() {
            return Err(invalid(&list_path, "holds no packet"));
        }
        let camera = &device.ir_parameters;
        let decoder = FrameDecoder::new(&tables, camera, options)
            .map_err(|error| CameraError::Invalid(error.to_string()))?;
        Ok(RawPacketCamera {
            folder: folder.to_owned(),
            info: frames::camera_info(&device.serial, camera, Some(packets.len())),
            decoder,
            packets,
            next: 0,
            pacer: Pacer::default(),
        })
    }

    /// The same recording at another pace.
    pub fn with_pacing(self, pacing: Pacing) -> Self {
        RawPacketCamera {
            pacer: Pacer::new(pacing),
            ..self
        }
    }

    /// Reads and decodes one packet; an error names the file.
    fn decode(&mut self, index: usize) -> Result<Frame, String> {
        let entry = &self.packets[index];
        let path = self.folder.join(&entry.file_name);
        let named = |what: &dyn std::fmt::Display| format!("{}: {what}", path.display());
        let bytes = replay::read_ordinary_file(&path).map_err(|error| named(&error))?;
        let packet = RawPacket::new(&bytes).map_err(|error| named(&error))?;
        let frame_id = index as u64;
        Ok(self
            .decoder
            .frame(packet, frame_id, entry.time_secs, Instant::now()))
    }
}

impl DepthCamera for RawPacketCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        let index = self.next;
        let Some(entry) = self.packets.get(index) else {
            return Ok(None);
        };
        self.pacer.wait_until_due(entry.time_secs, timeout)?;
        self.next += 1;
        let frame_id = index as u64;
        self.decode(index)
            .map(Some)
            .map_err(|reason| CameraError::DamagedFrame { frame_id, reason })
    }
}

/// A recording of raw packets being written.
///
/// The folder is a whole recording after every call: a packet is written beside its name, renamed, and only then listed.
#[derive(Debug)]
pub struct RawPacketWriter {
    folder: PathBuf,
    list: ListFile,
    n_packets: usize,
    last_time_secs: Option<f64>,
}

impl RawPacketWriter {
    /// Begins a recording in `folder`, which is created and must be empty otherwise.
    ///
    /// # Errors
    /// [`WriteError::NotEmpty`], [`WriteError::Io`], or [`WriteError::Camera`] for a device that could not be decoded.
    pub fn create(folder: &Path, device: &DeviceRecord) -> Result<Self, WriteError> {
        let device_path = folder.join(RAW_DEVICE_FILE);
        let invalid = |path: &Path, what: &dyn std::fmt::Display| {
            WriteError::Camera(invalid(path, what.to_string()))
        };
        let camera = device.ir_parameters;
        camera
            .validate()
            .map_err(|error| invalid(&device_path, &error))?;
        device
            .p0_tables()
            .map_err(|error| invalid(&folder.join(TABLES_FILE), &error))?;
        let text = toml::to_string(&DeviceFile {
            serial: device.serial.clone(),
            firmware: device.firmware.clone(),
            ir_camera: camera,
        });
        let text = text.map_err(|error| invalid(&device_path, &error))?;

        replay::create_empty_folder(folder)?;
        replay::create_folder(&folder.join(PACKET_FOLDER))?;
        replay::write_whole_file(&device_path, |out| out.write_all(text.as_bytes()))?;
        replay::write_whole_file(&folder.join(TABLES_FILE), |out| {
            out.write_all(&device.p0_response)
        })?;
        Ok(RawPacketWriter {
            folder: folder.to_owned(),
            list: ListFile::create(folder.join(LIST_FILE))?,
            n_packets: 0,
            last_time_secs: None,
        })
    }

    /// Appends one packet, taken at `device_time_secs` of the device's clock.
    ///
    /// # Errors
    /// [`WriteError::Frame`] for a time that is not finite or not at least a microsecond after the last one;
    /// [`WriteError::Io`].
    pub fn write(
        &mut self,
        packet: RawPacket<'_>,
        device_time_secs: f64,
    ) -> Result<(), WriteError> {
        let n = self.n_packets;
        // The list keeps microseconds; half of one is for the rounding of a difference.
        let after = |last_secs: f64| device_time_secs - last_secs > 0.5e-6;
        if !device_time_secs.is_finite() || !self.last_time_secs.is_none_or(after) {
            return Err(WriteError::Frame {
                frame_id: n as u64,
                reason: format!(
                    "its time is {device_time_secs} s, must be finite and follow {:?} s",
                    self.last_time_secs.unwrap_or(f64::NEG_INFINITY)
                ),
            });
        }
        let name = format!("{PACKET_FOLDER}/{n:06}.k2");
        replay::write_whole_file(&self.folder.join(&name), |out| {
            out.write_all(packet.bytes())
        })?;
        // The number is used up even if the list is not written: a second try never meets half a first one.
        self.n_packets += 1;
        self.last_time_secs = Some(device_time_secs);
        self.list.append(device_time_secs, &name)
    }

    /// Ends the recording: hands the list to the disk and returns how many packets there are.
    ///
    /// # Errors
    /// [`WriteError::Io`].
    pub fn finish(self) -> Result<usize, WriteError> {
        self.list.sync()?;
        Ok(self.n_packets)
    }
}

/// An error that begins with the file's name.
fn invalid(path: &Path, what: impl std::fmt::Display) -> CameraError {
    CameraError::Invalid(format!("{}: {what}", path.display()))
}
