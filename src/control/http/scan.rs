//! The scan: its commands, its path and its shading images.

use super::{
    App, accepted, aside,
    body::JsonBody,
    path::Path,
    problem::{Problem, ProblemBody},
};
use crate::{
    control::{
        camera_source::SourceError,
        supervisor::{Scan, StartError},
    },
    devices::OpenError,
    export::encode_png_grey8,
    geometry::Pose,
    pipeline::{Command, CommandRefused, LiveSnapshot, SpawnError},
};
use axum::{
    Json,
    extract::State,
    http::{StatusCode, header},
    response::{IntoResponse, Response},
};
use depth_camera::{CameraError, Image};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use utoipa::ToSchema;

/// Longest label, characters.
const MAX_LABEL: usize = 200;

/// How a scan is started.
#[derive(Clone, Debug, Default, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StartBody {
    /// What the operator calls the scan, at most 200 characters; kept beside it and never a name of a file.
    pub label: Option<String>,
}

/// A scan that was started.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, ToSchema)]
pub struct StartedBody {
    /// Its name.
    pub id: String,
}

/// Start a scan
#[utoipa::path(post, path = "/api/v1/scan", request_body = Option<StartBody>, responses(
    (status = 201, body = StartedBody),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn start(
    State(app): State<Arc<App>>,
    JsonBody(body): JsonBody<StartBody>,
) -> Result<Response, Problem> {
    let label = body.label.filter(|label| !label.is_empty());
    let n_characters = label.as_ref().map_or(0, |label| label.chars().count());
    if n_characters > MAX_LABEL {
        let detail = format!("label has {n_characters} characters, must have at most {MAX_LABEL}");
        return Err(Problem::bad_request("bad_label", detail));
    }
    let id = app.supervisor.start(label).await?.to_string();
    Ok((StatusCode::CREATED, Json(StartedBody { id })).into_response())
}

/// What keeps a camera from being used, for programs.
fn code_of(error: &SourceError) -> &'static str {
    match error {
        SourceError::Camera(source) | SourceError::Open(OpenError::Camera { source, .. }) => {
            match source {
                CameraError::Busy => "device_busy",
                CameraError::PermissionDenied => "device_forbidden",
                _ => "no_device",
            }
        }
        SourceError::Config(_) => "bad_config",
        SourceError::Open(_) | SourceError::Unclear(_) => "no_device",
    }
}

impl From<StartError> for Problem {
    fn from(error: StartError) -> Self {
        let unavailable = |code| Problem::new(StatusCode::SERVICE_UNAVAILABLE, code, &error);
        match &error {
            StartError::AlreadyScanning => Problem::conflict("already_scanning", error),
            StartError::Draining => Problem::conflict("draining", error),
            StartError::Camera(error) => unavailable(code_of(error)),
            StartError::Config(_) => Problem::conflict("bad_config", error),
            StartError::NoRoom(_)
            | StartError::Folder(_)
            | StartError::Record(_)
            | StartError::Spawn(SpawnError::Recorder(_)) => unavailable("storage_failed"),
            StartError::Spawn(_) | StartError::Program(_) => Problem::internal(error),
        }
    }
}

fn command(app: &App, command: Command) -> Result<Response, Problem> {
    app.supervisor.command(command)?;
    Ok(accepted())
}

