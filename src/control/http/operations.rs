//! How the daemon is: health, status, metrics, devices, configuration.

use super::{
    App, aside, metrics,
    problem::{Problem, ProblemBody},
};
use crate::control::{camera_source::DeviceName, status_body::StatusBody};
use axum::{
    Json,
    extract::State,
    http::{StatusCode, header},
    response::{IntoResponse, Response},
};
use rustix::fs::{Access, access};
use serde::Serialize;
use serde_json::Value;
use std::sync::Arc;
use utoipa::ToSchema;

/// Whether the process answers
#[utoipa::path(get, path = "/healthz", responses((status = 200, content_type = "text/plain", body = String)))]
pub async fn healthz() -> &'static str {
    "ok\n"
}

/// Whether a scan could start, or goes on: the camera answers, and the disk can be written and has room
#[utoipa::path(get, path = "/readyz", responses(
    (status = 200, content_type = "text/plain", body = String),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn readyz(State(app): State<Arc<App>>) -> Result<&'static str, Problem> {
    aside(move || {
        let supervisor = &app.supervisor;
        if supervisor.is_draining() {
            return Err(not_ready("draining", "the daemon is ending"));
        }
        // A camera that is being scanned with cannot be asked; the scan tells of it, and of the room that there is.
        if supervisor.scan().is_none() {
            if supervisor.source.list().is_empty() {
                return Err(not_ready("no_device", "the camera does not answer"));
            }
            let room = supervisor.check_room();
            room.map_err(|error| not_ready("storage_failed", &error.to_string()))?;
        }
        // Not by the bits of its mode: the file system may be read-only, or the folder somebody else's.
        let folder = supervisor.data.sessions();
        access(&folder, Access::WRITE_OK | Access::EXEC_OK).map_err(|error| {
            let what = format!("{}: {error}", folder.display());
            not_ready("storage_failed", &what)
        })?;
        Ok("ready\n")
    })
    .await
}

fn not_ready(code: &'static str, detail: &str) -> Problem {
    Problem::new(StatusCode::SERVICE_UNAVAILABLE, code, detail)
}

/// Counters and gauges in Prometheus' text format
#[utoipa::path(get, path = "/metrics", responses(
    (status = 200, content_type = "application/openmetrics-text", body = String),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn metrics(State(app): State<Arc<App>>) -> Result<Response, Problem> {
    let text = metrics::encode(&app.supervisor, app.n_clients()).map_err(Problem::internal)?;
    let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    Ok(([(header::CONTENT_TYPE, kind)], text).into_response())
}

/// What the daemon is doing
#[utoipa::path(get, path = "/api/v1/status", responses(
    (status = 200, body = StatusBody),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn status(State(app): State<Arc<App>>) -> Json<StatusBody> {
    Json(StatusBody::of(&app.supervisor, app.n_clients()))
}

/// The cameras that this daemon may scan with
#[utoipa::path(get, path = "/api/v1/devices", responses(
    (status = 200, body = [DeviceName]),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn devices(State(app): State<Arc<App>>) -> Result<Json<Vec<DeviceName>>, Problem> {
    let devices = aside(move || {
        Ok(match app.supervisor.scan() {
            Some(scan) => vec![scan.record.device.clone()],
            None => app.supervisor.source.list(),
        })
    });
    devices.await.map(Json)
}

/// The configuration
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct ConfigBody {
    /// Whether a file was given with `--config`; the files of the layers are read anew with or without one.
    pub has_file: bool,
    /// Why the newest file is not in force.
    pub error: Option<String>,
    /// All keys in force, as in `config/relief.toml`.
    #[schema(value_type = Object)]
    pub config: Value,
}

/// The configuration in force
#[utoipa::path(get, path = "/api/v1/config", responses(
    (status = 200, body = ConfigBody),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn config(State(app): State<Arc<App>>) -> Result<Json<ConfigBody>, Problem> {
    let settings = &app.supervisor.settings;
    let config = serde_json::to_value(settings.config()).map_err(Problem::internal)?;
    Ok(Json(ConfigBody {
        has_file: settings.file().is_some(),
        error: settings.error().map(|error| error.to_string()),
        config,
    }))
}

/// Read the configuration file anew, for the scans that start from now on; one that makes no sense changes nothing
#[utoipa::path(post, path = "/api/v1/config/reload", responses(
    (status = 200, body = ConfigBody),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn reload(State(app): State<Arc<App>>) -> Result<Json<ConfigBody>, Problem> {
    let reloading = app.clone();
    aside(move || {
        let reloaded = reloading.supervisor.reload();
        reloaded.map_err(|error| Problem::conflict("bad_config", error))
    })
    .await?;
    config(State(app)).await
}
