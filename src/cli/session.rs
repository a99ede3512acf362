//! `relief session`: what can be done with recordings on the disk.

mod convert;
mod list;
mod look;
mod mend;

use super::run::Verdict;
use anyhow::ensure;
use clap::{Args, Subcommand};
use relief::devices::Recording;
use std::path::{Path, PathBuf};

/// What to do with recordings.
#[derive(Debug, Subcommand)]
pub enum SessionCommand {
    /// List the MCAP recordings in a folder and in those beneath it
    Ls(ListArgs),
    /// Say what an MCAP recording is of, and how far it came
    Info(SessionArgs),
    /// Read every byte of an MCAP recording, and say what is damaged; nothing is changed
    Verify(SessionArgs),
    /// Mend in place an MCAP recording whose process died or whose bytes are damaged, or all in a folder that were left open
    Repair(RepairArgs),
    /// Write a recording as a folder of 16-bit PNG images with lists
    Export(ConvertArgs),
    /// Write a folder of images with lists, a raw recording, or another program's bag, as an MCAP recording
    Import(ConvertArgs),
    /// Remove MCAP recordings, and nothing else in their folders
    Rm(RemoveArgs),
}

/// `relief session ls`.
#[derive(Debug, Args)]
pub struct ListArgs {
    /// Where to look
    #[arg(default_value = ".")]
    pub folder: PathBuf,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// A recording.
#[derive(Debug, Args)]
pub struct SessionArgs {
    /// Folder of the recording, or an .mcap file
    pub session: PathBuf,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// `relief session repair`.
#[derive(Debug, Args)]
pub struct RepairArgs {
    /// Folder of the recording, or a folder with recordings that were left open in it and beneath it
    pub folder: PathBuf,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// `relief session export` and `import`.
#[derive(Debug, Args)]
pub struct ConvertArgs {
    /// Folder of the session, or an .mcap file
    pub session: PathBuf,
    /// Folder to write into, new or empty
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// `relief session rm`.
#[derive(Debug, Args)]
pub struct RemoveArgs {
    /// Folders of recordings
    #[arg(required = true)]
    pub sessions: Vec<PathBuf>,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

impl SessionCommand {
    /// Whether standard output is for one JSON object.
    pub fn prints_json(&self) -> bool {
        match self {
            SessionCommand::Ls(args) => args.json,
            SessionCommand::Info(args) | SessionCommand::Verify(args) => args.json,
            SessionCommand::Repair(args) => args.json,
            SessionCommand::Export(args) | SessionCommand::Import(args) => args.json,
            SessionCommand::Rm(args) => args.json,
        }
    }
}

/// Runs a command.
///
/// # Errors
/// For recordings that cannot be read or written.
pub fn session(command: &SessionCommand) -> anyhow::Result<Verdict> {
    match command {
        SessionCommand::Ls(args) => list::list(args),
        SessionCommand::Info(args) => look::info(args),
        SessionCommand::Verify(args) => look::verify(args),
        SessionCommand::Repair(args) => mend::repair(args),
        SessionCommand::Export(args) => convert::export(args),
        SessionCommand::Import(args) => convert::import(args),
        SessionCommand::Rm(args) => mend::remove(args),
    }
}

/// Refuses what plays as a recording but is none in MCAP: a folder of images, or what a device sent.
fn require_mcap(session: &Path) -> anyhow::Result<()> {
    let is_raw = Recording::of_folder(session) != Recording::Session;
    let is_other = is_raw || session.join(replay::SESSION_FILE_NAME).is_file();
    ensure!(
        mcap_session::is_recording(session) || !is_other,
        "{} is no recording in MCAP; relief session import makes one of it",
        session.display()
    );
    Ok(())
}

/// Bytes as an operator reads them.
fn megabytes(n_bytes: u64) -> String {
    format!("{:.1} MB", n_bytes as f64 / 1e6)
}
