//! The daemon's life: listen, answer, watch, drain.

use super::{
    camera_source::CameraSource,
    data_folder::{DataFolder, DataFolderError},
    http::{Acceptor, Access, App, router},
    listen::{ListenError, Protection, listen},
    observer::Observer,
    sessions,
    settings::{Settings, SettingsPlaces},
    signals::{self, Ask, DaemonSignals},
    supervisor::Supervisor,
    systemd::ServiceManager,
    token::{Token, TokenError},
    watchdog::Watchdog,
};
use crate::{
    config::ConfigError,
    jobs::{JobError, Worker, WorkerSetup},
};
use depth_camera::CameraError;
use std::{
    io,
    net::{SocketAddr, TcpListener as StdTcpListener},
    path::{Path, PathBuf},
    sync::Arc,
    thread,
    time::{Duration, Instant},
};
use tokio::{
    net::TcpListener,
    runtime, task,
    time::{self, MissedTickBehavior},
};

/// How often everything is looked at.
const LOOK: Duration = Duration::from_millis(200);

/// While the daemon drains, the service manager is told this often that it still does.
const DRAIN_NEWS: Duration = Duration::from_secs(5);

/// Threads that wait for disks and joins at most: a few requests at a time, the scan and the drain.
const WAITING_THREADS: usize = 16;

/// What a daemon is started with.
#[derive(Clone, Debug)]
pub struct DaemonSetup {
    /// Its camera.
    pub source: CameraSource,
    /// Where its settings come from.
    pub places: SettingsPlaces,
    /// Its data directory; by convention without one.
    pub data: Option<PathBuf>,
    /// Where it listens, unless the service manager does.
    pub listen: SocketAddr,
    /// Whether every request must bring the token.
    pub requires_token: bool,
    /// The program that refines, this one.
    pub program: PathBuf,
}

