//! One camera, one scan at a time, many scans in the daemon's life: starts them, waits for them, and outlives them.

mod ending;

use super::{
    camera_source::{CameraSource, DeviceName, SourceError},
    data_folder::{DataFolder, NoRoom, SessionId},
    events::{Events, Topic},
    refined_error::RefinedError,
    scan_record::{ScanRecord, unix_ms},
    settings::Settings,
};
use crate::{
    config::ConfigError,
    jobs::{Job, JobError, WorkerHandle},
    lock::lock,
    pipeline::{
        Command, CommandRefused, FrameAccounts, Handle, OutputFolder, OutputFolderError, Pipeline,
        SpawnError, Watch,
    },
};
use serde_json::json;
use std::{
    fs, io,
    path::PathBuf,
    sync::{
        Arc, Mutex, MutexGuard,
        atomic::{AtomicBool, Ordering},
    },
    time::Instant,
};
use tokio::{sync::Notify, task};

/// Why a scan does not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// There is one already.
    #[error("a scan is going on already")]
    AlreadyScanning,
    /// The daemon is ending.
    #[error("the daemon is ending")]
    Draining,
    /// The camera does not answer.
    #[error(transparent)]
    Camera(#[from] SourceError),
    /// The calibration makes no sense.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The disk has too little room.
    #[error(transparent)]
    NoRoom(#[from] NoRoom),
    /// The scan's folder cannot be made.
    #[error(transparent)]
    Folder(#[from] OutputFolderError),
    /// The scan cannot be written down.
    #[error("cannot write the scan's record: {0}")]
    Record(io::Error),
    /// The pipeline does not start.
    #[error(transparent)]
    Spawn(#[from] SpawnError),
    /// A fault of the program.
    #[error("starting ended by a fault of the program: {0}")]
    Program(#[from] task::JoinError),
}

/// Why no refinement can be asked for.
#[derive(Debug, thiserror::Error)]
pub enum SubmitError {
    /// The worker refuses.
    #[error(transparent)]
    Job(#[from] JobError),
    /// The system refuses.
    #[error("the scan cannot be given to the worker: {0}")]
    Io(#[from] io::Error),
}

/// A scan that goes on.
#[derive(Debug)]
pub struct Scan {
    /// What is known of it from its start.
    pub record: ScanRecord,
    /// Looks at its pipeline.
    pub watch: Watch,
    wants_refinement: AtomicBool,
}

impl Scan {
    /// Whether it is to be refined once it has ended.
    fn wants_refinement(&self) -> bool {
        self.wants_refinement.load(Ordering::Relaxed)
    }
}

/// What the daemon is busy with.
#[derive(Clone, Debug, Default)]
enum Slot {
    #[default]
    Idle,
    Starting,
    Running(Arc<Scan>),
}

/// The daemon's centre.
pub struct Supervisor {
    /// The camera.
    pub source: CameraSource,
    /// What scans are made with.
    pub settings: Settings,
    /// Where they lie.
    pub data: DataFolder,
    /// What refines them.
    pub worker: WorkerHandle,
    /// What happened.
    pub events: Events,
    /// How well the newest refined mesh explains its images.
    pub refined_error: RefinedError,
    /// When the daemon started.
    pub started: Instant,
    /// The same by the machine's clock.
    pub started_unix_ms: u64,
    slot: Mutex<Slot>,
    ended: Mutex<EndedScans>,
    is_draining: AtomicBool,
    is_idle: Notify,
}

/// What scans leave behind in the daemon's memory.
#[derive(Clone, Debug, Default)]
pub struct EndedScans {
    /// How many ended.
    pub n_scans: u64,
    /// How many of them with a failure.
    pub n_failed: u64,
    /// What became of all their frames.
    pub frames: FrameAccounts,
    /// The newest of them.
    pub last: Option<SessionId>,
}

impl Supervisor {
    /// A daemon without a scan.
    pub fn new(
        source: CameraSource,
        settings: Settings,
        data: DataFolder,
        worker: WorkerHandle,
    ) -> Self {
        Supervisor {
            source,
            settings,
            data,
            worker,
            events: Events::default(),
            refined_error: RefinedError::default(),
            started: Instant::now(),
            started_unix_ms: unix_ms(),
            slot: Mutex::default(),
            ended: Mutex::default(),
            is_draining: AtomicBool::new(false),
            is_idle: Notify::new(),
        }
    }

    /// The scan that goes on.
    pub fn scan(&self) -> Option<Arc<Scan>> {
        match &*self.slot() {
            Slot::Running(scan) => Some(scan.clone()),
            Slot::Idle | Slot::Starting => None,
        }
    }

    /// Whether the camera is being opened.
    pub fn is_starting(&self) -> bool {
        matches!(*self.slot(), Slot::Starting)
    }

    /// Whether the daemon is ending.
    pub fn is_draining(&self) -> bool {
        self.is_draining.load(Ordering::Relaxed)
    }

    /// What the scans that ended leave behind.
    pub fn ended(&self) -> EndedScans {
        lock(&self.ended).clone()
    }

    /// Starts a scan; goes on to its beginning even if nobody waits for it.
    ///
    /// # Errors
    /// If there is a scan already, or the camera, its calibration, or the disk does not do what it must.
    pub async fn start(self: &Arc<Self>, label: Option<String>) -> Result<SessionId, StartError> {
        self.reserve()?;
        task::spawn(self.clone().launch(label)).await?
    }

    /// Asks the scan for something.
    ///
    /// # Errors
    /// If there is none, or it makes no sense now.
    pub fn command(&self, command: Command) -> Result<(), CommandRefused> {
        let scan = self.scan().ok_or(CommandRefused::NotScanning)?;
        if command != Command::Abandon {
            return scan.watch.command(command);
        }
        // First, since the scan may end at once.
        let before = scan.wants_refinement.swap(false, Ordering::Relaxed);
        let commanded = scan.watch.command(command);
        if commanded.is_err() {
            scan.wants_refinement.store(before, Ordering::Relaxed);
        }
        commanded
    }

    /// Reads the configuration anew, for the scans and refinements that start from now on, and logs what came of it.
    ///
    /// # Errors
    /// For a configuration that cannot be read or makes no sense; the old one stays.
    pub fn reload(&self) -> Result<(), ConfigError> {
        let reloaded = self.settings.reload();
        match &reloaded {
            Ok(()) => {
                self.worker.set_settings(&self.settings.of_refinement());
                tracing::info!(
                    "configuration read anew; it holds for the scans that start from now on"
                );
            }
            Err(error) => tracing::error!(%error, "the configuration stays as it was"),
        }
        reloaded
    }

    /// Checks that the disk has room for a scan.
    ///
    /// # Errors
    /// If it has less than the configuration in force wants.
    pub fn check_room(&self) -> Result<(), NoRoom> {
        let floor_bytes = self.settings.config().capture.min_free_bytes();
        self.data.check_room(floor_bytes)
    }

    /// Starts no more scans and no refinement, ends the refinement there is, which goes on when the daemon is back, and ends the
    /// scan there is with what it has.
    pub async fn drain(&self) {
        self.is_draining.store(true, Ordering::Relaxed);
        self.worker.begin_stop();
        loop {
            let is_idle = self.is_idle.notified();
            match &*self.slot() {
                Slot::Idle => return,
                Slot::Starting => {}
                Slot::Running(scan) => scan.watch.stop(),
            }
            is_idle.await;
        }
    }

    /// Gives a scan's folder to the refinement worker; waits for the disk.
    ///
    /// # Errors
    /// If the scan cannot be refined, or the system refuses.
    pub async fn submit(self: &Arc<Self>, folder: PathBuf) -> Result<Job, JobError> {
        let worker = self.worker.clone();
        let submitted = task::spawn_blocking(move || worker.submit(&folder)).await;
        submitted.unwrap_or(Err(JobError::Stopping))
    }

    fn reserve(&self) -> Result<(), StartError> {
        let mut slot = self.slot();
        if self.is_draining() {
            return Err(StartError::Draining);
        }
        match *slot {
            Slot::Idle => *slot = Slot::Starting,
            Slot::Starting | Slot::Running(_) => return Err(StartError::AlreadyScanning),
        }
        Ok(())
    }

    async fn launch(self: Arc<Self>, label: Option<String>) -> Result<SessionId, StartError> {
        let supervisor = self.clone();
        let opened = task::spawn_blocking(move || supervisor.open(label)).await;
        let (handle, scan) = match opened.map_err(StartError::from).flatten() {
            Ok(opened) => opened,
            Err(error) => {
                tracing::error!(%error, "no scan");
                self.events
                    .tell(Topic::Device, &json!({ "error": error.to_string() }));
                self.occupy(Slot::Idle);
                return Err(error);
            }
        };
        let id = scan.record.id.clone();
        tracing::info!(session_id = %id, device = scan.record.device.serial, "scan started");
        self.occupy(Slot::Running(scan.clone()));
        task::spawn(self.accompany(handle, scan));
        Ok(id)
    }

    /// Opens the camera and starts the pipeline; waits for device and disk.
    fn open(&self, label: Option<String>) -> Result<(Handle, Arc<Scan>), StartError> {
        self.check_room()?;
        let camera = self
            .source
            .open(|serial| self.settings.device_params(serial))?;
        let id = SessionId::generate();
        let device = DeviceName::of(camera.info());
        let params = self
            .settings
            .scan_params(id.as_str(), camera.info(), &self.source)?;
        let path = self.data.session(&id);
        let folder = OutputFolder::claim(&path)?.waiting_for_room();
        let record = ScanRecord::started(id, label, device);
        let started = record
            .write(&path)
            .map_err(StartError::Record)
            .and_then(|()| Ok(Pipeline::spawn(camera, params, folder)?));
        match started {
            Ok(handle) => {
                let scan = Scan {
                    record,
                    watch: handle.watch(),
                    wants_refinement: AtomicBool::new(true),
                };
                Ok((handle, Arc::new(scan)))
            }
            Err(error) => {
                // Nothing was scanned: the folder is ours and holds nothing.
                let _ = fs::remove_dir_all(&path);
                Err(error)
            }
        }
    }

    fn occupy(&self, slot: Slot) {
        *self.slot() = slot;
        self.is_idle.notify_waiters();
    }

    fn slot(&self) -> MutexGuard<'_, Slot> {
        lock(&self.slot)
    }
}

/// The frames of two scans together.
pub fn sum(a: &FrameAccounts, b: &FrameAccounts) -> FrameAccounts {
    FrameAccounts {
        produced: a.produced + b.produced,
        fused: a.fused + b.fused,
        lost: a.lost + b.lost,
        without_depth: a.without_depth + b.without_depth,
        paused: a.paused + b.paused,
        damaged: a.damaged + b.damaged,
        dropped: a.dropped + b.dropped,
        in_flight: a.in_flight + b.in_flight,
        missed: a.missed + b.missed,
    }
}
