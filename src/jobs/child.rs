//! The child process of an attempt: started, listened to, told to end.

use super::{JobProgress, idleness::Idleness, limits::Limits};
use crate::pipeline::CALIBRATION;
use crossbeam::channel::{Receiver, bounded};
use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, kill_process_group, waitid};
use serde::{Deserialize, Serialize};
use std::{
    ffi::OsString,
    io::{self, BufRead, BufReader, Read},
    num::NonZeroUsize,
    os::unix::process::{CommandExt, ExitStatusExt},
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    thread,
    time::{Duration, Instant},
};

/// How often the child and the orders are looked at.
const POLL: Duration = Duration::from_millis(50);
/// How long what a child said may take to be heard once it has ended. Arbitrary: a full pipe is read in moments.
const LAST_WORDS: Duration = Duration::from_secs(5);
/// Longer lines are no child's of ours.
const MAX_LINE_BYTES: u64 = 1 << 20;
/// Of what the child said last, so much is kept.
const MAX_SAID_CHARS: usize = 400;
/// Exit code of a child whose arguments or configuration make no sense, and will not another time.
const EXIT_BAD_USAGE: i32 = 2;
/// Exit code of a child of which nothing failed but that the disk did not take its outputs, and may another time.
const EXIT_NO_ROOM: i32 = 5;

/// A line of `relief refine --progress-json`.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
pub struct ProgressLine {
    /// How far it is.
    pub progress: JobProgress,
}

/// Of the last line, the summary, what the worker asks.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
struct Summary {
    refined: bool,
    not_refined_reason: Option<String>,
}

/// What is run.
#[derive(Clone, Debug)]
pub struct Attempt<'a> {
    /// The program.
    pub program: &'a Path,
    /// The scan's folder.
    pub scan: PathBuf,
    /// The folder of its outputs.
    pub out: PathBuf,
    /// The file of the settings.
    pub settings: PathBuf,
    /// Where calibrations named by serial number lie, for a scan without one.
    pub calibration_dir: &'a Path,
    /// Threads of its pool.
    pub n_threads: NonZeroUsize,
    /// Its limits.
    pub limits: Limits,
    /// How long it may take to end when it is told to.
    pub grace: Duration,
    /// How long it may do nothing.
    pub max_idle: Duration,
}

/// How an attempt ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AttemptEnd {
    /// The output folder is whole and holds a refined mesh.
    Refined,
    /// There is no refined mesh, for this reason.
    Refused(String),
    /// It was told to end.
    Told,
    /// The disk did not take its outputs, and may later, for this reason.
    NoRoom(String),
    /// It failed for this reason, and may fare better another time.
    Failed(String),
    /// It failed for this reason, as it will another time.
    Hopeless(String),
}

/// Runs the child to its end. `is_told` says whether it is to end before.
///
/// # Errors
/// If the system gives no process or thread.
pub fn run(
    attempt: &Attempt,
    is_told: impl Fn() -> bool,
    on_progress: impl Fn(JobProgress) + Send + 'static,
) -> io::Result<AttemptEnd> {
    let mut child = Command::new(attempt.program)
        .args(arguments(attempt))
        // What it says last is to be the reason.
        .env("RUST_BACKTRACE", "0")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        // A group of its own: neither the terminal's Ctrl-C nor its own children are mixed with the daemon's.
        .process_group(0)
        .spawn()?;
    let heard = match listen(&mut child, on_progress) {
        Ok(heard) => heard,
        Err(error) => {
            kill(&child, Signal::KILL);
            child.wait()?;
            return Err(error);
        }
    };
    let watched = watch(&child, attempt, is_told);
    // Until it is waited for its number is its own, so that nobody else is hit.
    kill(&child, Signal::KILL);
    let status = child.wait()?;
    match watched? {
        Watched::Ended => {}
        Watched::Told => return Ok(AttemptEnd::Told),
        Watched::Idle => {
            let reason = format!("it did nothing for {:?}", attempt.max_idle);
            return Ok(AttemptEnd::Failed(reason));
        }
    }
    // Whoever holds the other end of a pipe is dead; the time limit is for who has left the group.
    let summary = heard.summary.recv_timeout(LAST_WORDS).ok().flatten();
    let last_words = heard.last_words.recv_timeout(LAST_WORDS);
    Ok(verdict(status, summary, &last_words.unwrap_or_default()))
}

fn arguments(attempt: &Attempt) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = vec![
        "refine".into(),
        (&attempt.scan).into(),
        "--out".into(),
        (&attempt.out).into(),
        "--deliver-to".into(),
        (&attempt.scan).into(),
        "--config".into(),
        (&attempt.settings).into(),
        // They are complete: the machine's own may have changed since, or be half edited.
        "--config-alone".into(),
        "--calibration-dir".into(),
        attempt.calibration_dir.into(),
        "--threads".into(),
        attempt.n_threads.to_string().into(),
        "--progress-json".into(),
    ];
    // What the scan was made with, and its job is named by; a file of the device may be newer.
    let own = attempt.scan.join(CALIBRATION);
    if own.is_file() {
        arguments.extend(["--calibration".into(), own.into()]);
    }
    arguments.extend(attempt.limits.arguments().into_iter().map(OsString::from));
    arguments
}

/// Why a child is not watched any more.
enum Watched {
    /// It ended by itself.
    Ended,
    /// It was told to end, and has.
    Told,
    /// It does nothing.
    Idle,
}

