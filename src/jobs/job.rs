//! What a job is, and how far it is.

use serde::{Deserialize, Serialize};
use std::{fmt, str::FromStr};

/// Names a job by what it is made from: the SHA-256 of its inputs in 64 lower-case hexadecimal digits.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Deserialize, Serialize)]
#[serde(try_from = "String", into = "String")]
pub struct JobId(String);

impl JobId {
    /// Its digits.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for JobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for JobId {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let is_digit = |byte: u8| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
        match text.len() == 64 && text.bytes().all(is_digit) {
            true => Ok(JobId(text.to_owned())),
            false => Err(format!(
                "\"{text}\" names no job, must be 64 lower-case hexadecimal digits"
            )),
        }
    }
}

impl TryFrom<String> for JobId {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<JobId> for String {
    fn from(id: JobId) -> String {
        id.0
    }
}

/// Where a job stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// It will be run.
    Waiting,
    /// A child process is at it.
    Running,
    /// The refined mesh lies in the scan's folder.
    Done,
    /// It ran, and there is no refined mesh for a reason that lies in the scan.
    Refused,
    /// It failed as often as it may.
    Failed,
    /// Somebody asked for its end.
    Cancelled,
    /// A newer job of the same scan took its place, or the scan has changed.
    Superseded,
}

impl JobState {
    /// Its name in files and answers.
    pub fn code(self) -> &'static str {
        match self {
            JobState::Waiting => "waiting",
            JobState::Running => "running",
            JobState::Done => "done",
            JobState::Refused => "refused",
            JobState::Failed => "failed",
            JobState::Cancelled => "cancelled",
            JobState::Superseded => "superseded",
        }
    }

    /// Whether nothing more will happen.
    pub fn is_ended(self) -> bool {
        !matches!(self, JobState::Waiting | JobState::Running)
    }
}

/// How far a running refinement is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct JobProgress {
    /// Outer rounds begun, of how many; both 0 while it prepares.
    pub round: (usize, usize),
    /// Steps made, over all rounds.
    pub step: usize,
    /// Energy of the last step, share of the first.
    pub energy_share: f64,
    /// Seconds that are left, once a round is over, and until one outlasts what those before it tell.
    pub secs_left: Option<f64>,
}

/// A job as it is shown.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Job {
    /// What it is made from.
    pub id: JobId,
    /// Name of the scan's folder.
    pub scan: String,
    /// When it was asked for, milliseconds since 1970.
    pub submitted_unix_ms: u64,
    /// Where it stands.
    pub state: JobState,
    /// Why its attempts failed, in order.
    pub failures: Vec<String>,
    /// What is to be said of its ending.
    pub message: Option<String>,
    /// Why it waits behind all others, and is tried again later: its outputs found no room on the disk.
    pub lacks_room: Option<String>,
    /// How far it is, while it runs and has told.
    pub progress: Option<JobProgress>,
}
