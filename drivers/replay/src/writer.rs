//! Writes a session folder that [`crate::ReplayCamera`] reads.

use std::{
    io::{self, Write},
    path::{Path, PathBuf},
};

use depth_camera::{CameraInfo, Frame, Image};
use png::EncodingError;

use crate::{
    depth_scale::DepthScale,
    files::{ListFile, WriteError, create_empty_folder, create_folder, write_whole_file},
    frame_check::check_frame,
    session::{self, SessionFile},
    sixteen_bit_png::{self, PngEffort},
};

/// A recording being written.
///
/// Folder and lists are complete after every call: each image is written beside its name and renamed, and only then entered
/// in its list, so that a process that is killed loses its last frame at most. Loss of power is not guarded against before
/// [`SessionWriter::finish`]. After an error the next frame may be written.
#[derive(Debug)]
pub struct SessionWriter {
    folder: PathBuf,
    info: CameraInfo,
    depth_scale: DepthScale,
    depth_list: ListFile,
    /// There if the camera delivers IR.
    ir_list: Option<ListFile>,
    n_frames: usize,
    /// Time of the last frame as it stands in the list.
    last_time_micros: Option<i64>,
}

impl SessionWriter {
    /// Begins a recording in `folder`, which is created and must be empty otherwise; its name becomes the session's.
    ///
    /// Depth is stored in steps of 1 / `depth_units_per_metre` metres, up to 65535 of them.
    ///
    /// # Errors
    /// [`WriteError::NotEmpty`], [`WriteError::Io`], or [`WriteError::Camera`] for a description that makes no sense.
    pub fn create(
        folder: &Path,
        info: &CameraInfo,
        depth_units_per_metre: f64,
    ) -> Result<Self, WriteError> {
        let name = folder.file_name().map(|name| name.to_string_lossy());
        let name = name.as_deref().unwrap_or("session");
        let session = SessionFile::of_camera(name, info, depth_units_per_metre);
        let session_path = folder.join(session::FILE_NAME);
        session.camera_info(&session_path, session.images())?;
        let session = session.to_text(&session_path)?;

        create_empty_folder(folder)?;
        create_folder(&folder.join("depth"))?;
        if info.has_infrared() {
            create_folder(&folder.join("ir"))?;
        }
        write_whole_file(&session_path, |out| out.write_all(session.as_bytes()))?;
        let depth_list = ListFile::create(folder.join("depth.txt"))?;
        let ir_list = match info.has_infrared() {
            true => Some(ListFile::create(folder.join("ir.txt"))?),
            false => None,
        };
        Ok(SessionWriter {
            folder: folder.to_owned(),
            info: info.clone(),
            depth_scale: DepthScale {
                units_per_metre: depth_units_per_metre,
            },
            depth_list,
            ir_list,
            n_frames: 0,
            last_time_micros: None,
        })
    }

    /// Puts a file of text into the folder, which replay does not read.
    ///
    /// # Errors
    /// [`WriteError::Io`].
    pub fn write_text(&mut self, name: &str, text: &str) -> Result<(), WriteError> {
        write_whole_file(&self.folder.join(name), |out| {
            out.write_all(text.as_bytes())
        })
    }

    /// Appends one frame; depth beyond the range of 16 bits, negative or not finite is stored as no measurement.
    ///
    /// # Errors
    /// [`WriteError::Frame`] for a frame of the wrong size, out of order, without an image, or with IR from a camera
    /// said to have none; [`WriteError::Io`].
    pub fn write(&mut self, frame: &Frame) -> Result<(), WriteError> {
        self.write_with_infrared(frame, frame.ir.as_ref())
    }

    /// As [`SessionWriter::write`], with IR of the same size in place of the frame's own, or without any.
    ///
    /// # Errors
    /// As [`SessionWriter::write`].
    pub fn write_with_infrared(
        &mut self,
        frame: &Frame,
        ir: Option<&Image<u16>>,
    ) -> Result<(), WriteError> {
        let time_micros = self.check(frame).map_err(|reason| WriteError::Frame {
            frame_id: frame.frame_id,
            reason,
        })?;
        let depth_name = format!("depth/{:05}.png", self.n_frames);
        let ir_name = format!("ir/{:05}.png", self.n_frames);
        if let Some(depth) = &frame.depth {
            let units = depth.map(|&metres| self.depth_scale.units(metres));
            write_png(&self.folder.join(&depth_name), &units, PngEffort::Archive)?;
        }
        if let Some(ir) = ir {
            write_png(&self.folder.join(&ir_name), ir, PngEffort::Archive)?;
        }

        // Numbers and times are used up even if the lists are not written: a second try never meets half a first one.
        self.n_frames += 1;
        self.last_time_micros = Some(time_micros);
        let time_secs = frame.device_time_secs;
        if frame.depth.is_some() {
            self.depth_list.append(time_secs, &depth_name)?;
        }
        if let (Some(_), Some(list)) = (ir, &mut self.ir_list) {
            list.append(time_secs, &ir_name)?;
        }
        Ok(())
    }

    /// Ends the recording: hands the lists to the disk and returns how many frames there are.
    ///
    /// # Errors
    /// [`WriteError::Io`].
    pub fn finish(self) -> Result<usize, WriteError> {
        for list in [Some(&self.depth_list), self.ir_list.as_ref()]
            .into_iter()
            .flatten()
        {
            list.sync()?;
        }
        Ok(self.n_frames)
    }

    /// Whether the frame fits the recording; its time in microseconds, the resolution of the lists.
    fn check(&self, frame: &Frame) -> Result<i64, String> {
        check_frame(frame, &self.info)?;
        let time_secs = frame.device_time_secs;
        let time_micros = (time_secs * 1e6).round() as i64;
        match self.last_time_micros {
            Some(last) if time_micros <= last => Err(format!(
                "its time {time_secs:.6} s follows {:.6} s, must be later",
                last as f64 * 1e-6
            )),
            _ => Ok(time_micros),
        }
    }
}

/// Writes an image as a 16-bit greyscale PNG, there whole or not at all.
///
/// # Errors
/// [`WriteError::Io`].
pub fn write_png(path: &Path, image: &Image<u16>, effort: PngEffort) -> Result<(), WriteError> {
    write_whole_file(path, |out| {
        sixteen_bit_png::write(out, image, effort).map_err(|error| match error {
            EncodingError::IoError(error) => error,
            other => io::Error::other(other),
        })
    })
}
