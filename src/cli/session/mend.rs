//! `relief session repair` and `rm`.

use super::{RemoveArgs, RepairArgs, require_mcap};
use crate::cli::{run::Verdict, stdout::Stdout};
use anyhow::ensure;
use mcap_session::{RecordingError, RepairNote, Repaired, SESSION_FILE_NAME};
use serde_json::{Value, json};
use std::{io::Write, path::Path};

/// `relief session repair`: one recording, or all in a folder that were left open.
pub fn repair(args: &RepairArgs) -> anyhow::Result<Verdict> {
    let repaired = mend(&args.folder)?;
    let has_failed = repaired.iter().any(|(_, result)| result.is_err());
    match args.json {
        true => {
            let recordings: Vec<Value> = repaired.iter().map(object).collect();
            writeln!(Stdout, "{}", json!({ "recordings": recordings }))?;
        }
        false if repaired.is_empty() => {
            writeln!(
                Stdout,
                "no recordings were left open in {}",
                args.folder.display()
            )?;
        }
        false => repaired
            .iter()
            .try_for_each(|(path, result)| writeln!(Stdout, "{}", line(path, result)))?,
    }
    Ok(match has_failed {
        true => Verdict::Failed,
        false => Verdict::Done,
    })
}

fn mend(folder: &Path) -> anyhow::Result<Vec<Repaired>> {
    if folder.join(SESSION_FILE_NAME).exists() {
        let repaired = mcap_session::repair(folder)?;
        return Ok(vec![(folder.to_owned(), Ok(repaired))]);
    }
    require_mcap(folder)?;
    let path = folder.display();
    ensure!(
        folder.is_dir(),
        "{path} is no folder: a recording is mended as a whole"
    );
    ensure!(
        !mcap_session::is_recording(folder),
        "{path} holds .mcap files but no {SESSION_FILE_NAME}: it is not mended, \
         relief session import reads it as far as it is whole"
    );
    Ok(mcap_session::repair_abandoned(folder)?)
}

fn object((path, result): &Repaired) -> Value {
    let note = result.as_ref().ok().and_then(Option::as_ref);
    json!({
        "path": path.display().to_string(),
        "repaired": note.is_some(),
        "repair": note,
        "error": result.as_ref().err().map(ToString::to_string),
    })
}

fn line(path: &Path, result: &Result<Option<RepairNote>, RecordingError>) -> String {
    let path = path.display();
    let note = match result {
        Ok(None) => return format!("{path} is whole"),
        Err(error) => return format!("{path} is not repaired: {error}"),
        Ok(Some(note)) => note,
    };
    let lost = match note.frames_lost {
        Some(lost) => format!("{lost} lost"),
        None => "how many were lost is not known".to_owned(),
    };
    format!(
        "{path} is repaired: {} frames, {lost}; {} bytes cut off, {} passed over",
        note.frames_recovered, note.bytes_cut, note.bytes_passed_over
    )
}

/// `relief session rm`.
pub fn remove(args: &RemoveArgs) -> anyhow::Result<Verdict> {
    for session in &args.sessions {
        mcap_session::remove(session)?;
        if !args.json {
            writeln!(Stdout, "{} is removed", session.display())?;
        }
    }
    if args.json {
        let sessions = args.sessions.iter();
        let removed: Vec<String> = sessions.map(|path| path.display().to_string()).collect();
        writeln!(Stdout, "{}", json!({ "removed": removed }))?;
    }
    Ok(Verdict::Done)
}