/// Why a daemon ends before it is told to.
#[derive(Debug, thiserror::Error)]
pub enum DaemonError {
    /// The configuration makes no sense.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The data directory cannot be used.
    #[error(transparent)]
    Data(#[from] DataFolderError),
    /// The token cannot be used.
    #[error(transparent)]
    Token(#[from] TokenError),
    /// The refinement worker cannot be used.
    #[error(transparent)]
    Worker(#[from] JobError),
    /// The camera does not answer.
    #[error("the camera cannot be used: {0}")]
    Camera(#[from] CameraError),
    /// The daemon cannot listen.
    #[error(transparent)]
    Listen(#[from] ListenError),
    /// The system refuses what the control plane needs.
    #[error("the system refuses: {0}")]
    System(#[from] io::Error),
}

/// Runs a daemon until a signal ends it: the first in order, the second at once.
///
/// # Errors
/// If configuration, data directory, camera or address cannot be used.
pub fn run(setup: DaemonSetup) -> Result<(), DaemonError> {
    let settings = Settings::read(setup.places)?;
    let protection = Protection::of(&settings.config().control, setup.requires_token)
        .map_err(ListenError::from)?;
    let data = match setup.data {
        Some(root) => DataFolder::open(&root)?,
        None => DataFolder::open(&DataFolder::conventional()?)?,
    };
    if let Err(error) = sessions::sweep(&data) {
        tracing::warn!(%error, "what is left of scans was not looked for");
    }
    let abandoned = abandoned_recordings(&data.sessions());
    // A camera that makes no sense is told of now, not at the first scan.
    setup.source.check()?;
    let listener = listen(setup.listen, &protection)?;
    let access = Access {
        tls: protection.tls.clone(),
        token: match protection.requires_token {
            true => Some(Token::of_folder(data.root())?),
            false => None,
        },
    };
    let worker = Worker::spawn(WorkerSetup {
        data_dir: data.root().to_owned(),
        program: setup.program,
        calibration_dir: settings.calibration_dir().to_owned(),
        n_threads: settings.n_threads(),
        params: settings.config().worker,
        settings: settings.of_refinement(),
    })?;
    let supervisor = Arc::new(Supervisor::new(setup.source, settings, data, worker));
    let runtime = runtime::Builder::new_current_thread()
        .enable_all()
        .max_blocking_threads(WAITING_THREADS)
        .build()?;
    let daemon = Daemon::new(supervisor.clone());
    let ended = runtime.block_on(daemon.live(listener, access, abandoned));
    // Threads that wait for a slow disk are not waited for.
    runtime.shutdown_background();
    // Where nothing could be drained; it has stopped otherwise.
    supervisor.worker.stop();
    ended
}

/// The recordings that a daemon which was killed left open. None is being written yet, so that those of new scans are not among
/// them.
fn abandoned_recordings(sessions: &Path) -> Vec<PathBuf> {
    mcap_session::abandoned_in(sessions)
        .inspect_err(|error| tracing::warn!(%error, "recordings were not looked at"))
        .unwrap_or_default()
}

/// Mends recordings beside all else, on a thread that nobody waits for: a large one takes minutes, and a repair that is cut off is
/// simply done again.
fn mend_aside(recordings: Vec<PathBuf>) {
    if recordings.is_empty() {
        return;
    }
    let mending = thread::Builder::new().name("mending".to_owned());
    let mending = mending.spawn(move || {
        // A scan has more to do with processor and disk.
        if let Err(error) = idle_class::enter() {
            tracing::debug!(%error, "recordings are not mended in the idle class");
        }
        // What was removed meanwhile is passed over.
        for recording in recordings.iter().filter(|path| path.exists()) {
            mend(recording);
        }
    });
    if let Err(error) = mending {
        tracing::warn!(%error, "recordings that were left open are not mended");
    }
}

/// Mends one recording; one that cannot be mended costs nothing but itself.
fn mend(recording: &Path) {
    let path = recording.display();
    tracing::info!(%path, "a recording was left open and is being repaired");
    match mcap_session::repair(recording) {
        Ok(Some(note)) => tracing::warn!(
            %path,
            frames_recovered = note.frames_recovered,
            frames_lost = note.frames_lost,
            "a recording was left open and is repaired"
        ),
        Ok(None) => tracing::info!(%path, "the recording is whole"),
        Err(error) => {
            tracing::error!(%path, %error, "a recording was left open and cannot be repaired")
        }
    }
}

struct Daemon {
    supervisor: Arc<Supervisor>,
    manager: ServiceManager,
    observer: Observer,
    watchdog: Watchdog,
    last_well: Instant,
}

impl Daemon {
    fn new(supervisor: Arc<Supervisor>) -> Self {
        Daemon {
            supervisor,
            manager: ServiceManager::from_env(),
            observer: Observer::default(),
            watchdog: Watchdog::default(),
            last_well: Instant::now(),
        }
    }

    /// Answers until a signal comes, then drains. Recordings that were left open are mended meanwhile.
    async fn live(
        mut self,
        listener: StdTcpListener,
        access: Access,
        abandoned: Vec<PathBuf>,
    ) -> Result<(), DaemonError> {
        let mut signals = DaemonSignals::new()?;
        let address = listener.local_addr()?;
        let scheme = access.scheme();
        let tls = access.tls.as_ref().map(|tls| tls.acceptor());
        let app = Arc::new(App::new(self.supervisor.clone(), access));
        let acceptor = Acceptor::new(TcpListener::from_std(listener)?, tls, router(app.clone()));
        if let Err(error) = self.supervisor.data.tell_address(scheme, address) {
            tracing::warn!(%error, "daemon.lock does not say where the daemon listens");
        }
        tracing::info!(
            data = %self.supervisor.data.root().display(),
            "listening on {scheme}://{address}/"
        );
        self.manager.ready("idle");
        mend_aside(abandoned);

        let mut looks = time::interval(LOOK);
        looks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                () = acceptor.accept() => {}
                _ = looks.tick() => self.look(&app),
                ask = signals.next() => match ask {
                    Ask::Reload => self.reload(),
                    Ask::Stop(name) => {
                        tracing::warn!("{name}: ending; what is scanned is written first, once more to exit at once");
                        break;
                    }
                },
            }
        }
        self.drain(&app, &acceptor, &mut signals).await;
        acceptor.goodbye().await;
        Ok(())
    }

    /// Ends scan and refinement while requests are still answered.
    async fn drain(&mut self, app: &App, acceptor: &Acceptor, signals: &mut DaemonSignals) {
        self.manager.stopping(2 * DRAIN_NEWS);
        let supervisor = self.supervisor.clone();
        let mut drained = task::spawn(async move {
            supervisor.drain().await;
            // The refinement may take its time to end.
            task::spawn_blocking(move || supervisor.worker.stop()).await
        });
        let mut looks = time::interval(LOOK);
        let mut news = time::interval(DRAIN_NEWS);
        loop {
            tokio::select! {
                _ = &mut drained => return,
                () = acceptor.accept() => {}
                _ = looks.tick() => self.look(app),
                _ = news.tick() => self.manager.stopping(2 * DRAIN_NEWS),
                ask = signals.next() => if let Ask::Stop(name) = ask {
                    signals::exit_at_once(name);
                },
            }
        }
    }

    fn look(&mut self, app: &App) {
        if let Some(line) = self.observer.look(&self.supervisor, app.n_clients()) {
            self.manager.status(&line);
        }
        let Some(interval) = self.manager.watchdog() else {
            return;
        };
        if self.last_well.elapsed() >= interval / 3 && self.watchdog.is_well(&self.supervisor) {
            self.last_well = Instant::now();
            self.manager.all_is_well();
        }
    }

    fn reload(&self) {
        self.manager.reloading();
        let reloaded = self.supervisor.reload();
        self.manager.ready(match reloaded {
            Ok(()) => "configuration read anew",
            Err(_) => "the configuration stays as it was: see the log",
        });
    }
}
