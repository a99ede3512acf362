//! Refinements: what waits, runs and is over.

use super::{
    App, aside,
    path::Path,
    problem::{Problem, ProblemBody},
};
use crate::{
    control::status_body::RefinementBody,
    jobs::{Job, JobId},
};
use axum::{Json, extract::State};
use serde::Serialize;
use std::sync::Arc;
use utoipa::ToSchema;

/// A refinement as a job.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct JobBody {
    /// Its name, which says what it is made from.
    pub id: String,
    /// When it was asked for, milliseconds since 1970.
    pub submitted_unix_ms: u64,
    /// Why its attempts failed.
    pub failures: Vec<String>,
    /// How far it is.
    #[serde(flatten)]
    pub refinement: RefinementBody,
}

impl From<Job> for JobBody {
    fn from(job: Job) -> Self {
        JobBody {
            id: job.id.to_string(),
            submitted_unix_ms: job.submitted_unix_ms,
            failures: job.failures.clone(),
            refinement: job.into(),
        }
    }
}

/// All refinements, the newest first
#[utoipa::path(get, path = "/api/v1/jobs", responses(
    (status = 200, body = [JobBody]),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn list(State(app): State<Arc<App>>) -> Json<Vec<JobBody>> {
    let jobs = app.supervisor.worker.list();
    Json(jobs.into_iter().map(JobBody::from).collect())
}

/// End a refinement that waits or runs
#[utoipa::path(post, path = "/api/v1/jobs/{id}/cancel", params(("id" = String, Path)), responses(
    (status = 200, body = JobBody, description = "it is ending"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn cancel(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
) -> Result<Json<JobBody>, Problem> {
    let id: JobId = id.parse().map_err(Problem::not_found)?;
    aside(move || {
        let worker = &app.supervisor.worker;
        worker.cancel(&id)?;
        let job = worker.list().into_iter().find(|job| job.id == id);
        let job = job.ok_or_else(|| Problem::not_found(format!("there is no job {id}")))?;
        Ok(Json(job.into()))
    })
    .await
}
