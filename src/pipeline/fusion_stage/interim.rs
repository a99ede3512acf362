//! A scan as it is, written down on the way: base mesh, trajectory and shading images in a folder of their own, which is
//! refined like the folder of a whole scan. Loops are closed in it as far as that was done on the way.

use crate::{
    capture::{Event, EventKind, Tracked},
    geometry::{Pose, TriMesh},
    pipeline::{
        deliver::{INTERIM, Outbox},
        edges::TrackedSender,
        live::{InterimScan, Slot},
        threads::idle_pool,
    },
    snapshot::ShadingSnapshot,
};
use depth_camera::{CameraInfo, Sensor};
use std::{
    fs, io,
    num::NonZeroUsize,
    path::{Path, PathBuf},
    thread::{self, JoinHandle},
};

/// What is written.
pub(super) struct Interim {
    pub(super) base: TriMesh,
    /// Times (s) and poses of the fused frames.
    pub(super) trajectory: Vec<(f64, Pose)>,
    pub(super) snapshots: Vec<ShadingSnapshot>,
    pub(super) frame_id: u64,
}

/// Writes one scan at a time, on a thread of its own that yields to all others, so that capture goes on.
pub(super) struct InterimWriter {
    info: CameraInfo,
    folder: PathBuf,
    number: u32,
    writing: Option<JoinHandle<()>>,
}

impl InterimWriter {
    pub(super) fn new(info: CameraInfo, folder: PathBuf) -> Self {
        InterimWriter {
            info,
            folder,
            number: 0,
            writing: None,
        }
    }

    pub(super) fn sensor(&self) -> Sensor {
        self.info.sensor
    }

    /// Begins to write; when all is there it is told by an event and in the slot. The error says why not.
    pub(super) fn begin(
        &mut self,
        interim: Interim,
        events: &TrackedSender,
        slot: Slot<InterimScan>,
    ) -> Result<(), String> {
        if self
            .writing
            .as_ref()
            .is_some_and(|thread| !thread.is_finished())
        {
            return Err("the scan is still being written as it was last".to_owned());
        }
        self.join();
        self.number += 1;
        let number = self.number;
        let folder = self.folder.join(format!("{INTERIM}{number:03}"));
        let (info, events) = (self.info.clone(), events.clone());
        let write = move || {
            // What would be done by many threads is done by the one that yields, too.
            let pool = idle_pool("interim", NonZeroUsize::MIN);
            let written = pool
                .map_err(|error| error.to_string())
                .and_then(|pool| pool.install(|| interim.write(&folder, &info)));
            let kind = match written {
                Ok(()) => {
                    slot.write(Some(InterimScan { number, folder }));
                    EventKind::Interim { number }
                }
                Err(reason) => {
                    // Half of it is of no use, and takes room.
                    let _ = fs::remove_dir_all(&folder);
                    EventKind::Refused {
                        command: "refine",
                        reason,
                    }
                }
            };
            events.send(Tracked::Event(Event {
                frame_id: interim.frame_id,
                device_time_secs: interim.trajectory.last().map(|last| last.0),
                kind,
            }));
        };
        let thread = thread::Builder::new()
            .name("interim".to_owned())
            .spawn(write);
        self.writing = Some(thread.map_err(|error: io::Error| error.to_string())?);
        Ok(())
    }

    /// Waits for what is being written.
    pub(super) fn join(&mut self) {
        if let Some(thread) = self.writing.take()
            && thread.join().is_err()
        {
            tracing::error!("writing the scan on the way ended by a fault of the program");
        }
    }
}

impl Interim {
    fn write(&self, folder: &Path, info: &CameraInfo) -> Result<(), String> {
        fs::create_dir_all(folder)
            .map_err(|error| format!("cannot create {}: {error}", folder.display()))?;
        let outbox = Outbox::inside(folder);
        outbox.base_mesh(&self.base);
        outbox.trajectory(&self.trajectory);
        outbox.snapshots(&self.snapshots, info);
        match outbox.account().failures.first() {
            Some(failure) => Err(failure.clone()),
            None => Ok(()),
        }
    }
}
