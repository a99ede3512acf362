//! What stands in a job's file.

use crate::jobs::{Job, JobId, JobState};
use serde::{Deserialize, Serialize};

/// The folders of the spool.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// Will be run.
    Waiting,
    /// Claimed by the worker.
    Running,
    /// Ran to its end.
    Done,
    /// Ended otherwise.
    Failed,
}

impl Place {
    /// All of them.
    pub const ALL: [Place; 4] = [Place::Waiting, Place::Running, Place::Done, Place::Failed];

    /// The folder's name.
    pub fn folder(self) -> &'static str {
        match self {
            Place::Waiting => "waiting",
            Place::Running => "running",
            Place::Done => "done",
            Place::Failed => "failed",
        }
    }
}

/// How a job ended.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Ending {
    /// One of the states in which nothing more happens.
    pub state: JobState,
    /// What is to be said of it.
    pub message: Option<String>,
}

impl Ending {
    /// Where a job that ended so is kept.
    pub fn place(&self) -> Place {
        match self.state {
            JobState::Done | JobState::Refused => Place::Done,
            _ => Place::Failed,
        }
    }
}

/// That the outputs of a job's attempts found no room on the disk.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct NoRoom {
    /// How often.
    pub n_times: u32,
    /// What was said of it last.
    pub reason: String,
}

/// A job's file.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// What it is made from; also the file's name.
    pub id: JobId,
    /// Name of the scan's folder.
    pub scan: String,
    /// Jobs are counted in the order in which they were asked for.
    pub sequence: u64,
    /// When it was asked for, milliseconds since 1970.
    pub submitted_unix_ms: u64,
    /// Name of the file of its settings.
    pub settings: String,
    /// The version of the program that it is named by; whichever is there when its turn comes runs it.
    #[serde(default = "first_version")]
    pub version: String,
    /// Why its attempts failed, in order.
    pub failures: Vec<String>,
    /// How often the daemon ended while it ran, without having been told to.
    #[serde(default)]
    pub n_interruptions: u32,
    /// That the outputs of its attempts found no room; it then waits behind those that may find some.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub no_room: Option<NoRoom>,
    /// The number of the output folder of the attempt that is under way.
    pub attempt: Option<u32>,
    /// Whether that attempt succeeded, and its outputs are moved to the scan's folder.
    pub is_landing: bool,
    /// How it ended; the file then lies in the folder of the ending, or is on its way there.
    pub ending: Option<Ending>,
}

/// The version of the records that name none.
fn first_version() -> String {
    "0.1.0".to_owned()
}

impl Record {
    /// How often its outputs found no room.
    pub fn n_times_without_room(&self) -> u32 {
        self.no_room.as_ref().map_or(0, |no_room| no_room.n_times)
    }

    /// The job as it is shown.
    pub fn job(&self, place: Place) -> Job {
        let state = match (&self.ending, place) {
            (Some(ending), _) => ending.state,
            (None, Place::Running) if self.attempt.is_some() => JobState::Running,
            // Also of those that were claimed, and then the disk had no room for the attempt's number.
            (None, _) => JobState::Waiting,
        };
        // Whether there is room now the attempt that runs will tell.
        let no_room = self.no_room.as_ref();
        let no_room = no_room.filter(|_| state == JobState::Waiting);
        Job {
            id: self.id.clone(),
            scan: self.scan.clone(),
            submitted_unix_ms: self.submitted_unix_ms,
            state,
            failures: self.failures.clone(),
            message: self
                .ending
                .as_ref()
                .and_then(|ending| ending.message.clone()),
            lacks_room: no_room.map(|no_room| no_room.reason.clone()),
            progress: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_of_the_first_version_is_read() {
        let text = format!(
            r#"{{"id":"{:064x}","scan":"a","sequence":0,"submitted_unix_ms":1,"settings":"s.toml",
                "failures":[],"attempt":null,"is_landing":false,"ending":null}}"#,
            1
        );
        let record: Record = serde_json::from_str(&text).unwrap();
        assert_eq!(record.version, "0.1.0");
        assert_eq!((record.n_interruptions, record.no_room), (0, None));
    }
}
