//! `relief run`: the command line of the daemon.

use super::{
    RunArgs,
    run::{Verdict, all_processors, calibration_folder},
};
use anyhow::Context;
use relief::control::{CameraSource, DaemonError, DaemonSetup, SettingsPlaces, run_daemon};
use std::env;

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
        DaemonError::Config(_) | DaemonError::Listen(_) => Verdict::BadConfiguration,
        DaemonError::Camera(_) => Verdict::NoDevice,
        DaemonError::Data(_) | DaemonError::Worker(_) => Verdict::StorageFailed,
        DaemonError::System(_) => Verdict::Internal,
    }
}