/// Pause: frames come and are not used
#[utoipa::path(post, path = "/api/v1/scan/pause", responses(
    (status = 202, description = "it is done before the next frame"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn pause(State(app): State<Arc<App>>) -> Result<Response, Problem> {
    command(&app, Command::Pause)
}

/// End a pause
#[utoipa::path(post, path = "/api/v1/scan/resume", responses(
    (status = 202, description = "it is done before the next frame"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn resume(State(app): State<Arc<App>>) -> Result<Response, Problem> {
    command(&app, Command::Resume)
}

/// Take the next good infrared image as a shading image
#[utoipa::path(post, path = "/api/v1/scan/snapshot", responses(
    (status = 202, description = "it is done with the next frame that is good enough"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn snapshot(State(app): State<Arc<App>>) -> Result<Response, Problem> {
    command(&app, Command::Snapshot)
}

/// Write down what there is, and refine it while the scan goes on
#[utoipa::path(post, path = "/api/v1/scan/refine", responses(
    (status = 202, description = "it is done between two frames; a job follows"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn refine(State(app): State<Arc<App>>) -> Result<Response, Problem> {
    command(&app, Command::Refine)
}

/// Drop the model and begin anew
#[utoipa::path(post, path = "/api/v1/scan/reset", responses(
    (status = 202, description = "it is done before the next frame"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn reset(State(app): State<Arc<App>>) -> Result<Response, Problem> {
    command(&app, Command::Reset)
}

/// End the scan: meshes, shading images and report are written, then it is refined; from now on it can only be abandoned
#[utoipa::path(post, path = "/api/v1/scan/finish", responses(
    (status = 202, description = "the scan is ending"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn finish(State(app): State<Arc<App>>) -> Result<Response, Problem> {
    command(&app, Command::Finish)
}

/// End the scan, or its end where it is ending already: it is not improved any further, and not refined
#[utoipa::path(post, path = "/api/v1/scan/abandon", responses(
    (status = 202, description = "the scan is ending"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn abandon(State(app): State<Arc<App>>) -> Result<Response, Problem> {
    command(&app, Command::Abandon)
}

/// How much is taken back.
#[derive(Clone, Copy, Debug, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct UndoBody {
    /// Seconds of tracking.
    pub secs: f64,
}

impl Default for UndoBody {
    fn default() -> Self {
        UndoBody { secs: 5.0 }
    }
}

/// Take back what was fused during the last seconds
#[utoipa::path(post, path = "/api/v1/scan/undo", request_body = Option<UndoBody>, responses(
    (status = 202, description = "it is done between two frames"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn undo(
    State(app): State<Arc<App>>,
    JsonBody(body): JsonBody<UndoBody>,
) -> Result<Response, Problem> {
    command(&app, Command::Undo { secs: body.secs })
}

/// Where the camera was, is, and should be: `tx ty tz qx qy qz qw`, world from camera, metres.
#[derive(Clone, Debug, Default, PartialEq, Serialize, ToSchema)]
pub struct PathBody {
    /// Where it was, thinned out.
    pub poses: Vec<[f64; 7]>,
    /// Where it was tracked well last.
    pub last_good: Option<[f64; 7]>,
    /// From where a next view would tell most.
    pub next: Option<NextBody>,
}

/// From where a next view would tell most.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct NextBody {
    /// Where to hold the camera.
    pub pose: [f64; 7],
    /// Why.
    pub why: String,
}

/// The scan that goes on, or why it cannot be looked at.
pub fn running(app: &App) -> Result<Arc<Scan>, Problem> {
    let scan = app.supervisor.scan();
    scan.ok_or_else(|| CommandRefused::NotScanning.into())
}

/// The camera's path
#[utoipa::path(get, path = "/api/v1/scan/path", responses(
    (status = 200, body = PathBody),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn path(State(app): State<Arc<App>>) -> Result<Json<PathBody>, Problem> {
    let scan = running(&app)?;
    let live = scan.watch.live();
    let poses = live.path().unwrap_or_default();
    Ok(Json(PathBody {
        poses: poses.iter().map(numbers).collect(),
        last_good: live.pose().map(|pose| numbers(&pose.last_good)),
        next: live.next_view().map(|next| NextBody {
            pose: numbers(&next.world_from_camera),
            why: next.why.clone(),
        }),
    }))
}

fn numbers(pose: &Pose) -> [f64; 7] {
    let (t, q) = (&pose.translation, &pose.rotation);
    [t.x, t.y, t.z, q.i, q.j, q.k, q.w]
}

/// An infrared image that is, or is not, a shading image.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct SnapshotBody {
    /// Under which its picture is had.
    pub index: u64,
    /// Its frame.
    pub frame_id: u64,
    /// Whether it is kept.
    pub accepted: bool,
    /// Why it is not: stable.
    pub code: Option<&'static str>,
    /// Why it is not, with figures.
    pub reason: Option<String>,
    /// What helps.
    pub advice: Option<&'static str>,
    /// Whether there is a picture.
    pub has_image: bool,
}

impl From<&LiveSnapshot> for SnapshotBody {
    fn from(snapshot: &LiveSnapshot) -> Self {
        SnapshotBody {
            index: snapshot.index,
            frame_id: snapshot.frame_id,
            accepted: snapshot.accepted,
            code: snapshot.code,
            reason: snapshot.reason.clone(),
            advice: snapshot.advice,
            has_image: snapshot.thumbnail.is_some(),
        }
    }
}

/// The shading images, and those that are none, newest last
#[utoipa::path(get, path = "/api/v1/scan/snapshots", responses(
    (status = 200, body = [SnapshotBody]),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn snapshots(State(app): State<Arc<App>>) -> Result<Json<Vec<SnapshotBody>>, Problem> {
    let scan = running(&app)?;
    let snapshots = scan.watch.live().snapshots().unwrap_or_default();
    Ok(Json(snapshots.iter().map(SnapshotBody::from).collect()))
}

/// The picture of a shading image: `{index}.png`
#[utoipa::path(get, path = "/api/v1/scan/snapshots/{picture}", params(("picture" = String, Path, description = "`{index}.png`")), responses(
    (status = 200, content_type = "image/png", body = Vec<u8>),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn snapshot_image(
    State(app): State<Arc<App>>,
    Path(picture): Path<String>,
) -> Result<Response, Problem> {
    let scan = running(&app)?;
    let index = picture.strip_suffix(".png");
    let index: Option<u64> = index.and_then(|index| index.parse().ok());
    let snapshots = scan.watch.live().snapshots().unwrap_or_default();
    let mut found = snapshots
        .iter()
        .filter(|snapshot| Some(snapshot.index) == index);
    let thumbnail = found.next().and_then(|found| found.thumbnail.clone());
    let thumbnail = thumbnail.ok_or_else(|| Problem::not_found("there is no such picture"))?;
    let png = aside(move || {
        let (width, height) = (thumbnail.width.into(), thumbnail.height.into());
        let image = Image::from_vec(width, height, thumbnail.pixels.clone());
        encode_png_grey8(&image).map_err(Problem::internal)
    });
    Ok(([(header::CONTENT_TYPE, "image/png")], png.await?).into_response())
}

#[cfg(test)]
mod tests {
    use super::*;
    use mcap_session::RecordingError;

    #[test]
    fn a_recording_that_finds_too_little_room_is_a_failure_of_the_storage() {
        let error = RecordingError::DiskFloor {
            folder: "sessions".into(),
            free_bytes: 1,
            floor_bytes: 2,
        };
        let error = StartError::Spawn(error.into());
        let unavailable = StatusCode::SERVICE_UNAVAILABLE;
        let expected = Problem::new(unavailable, "storage_failed", &error);
        assert_eq!(Problem::from(error), expected);
    }
}
