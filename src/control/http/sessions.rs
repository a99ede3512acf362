//! The scans that lie in the data directory.

use super::{
    App, aside,
    jobs::JobBody,
    path::Path,
    problem::{Problem, ProblemBody},
};
use crate::control::{
    data_folder::SessionId,
    sessions::{self, SessionBody},
};
use axum::{
    Json,
    body::Body,
    extract::State,
    http::{HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use futures_util::stream;
use serde::Serialize;
use serde_json::Value;
use std::{io, sync::Arc};
use tokio::{fs::File, io::AsyncReadExt};
use utoipa::ToSchema;

/// A file is sent in pieces of so many bytes.
const PIECE: usize = 64 * 1024;

/// A report's page brings its own style and pictures, and nothing that runs.
const REPORT_POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox";

/// A scan with all that is known of it.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct SessionDetailBody {
    /// What the list says of it.
    #[serde(flatten)]
    pub session: SessionBody,
    /// Its newest refinement.
    pub job: Option<JobBody>,
    /// Its report, once it is written.
    #[schema(value_type = Option<Object>)]
    pub report: Option<Value>,
}

/// The scans, the newest first
#[utoipa::path(get, path = "/api/v1/sessions", responses(
    (status = 200, body = [SessionBody]),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn list(State(app): State<Arc<App>>) -> Result<Json<Vec<SessionBody>>, Problem> {
    aside(move || {
        let running = running(&app);
        let sessions = sessions::list(&app.supervisor.data, running.as_ref())?;
        Ok(Json(sessions))
    })
    .await
}

/// One scan
#[utoipa::path(get, path = "/api/v1/sessions/{id}", params(("id" = String, Path)), responses(
    (status = 200, body = SessionDetailBody),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn read(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
) -> Result<Json<SessionDetailBody>, Problem> {
    let id = session_id(&id)?;
    aside(move || {
        let (data, running) = (&app.supervisor.data, running(&app));
        Ok(Json(SessionDetailBody {
            session: sessions::read(data, &id, running.as_ref()).map_err(no_session)?,
            job: app
                .supervisor
                .worker
                .of_scan(id.as_str())
                .map(JobBody::from),
            report: sessions::report(data, &id),
        }))
    })
    .await
}

/// Remove a scan with all that belongs to it
#[utoipa::path(delete, path = "/api/v1/sessions/{id}", params(("id" = String, Path)), responses(
    (status = 204, description = "it is gone"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn remove(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
) -> Result<StatusCode, Problem> {
    let id = session_id(&id)?;
    aside(move || {
        let worker = &app.supervisor.worker;
        if running(&app).as_ref() == Some(&id) {
            return Err(Problem::conflict("scanning", "the scan is going on"));
        }
        if let Some(job) = worker.at_work_on(id.as_str()) {
            let detail = match job.state.is_ended() {
                true => format!("job {} of the scan has not come to its end yet", job.id),
                false => format!("the scan is to be refined; cancel job {} first", job.id),
            };
            return Err(Problem::conflict("refining", detail));
        }
        sessions::remove(&app.supervisor.data, &id).map_err(no_session)?;
        tracing::info!(session_id = %id, "scan removed");
        Ok(StatusCode::NO_CONTENT)
    })
    .await
}

/// A file of a scan
#[utoipa::path(get, path = "/api/v1/sessions/{id}/files/{name}",
    params(
        ("id" = String, Path),
        ("name" = String, Path, description = "base.ply, refined.ply, refined.glb, trajectory.txt, report.html, report.json or events.jsonl"),
    ),
    responses(
        (status = 200, content(
            (Vec<u8> = "application/octet-stream"),
            (Vec<u8> = "model/gltf-binary"),
            (String = "text/plain"),
            (String = "text/html"),
            (Value = "application/json"),
            (String = "application/x-ndjson"),
        )),
        (status = "default", body = ProblemBody, content_type = "application/problem+json"),
    ))]
pub async fn file(
    State(app): State<Arc<App>>,
    Path((id, name)): Path<(String, String)>,
) -> Result<Response, Problem> {
    let id = session_id(&id)?;
    let of_scan = id.clone();
    let (file, path) =
        aside(move || Ok(sessions::file(&app.supervisor.data, &of_scan, &name)?)).await?;
    let open = File::open(path).await?;
    let length = open.metadata().await?.len();
    let mut response = Response::new(pieces(open, length));
    let headers = response.headers_mut();
    headers.insert(
        header::CONTENT_TYPE,
        HeaderValue::from_static(file.media_type),
    );
    headers.insert(header::CONTENT_LENGTH, length.into());
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if file.media_type.starts_with("text/html") {
        headers.insert(
            header::CONTENT_SECURITY_POLICY,
            HeaderValue::from_static(REPORT_POLICY),
        );
    }
    let name = format!("inline; filename=\"{id}-{}\"", file.name);
    if let Ok(name) = HeaderValue::try_from(name) {
        headers.insert(header::CONTENT_DISPOSITION, name);
    }
    Ok(response)
}

/// So many bytes of a file, piece by piece, as fast as the client takes them.
fn pieces(file: File, length: u64) -> Body {
    let read = |mut file: tokio::io::Take<File>| async move {
        let mut piece = Vec::with_capacity(PIECE);
        let n = file.read_buf(&mut piece).await?;
        io::Result::Ok((n > 0).then_some((piece, file)))
    };
    Body::from_stream(stream::try_unfold(file.take(length), read))
}

/// Refine a scan that has ended, again if it was refined before with other settings
#[utoipa::path(post, path = "/api/v1/sessions/{id}/refine", params(("id" = String, Path)), responses(
    (status = 202, body = JobBody),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn refine(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
) -> Result<Response, Problem> {
    let id = session_id(&id)?;
    if running(&app).as_ref() == Some(&id) {
        return Err(Problem::conflict("scanning", "the scan is going on"));
    }
    let looked = app.clone();
    let folder = aside(move || {
        let data = &looked.supervisor.data;
        sessions::read(data, &id, None).map_err(no_session)?;
        Ok(data.session(&id))
    });
    let job = app.supervisor.submit(folder.await?).await?;
    Ok((StatusCode::ACCEPTED, Json(JobBody::from(job))).into_response())
}

/// The name of a scan in an address.
pub fn session_id(text: &str) -> Result<SessionId, Problem> {
    text.parse().map_err(|_| no_such_session())
}

fn no_session(error: io::Error) -> Problem {
    match error.kind() {
        io::ErrorKind::NotFound => no_such_session(),
        _ => error.into(),
    }
}

fn no_such_session() -> Problem {
    Problem::not_found("there is no such scan")
}

fn running(app: &App) -> Option<SessionId> {
    app.supervisor.scan().map(|scan| scan.record.id.clone())
}
