//! A scan as it was written down on the way becomes a session of its own, which is refined while the scan goes on.

use super::{
    data_folder::SessionId,
    scan_record::ScanRecord,
    supervisor::{SubmitError, Supervisor},
};
use crate::{jobs::JobState, pipeline::CALIBRATION};
use std::{
    fs, io,
    path::{Path, PathBuf},
    sync::Arc,
};
use tokio::task;

/// Makes a session of what `of` wrote into a folder of its own so far, and asks for its refinement, which takes the place of
/// one that still waits.
///
/// # Errors
/// If the system or the refinement worker refuses.
pub async fn refine(
    supervisor: Arc<Supervisor>,
    of: ScanRecord,
    interim: PathBuf,
) -> Result<(), SubmitError> {
    let adopting = supervisor.clone();
    let adopted = task::spawn_blocking(move || {
        cancel_waiting(&adopting, &of.id);
        adopt(&adopting, &of, &interim).inspect_err(|_| {
            // Nobody asks for it again.
            let _ = fs::remove_dir_all(&interim);
        })
    });
    let folder = adopted.await.map_err(io::Error::other)??;
    supervisor.submit(folder).await?;
    Ok(())
}

/// Moves the folder among the sessions; it keeps its files.
fn adopt(supervisor: &Supervisor, of: &ScanRecord, interim: &Path) -> io::Result<PathBuf> {
    let calibration = supervisor.data.session(&of.id).join(CALIBRATION);
    if calibration.is_file() {
        fs::copy(calibration, interim.join(CALIBRATION))?;
    }
    let record = of.clone().interim(SessionId::generate());
    record.write(interim)?;
    let folder = supervisor.data.session(&record.id);
    fs::rename(interim, &folder)?;
    tracing::info!(session_id = %of.id, interim_id = %record.id, "scan written down on the way");
    Ok(folder)
}

/// Cancels the refinements of what a scan wrote down before that have not begun: there is something newer.
pub fn cancel_waiting(supervisor: &Supervisor, of: &SessionId) {
    for job in supervisor.worker.list() {
        let record = job
            .scan
            .parse()
            .ok()
            .and_then(|id| ScanRecord::read(&supervisor.data.session(&id)).ok());
        let is_of_scan = record.is_some_and(|record| record.interim_of.as_ref() == Some(of));
        if is_of_scan && job.state == JobState::Waiting {
            // One that has begun meanwhile goes on.
            let _ = supervisor.worker.cancel(&job.id);
        }
    }
}
