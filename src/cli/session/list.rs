//! `relief session ls`.

use super::{ListArgs, megabytes};
use crate::cli::{run::Verdict, stdout::Stdout};
use mcap_session::{SessionRecord, State, recordings_in};
use serde::Serialize;
use std::{io::Write, path::Path};

/// One line of the list.
#[derive(Serialize)]
struct Listed {
    path: String,
    #[serde(flatten)]
    record: Option<SessionRecord>,
    /// Why the recording's description cannot be read.
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

/// Lists recordings, by path.
pub fn list(args: &ListArgs) -> anyhow::Result<Verdict> {
    let found: Vec<Listed> = recordings_in(&args.folder)?
        .iter()
        .map(|path| listed(path))
        .collect();
    if args.json {
        writeln!(Stdout, "{}", serde_json::json!({ "recordings": found }))?;
        return Ok(Verdict::Done);
    }
    for listed in &found {
        match (&listed.record, &listed.error) {
            (Some(record), _) => writeln!(Stdout, "{}  {}", listed.path, line(record))?,
            (None, error) => writeln!(
                Stdout,
                "{}  {}",
                listed.path,
                error.as_deref().unwrap_or_default()
            )?,
        }
    }
    if found.is_empty() {
        writeln!(
            Stdout,
            "no recordings in {}; folders of images and raw recordings are not listed",
            args.folder.display()
        )?;
    }
    Ok(Verdict::Done)
}

fn listed(path: &Path) -> Listed {
    let read = SessionRecord::read(path);
    Listed {
        path: path.display().to_string(),
        error: read.as_ref().err().map(ToString::to_string),
        record: read.ok(),
    }
}

fn line(record: &SessionRecord) -> String {
    format!(
        "{} {}  {}  {} frames  {}",
        record.sensor,
        record.serial,
        state_name(record.state),
        record.counters.frames,
        megabytes(record.counters.bytes)
    )
}

/// A state in a word.
pub fn state_name(state: State) -> &'static str {
    match state {
        State::Open => "open",
        State::Closed => "closed",
        State::Repaired => "repaired",
    }
}
