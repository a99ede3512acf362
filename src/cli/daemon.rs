//! `relief run`: the command line of the daemon.

use super::{
    run::{Verdict, all_processors, calibration_folder},
    values,
};
use anyhow::Context;
use clap::Args;
use relief::control::{
    CameraSource, DaemonError, DaemonSetup, ListenError, SettingsPlaces, TokenError, run_daemon,
};
use std::{env, net::SocketAddr, num::NonZeroUsize, path::PathBuf};

/// `relief run`.
#[derive(Debug, Args)]
pub struct RunArgs {
    /// Play this session at its own pace, as if it were a device
    #[arg(long, value_name = "SESSION", conflicts_with = "device")]
    pub replay: Option<PathBuf>,
    /// Scan with the Kinect of this serial number; with the only one there is without it
    #[arg(long, value_name = "SERIAL")]
    pub device: Option<String>,
    /// Begin the session anew whenever it ends
    #[arg(long, requires = "replay")]
    pub repeat: bool,
    /// Configuration; keys that it leaves out keep their values from the layers below. Read anew on SIGHUP,
    /// unless standard error is a terminal, whose end it then tells of
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Data directory, of one daemon at a time; $STATE_DIRECTORY, $XDG_STATE_HOME/relief or ~/.local/state/relief without it
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Where to listen; beyond this machine only with --require-token and a certificate in the configuration. A socket from the
    /// service manager comes first
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8047")]
    pub listen: SocketAddr,
    /// Ask every request for the token in DATA/token, as Bearer or as the password that browsers ask for
    #[arg(long)]
    pub require_token: bool,
    /// Record the frames of every scan
    #[arg(long)]
    pub record: bool,
    /// Calibration of the IR image: a device's own file, or a complete one
    #[arg(long, value_name = "FILE")]
    pub calibration: Option<PathBuf>,
    /// Folder of the calibrations named SERIAL.toml; "calibration" beside the --config file, or here, without it
    #[arg(long, value_name = "DIR")]
    pub calibration_dir: Option<PathBuf>,
    /// Threads of each pool; all processors without it
    #[arg(long, value_name = "N", value_parser = values::threads)]
    pub threads: Option<NonZeroUsize>,
}

/// Runs until a signal ends it.
pub fn run(args: &RunArgs) -> anyhow::Result<Verdict> {
    let program = env::current_exe().context("the program does not find itself")?;
    run_daemon(DaemonSetup {
        source: match &args.replay {
            Some(session) => CameraSource::Replay {
                session: session.clone(),
                repeat: args.repeat,
            },
            None => CameraSource::Live {
                serial: args.device.clone(),
            },
        },
        places: SettingsPlaces {
            config: args.config.clone(),
            calibration: args.calibration.clone(),
            calibration_dir: calibration_folder(
                args.calibration_dir.as_deref(),
                args.config.as_deref(),
            ),
            n_threads: args.threads.unwrap_or_else(all_processors),
            record: args.record,
        },
        data: args.data.clone(),
        listen: args.listen,
        requires_token: args.require_token,
        program,
    })?;
    Ok(Verdict::Done)
}

/// What the end of a daemon means for the exit code.
pub fn verdict_of(error: &DaemonError) -> Verdict {
    match error {
        DaemonError::Config(_)
        | DaemonError::Listen(ListenError::Unguarded { .. } | ListenError::Tls(_))
        | DaemonError::Token(TokenError::Malformed(_)) => Verdict::BadConfiguration,
        DaemonError::Camera(_) => Verdict::NoDevice,
        DaemonError::Data(_)
        | DaemonError::Worker(_)
        | DaemonError::Token(TokenError::Io { .. }) => Verdict::StorageFailed,
        // An address that is in use, or not there yet, may be had later.
        DaemonError::Listen(ListenError::Io { .. } | ListenError::Activation(_))
        | DaemonError::System(_) => Verdict::Internal,
    }
}
