//! `relief session export` and `import`: recordings as folders of images, and back.

use super::ConvertArgs;
use crate::cli::{
    run::{Verdict, tell_unknown_keys},
    stdout::Stdout,
};
use anyhow::{Context, ensure};
use depth_camera::{CameraError, DepthCamera, Frame};
use mcap_session::{RecordingParams, SegmentWriter, open_session};
use relief::{
    config::{self, Config, Overrides},
    control::Stderr,
    devices::{Recording, open_recording},
    shading::Calibration,
};
use replay::{Pacing, SessionWriter};
use serde_json::json;
use std::{fs, io::Write, path::Path, time::Duration};

/// The frames of a recording of which one at least is whole: where none is, no folder is begun for them.
struct Frames {
    camera: Box<dyn DepthCamera>,
    first: Option<Frame>,
    converted: Converted,
}

/// What became of the frames.
#[derive(Default)]
struct Converted {
    n_frames: usize,
    n_damaged: usize,
}

/// `relief session export`.
pub fn export(args: &ConvertArgs) -> anyhow::Result<Verdict> {
    let (camera, units) = open(&args.session)?;
    let frames = Frames::of(camera, &args.session)?;
    let mut writer = SessionWriter::create(&args.out, frames.camera.info(), units)?;
    let converted = frames.hand_on(|frame| Ok(writer.write(frame)?))?;
    writer.finish()?;
    conclude(args, &converted)
}

/// `relief session import`.
pub fn import(args: &ConvertArgs) -> anyhow::Result<Verdict> {
    let (camera, units) = open(&args.session)?;
    let frames = Frames::of(camera, &args.session)?;
    let params = RecordingParams {
        depth_units_per_metre: units,
        // Whoever asks for a file gets it, or hears that there is no room.
        min_free_bytes: 0,
        ..RecordingParams::default()
    };
    let mut writer = SegmentWriter::create(&args.out, frames.camera.info(), params)?;
    let converted = frames.hand_on(|frame| Ok(writer.write(frame)?))?;
    writer.finish()?;
    conclude(args, &converted)
}

/// A recording of any kind, and in how many steps a metre its depth is to be stored: as it is, or as the configuration says where
/// it is not stored as depth.
fn open(session: &Path) -> anyhow::Result<(Box<dyn DepthCamera>, f64)> {
    let pacing = Pacing::AsFastAsPossible;
    if Recording::of_folder(session) == Recording::Session {
        let opened = open_session(session, pacing)?;
        tell_unknown_keys(session);
        return Ok((opened.camera, opened.depth_scale.units_per_metre));
    }
    let config = Config::layered(None, &Overrides::default())?;
    let camera = open_recording(session, &config.devices, pacing)?;
    Ok((camera, config.capture.record_depth_units_per_metre))
}

impl Frames {
    /// Reads up to the first whole frame of a session; one without any is an error.
    fn of(camera: Box<dyn DepthCamera>, session: &Path) -> anyhow::Result<Self> {
        let mut frames = Frames {
            camera,
            first: None,
            converted: Converted::default(),
        };
        frames.first = frames.next_whole()?;
        ensure!(
            frames.first.is_some(),
            "{}: no frame is whole, {} are damaged",
            session.display(),
            frames.converted.n_damaged
        );
        Ok(frames)
    }

    /// Hands all whole frames on.
    fn hand_on(
        mut self,
        mut write: impl FnMut(&Frame) -> anyhow::Result<()>,
    ) -> anyhow::Result<Converted> {
        let mut next = self.first.take();
        while let Some(frame) = next {
            write(&frame)?;
            self.converted.n_frames += 1;
            next = self.next_whole()?;
        }
        Ok(self.converted)
    }

    /// The next whole frame; damaged ones are told of and counted.
    fn next_whole(&mut self) -> anyhow::Result<Option<Frame>> {
        loop {
            match self.camera.grab(Duration::ZERO) {
                Err(error @ CameraError::DamagedFrame { .. }) => {
                    tracing::warn!(%error, "frame skipped");
                    self.converted.n_damaged += 1;
                }
                grabbed => return Ok(grabbed?),
            }
        }
    }
}

/// Takes the calibration along, and says what became of the frames: where some are missing it has failed.
fn conclude(args: &ConvertArgs, converted: &Converted) -> anyhow::Result<Verdict> {
    let Converted {
        n_frames,
        n_damaged,
    } = converted;
    let calibration = config::session_folder(&args.session).join(Calibration::FILE_NAME);
    if calibration.is_file() {
        copy(&calibration, &args.out.join(Calibration::FILE_NAME))?;
    }
    match args.json {
        true => writeln!(
            Stdout,
            "{}",
            json!({ "frames": n_frames, "damaged": n_damaged })
        )?,
        false => writeln!(
            Stdout,
            "{n_frames} frames written to {}, {n_damaged} were damaged",
            args.out.display()
        )?,
    }
    if *n_damaged == 0 {
        return Ok(Verdict::Done);
    }
    let n_in_all = n_frames + n_damaged;
    writeln!(
        Stderr,
        "error: {n_damaged} of {n_in_all} frames are damaged and left out"
    )?;
    Ok(Verdict::Failed)
}

fn copy(from: &Path, to: &Path) -> anyhow::Result<()> {
    fs::copy(from, to).with_context(|| format!("cannot copy {}", from.display()))?;
    Ok(())
}
