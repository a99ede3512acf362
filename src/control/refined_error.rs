//! How well the newest refined mesh explains images that were held out, read from its report once, when its job is done.

use super::{data_folder::SessionId, sessions, supervisor::Supervisor};
use crate::lock::lock;
use std::sync::{Arc, Mutex};
use tokio::task;

/// The error of the refined mesh of one job.
#[derive(Debug, Default)]
pub struct RefinedError(Mutex<Option<(String, f64)>>);

impl RefinedError {
    /// The error of the intensity in the images held out, share of its mean, root mean square; `None` if it is not known.
    pub fn of_job(&self, job: &str) -> Option<f64> {
        let known = lock(&self.0);
        let known = known.as_ref().filter(|(of, _)| of == job);
        known.map(|(_, rmse)| *rmse)
    }

    fn put(&self, job: String, rmse: f64) {
        *lock(&self.0) = Some((job, rmse));
    }
}

/// Reads the error of a job that is done, aside.
pub fn read_aside(supervisor: &Arc<Supervisor>, job: String, scan: &str) {
    let Ok(id) = scan.parse::<SessionId>() else {
        return;
    };
    let supervisor = supervisor.clone();
    task::spawn_blocking(move || {
        let report = sessions::report(&supervisor.data, &id).unwrap_or_default();
        let held_out = &report["refined_mesh"]["held_out"];
        let is_judged = held_out["n_views"].as_u64() > Some(0);
        if let Some(rmse) = held_out["intensity_refined"].as_f64().filter(|_| is_judged) {
            supervisor.refined_error.put(job, rmse);
        }
    });
}
