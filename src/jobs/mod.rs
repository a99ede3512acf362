//! Refinement beside capture: jobs in a durable spool, run one at a time by a child process of low priority.
//!
//! A job is the refinement of one scan's folder, and is named by all that it is made from ([`JobId`]): asking twice for the same is
//! asking once. The spool keeps jobs on the disk; the [`Worker`]'s thread claims them and runs `relief refine` for each, which
//! lowers its own priority and limits, tells its progress on standard output, and writes into a folder of its own. Only when that
//! is whole do refined mesh and report go into the scan's folder, one rename each. Why a refinement was refused is added to the
//! report that is there. Base mesh, poses and shading images are read, never written.
//!
//! A child that crashes, is killed, or hangs and is ended for it, is repeated, [`WorkerParams::max_retries`] times at most, and the
//! reasons are kept; one whose outputs find no room on the disk is tried again behind all others, each time later, until they do. A
//! newer job takes the place of one of the same scan that still waits; one that runs is let be, and its result is dropped if the scan
//! has changed meanwhile. What ran when the daemon ended runs again when it is back, whichever version of the program that is; such
//! ends are counted by themselves.

mod child;
mod error;
mod idleness;
mod inputs;
mod job;
mod landing;
mod limits;
mod params;
mod refusal;
mod runner;
mod spool;
mod worker;

#[cfg(test)]
mod scenes;
#[cfg(test)]
mod tests;

pub use child::ProgressLine;
pub use error::JobError;
pub use job::{Job, JobId, JobProgress, JobState};
pub use limits::Limits;
pub use params::{Turns, WorkerParams};
pub use worker::{Worker, WorkerHandle, WorkerSetup, WorkerStatus};
