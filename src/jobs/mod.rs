//! Refinement beside capture: jobs in a durable spool, run one at a time by a child process of low priority.

mod error;
mod job;
mod params;
mod worker;

pub use error::JobError;
pub use job::{Job, JobId, JobProgress, JobState};
pub use params::WorkerParams;
pub use worker::{Worker, WorkerHandle, WorkerSetup, WorkerStatus};
