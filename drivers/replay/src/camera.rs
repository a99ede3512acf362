//! The recording as a camera.

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame, Image};

use crate::{
    depth_scale::DepthScale,
    lists::{self, Moment},
    pacing::{Pacer, Pacing},
    session::{self, Images, SessionFile},
    sixteen_bit_png,
};

/// A recorded session, played from its start to its end.
///
/// `frame_id` counts the moments that are played from 0; a damaged image costs its moment and keeps its number.
#[derive(Debug)]
pub struct ReplayCamera {
    folder: PathBuf,
    info: CameraInfo,
    depth_scale: DepthScale,
    moments: Vec<Moment>,
    next: usize,
    pacer: Pacer,
}

impl ReplayCamera {
    /// Opens a session's folder: description and lists are read and checked, images are not.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] naming file, key or line, value and bound.
    pub fn open(folder: &Path) -> Result<Self, CameraError> {
        let session_path = folder.join(session::FILE_NAME);
        let session = SessionFile::read(&session_path)?;
        let ir_path = folder.join("ir.txt");
        let images = match ir_path.exists() {
            true => Images::DepthAndInfrared,
            false => Images::Depth,
        };
        let mut info = session.camera_info(&session_path, images)?;

        let depth_path = folder.join("depth.txt");
        let depth = lists::read_list(&depth_path)?;
        if depth.is_empty() {
            return Err(session::invalid(&depth_path, "holds no frame"));
        }
        let ir = match images {
            Images::DepthAndInfrared => lists::read_list(&ir_path)?,
            Images::Depth => Vec::new(),
        };
        let moments = lists::merge_lists(depth, ir);
        info.n_frames = Some(moments.len());
        Ok(ReplayCamera {
            folder: folder.to_owned(),
            info,
            depth_scale: session.depth_scale(),
            moments,
            next: 0,
            pacer: Pacer::default(),
        })
    }

    /// The same recording at another pace.
    pub fn with_pacing(self, pacing: Pacing) -> Self {
        ReplayCamera {
            pacer: Pacer::new(pacing),
            ..self
        }
    }

    /// How depth is stored, for another recording of the same.
    pub fn depth_scale(&self) -> DepthScale {
        self.depth_scale
    }

    /// Decodes an image of the recording; an error names the file.
    fn read_image(&self, file_name: &str) -> Result<Image<u16>, String> {
        let path = self.folder.join(file_name);
        let i = &self.info.intrinsics;
        sixteen_bit_png::read(&path, i.width, i.height)
            .map_err(|what| format!("{}: {what}", path.display()))
    }

    /// Decodes the images of a moment, depth into metres.
    fn decode(&self, frame_id: u64, moment: &Moment) -> Result<Frame, String> {
        let scale = self.depth_scale;
        let depth = moment.depth.as_deref().map(|name| self.read_image(name));
        let ir = moment.ir.as_deref().map(|name| self.read_image(name));
        Ok(Frame {
            frame_id,
            device_time_secs: moment.time_secs,
            depth: depth
                .transpose()?
                .map(|image| image.map(|&units| scale.metres(units))),
            ir: ir.transpose()?,
            host_time: Instant::now(),
        })
    }
}

impl DepthCamera for ReplayCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        let Some(moment) = self.moments.get(self.next) else {
            return Ok(None);
        };
        self.pacer.wait_until_due(moment.time_secs, timeout)?;
        let frame_id = self.next as u64;
        self.next += 1;
        self.decode(frame_id, moment)
            .map(Some)
            .map_err(|reason| CameraError::DamagedFrame { frame_id, reason })
    }
}