/// Waits for the child's end; tells it to end if it is told so, and kills it if that takes too long. The child is not waited
/// for: its number stays taken.
fn watch(child: &Child, attempt: &Attempt, is_told: impl Fn() -> bool) -> io::Result<Watched> {
    let has_ended = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
    let mut told_at: Option<Instant> = None;
    let mut idleness = Idleness::new(child.id(), attempt.max_idle);
    while waitid(WaitId::Pid(pid(child)?), has_ended)?.is_none() {
        match told_at {
            None if is_told() => {
                told_at = Some(Instant::now());
                kill(child, Signal::TERM);
            }
            None if idleness.is_over() => return Ok(Watched::Idle),
            Some(when) if when.elapsed() > attempt.grace => kill(child, Signal::KILL),
            _ => {}
        }
        thread::sleep(POLL);
    }
    Ok(match told_at {
        Some(_) => Watched::Told,
        None => Watched::Ended,
    })
}

fn pid(child: &Child) -> io::Result<Pid> {
    let number = i32::try_from(child.id()).ok();
    number
        .and_then(Pid::from_raw)
        .ok_or_else(|| io::Error::other(format!("{} is no process", child.id())))
}

/// Sends a signal to the child and its own children. One that has ended needs none.
fn kill(child: &Child, signal: Signal) {
    if let Ok(pid) = pid(child) {
        let _ = kill_process_group(pid, signal);
    }
}

/// What the threads at the child's pipes hear, once the pipes are closed.
struct Heard {
    summary: Receiver<Option<Summary>>,
    last_words: Receiver<String>,
}

fn listen(
    child: &mut Child,
    on_progress: impl Fn(JobProgress) + Send + 'static,
) -> io::Result<Heard> {
    let closed = || io::Error::other("the child has no pipe");
    let stdout = child.stdout.take().ok_or_else(closed)?;
    let stderr = child.stderr.take().ok_or_else(closed)?;
    let (summary_in, summary) = bounded(1);
    let (words_in, last_words) = bounded(1);
    thread::Builder::new()
        .name("job-progress".to_owned())
        .spawn(move || {
            // Nobody waits for it any more: then there is nobody to tell.
            let _ = summary_in.send(hear_progress(stdout, on_progress));
        })?;
    thread::Builder::new()
        .name("job-log".to_owned())
        .spawn(move || {
            let _ = words_in.send(hear_log(stderr));
        })?;
    Ok(Heard {
        summary,
        last_words,
    })
}

/// Calls back for each progress line; returns the summary, if there is one.
fn hear_progress(pipe: impl Read, on_progress: impl Fn(JobProgress)) -> Option<Summary> {
    let mut summary = None;
    for_each_line(pipe, |line| {
        if let Ok(line) = serde_json::from_str::<ProgressLine>(line) {
            on_progress(line.progress);
        } else if let Ok(found) = serde_json::from_str(line) {
            summary = Some(found);
        }
    });
    summary
}

/// Passes on what the child logs; returns its last line.
fn hear_log(pipe: impl Read) -> String {
    let mut last = String::new();
    for_each_line(pipe, |line| {
        let line = line.trim();
        // A panic ends with advice on how to see more of it.
        if !line.is_empty() && !line.starts_with("note: ") {
            tracing::debug!(line, "refinement");
            last = line.chars().take(MAX_SAID_CHARS).collect();
        }
    });
    last
}

/// Reads lines, which end where they are too long, until the pipe is closed or broken.
fn for_each_line(pipe: impl Read, mut take: impl FnMut(&str)) {
    let mut pipe = BufReader::new(pipe);
    let mut line = Vec::new();
    loop {
        line.clear();
        match pipe
            .by_ref()
            .take(MAX_LINE_BYTES)
            .read_until(b'\n', &mut line)
        {
            Ok(0) | Err(_) => return,
            Ok(_) => take(&String::from_utf8_lossy(&line)),
        }
    }
}

/// What the child's end means.
fn verdict(status: ExitStatus, summary: Option<Summary>, last_words: &str) -> AttemptEnd {
    let with_words = |what: String| match last_words {
        "" => what,
        said => format!("{what}: {said}"),
    };
    let failed = |what| AttemptEnd::Failed(with_words(what));
    match (status.code(), status.signal(), summary) {
        (Some(0), _, Some(summary)) if summary.refined => AttemptEnd::Refined,
        (Some(0), _, Some(summary)) => AttemptEnd::Refused(
            summary
                .not_refined_reason
                .unwrap_or_else(|| "refinement gives no reason".to_owned()),
        ),
        (Some(0), _, None) => failed("it ended without a summary".to_owned()),
        (Some(EXIT_BAD_USAGE), ..) => {
            AttemptEnd::Hopeless(with_words("bad usage or configuration".to_owned()))
        }
        (Some(EXIT_NO_ROOM), ..) => {
            AttemptEnd::NoRoom(with_words("its outputs found no room".to_owned()))
        }
        (Some(code), ..) => failed(format!("exit code {code}")),
        (None, Some(signal), _) => failed(format!("killed by signal {}", name_of(signal))),
        (None, None, _) => failed(format!("it ended with {status}")),
    }
}

/// The signals that end a refinement.
fn name_of(signal: i32) -> String {
    let known = [
        (Signal::KILL, "SIGKILL"),
        (Signal::TERM, "SIGTERM"),
        (Signal::INT, "SIGINT"),
        (Signal::SEGV, "SIGSEGV"),
        (Signal::BUS, "SIGBUS"),
        (Signal::ABORT, "SIGABRT, as where memory is used up"),
        (Signal::XCPU, "SIGXCPU: its processor time is used up"),
    ];
    let name = known
        .iter()
        .find(|(known, _)| known.as_raw() == signal)
        .map(|(_, name)| *name);
    name.map_or_else(|| signal.to_string(), str::to_owned)
}
