//! The HTTP side of the daemon: routes to handlers, and what they share.

mod accept;
mod body;
mod guard;
mod path;
mod problem;
mod write_timeout;

mod events;
mod jobs;
mod live_mesh;
mod mesh_format;
mod metrics;
mod operations;
mod page;
mod scan;
mod session_mesh;
mod sessions;
mod socket;

pub use accept::Acceptor;
pub use guard::Access;
pub use socket::Wish;

use super::supervisor::Supervisor;
use axum::{
    Json, Router,
    http::{StatusCode, header},
    middleware,
    response::{IntoResponse, Response},
    routing::get,
};
use guard::Ration;
use live_mesh::LiveMeshes;
use problem::Problem;
use session_mesh::HeldMeshes;
use std::sync::Arc;
use tokio::sync::Semaphore;
use utoipa::OpenApi;
use utoipa_axum::{router::OpenApiRouter, routes};

/// WebSockets at a time.
const MAX_SOCKETS: usize = 8;

/// Streams of events at a time.
const MAX_STREAMS: usize = 16;

/// What all handlers share.
pub struct App {
    /// The daemon's centre.
    pub supervisor: Arc<Supervisor>,
    access: Access,
    ration: Ration,
    sockets: Arc<Semaphore>,
    streams: Arc<Semaphore>,
    live_meshes: LiveMeshes,
    held_meshes: Arc<HeldMeshes>,
}

impl App {
    /// Handlers for a daemon.
    pub fn new(supervisor: Arc<Supervisor>, access: Access) -> Self {
        App {
            supervisor,
            access,
            ration: Ration::default(),
            sockets: Arc::new(Semaphore::new(MAX_SOCKETS)),
            streams: Arc::new(Semaphore::new(MAX_STREAMS)),
            live_meshes: LiveMeshes::default(),
            held_meshes: Arc::default(),
        }
    }

    /// How many sockets and streams of events are open.
    pub fn n_clients(&self) -> usize {
        MAX_SOCKETS + MAX_STREAMS
            - self.sockets.available_permits()
            - self.streams.available_permits()
    }
}

#[derive(OpenApi)]
#[openapi(info(
    title = "Relief",
    description = "The daemon beside a depth camera: scans, what is seen of them, and their refinement. \
                   Refusals are `application/problem+json` with a stable `code`.",
    license(name = "MIT OR Apache-2.0", identifier = "MIT OR Apache-2.0")
))]
struct Document;

/// All routes, behind the guard.
pub fn router(app: Arc<App>) -> Router {
    let (router, document) = api().split_for_parts();
    let document: Arc<str> = document.to_json().unwrap_or_default().into();
    router
        .route("/", get(page::index))
        .route("/assets/{name}", get(page::asset))
        .route(
            "/api/v1/openapi.json",
            get(move || async move {
                let kind = [(header::CONTENT_TYPE, "application/json")];
                (kind, document.to_string()).into_response()
            }),
        )
        .fallback(no_route)
        .method_not_allowed_fallback(wrong_method)
        .layer(middleware::from_fn_with_state(app.clone(), guard::guard))
        .with_state(app)
}

fn api() -> OpenApiRouter<Arc<App>> {
    OpenApiRouter::with_openapi(Document::openapi())
        .routes(routes!(operations::healthz))
        .routes(routes!(operations::readyz))
        .routes(routes!(operations::metrics))
        .routes(routes!(operations::status))
        .routes(routes!(operations::devices))
        .routes(routes!(operations::config))
        .routes(routes!(operations::reload))
        .routes(routes!(events::events))
        .routes(routes!(socket::socket))
        .routes(routes!(scan::start))
        .routes(routes!(scan::pause))
        .routes(routes!(scan::resume))
        .routes(routes!(scan::snapshot))
        .routes(routes!(scan::undo))
        .routes(routes!(scan::refine))
        .routes(routes!(scan::reset))
        .routes(routes!(scan::finish))
        .routes(routes!(scan::abandon))
        .routes(routes!(scan::path))
        .routes(routes!(scan::snapshots))
        .routes(routes!(scan::snapshot_image))
        .routes(routes!(live_mesh::mesh))
        .routes(routes!(sessions::list))
        .routes(routes!(sessions::read, sessions::remove))
        .routes(routes!(sessions::file))
        .routes(routes!(sessions::refine))
        .routes(routes!(session_mesh::mesh))
        .routes(routes!(session_mesh::by_hash))
        .routes(routes!(jobs::list))
        .routes(routes!(jobs::cancel))
}

async fn no_route() -> Problem {
    Problem::not_found("there is nothing at this address")
}

async fn wrong_method() -> Problem {
    Problem::new(
        StatusCode::METHOD_NOT_ALLOWED,
        "method_not_allowed",
        "this address does not do that",
    )
}

/// Does what waits for disk or processor aside, so that nobody else has to wait.
async fn aside<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Problem> + Send + 'static,
) -> Result<T, Problem> {
    tokio::task::spawn_blocking(work)
        .await
        .unwrap_or_else(|error| Err(Problem::internal(error)))
}

/// What was asked for is on its way.
fn accepted() -> Response {
    (StatusCode::ACCEPTED, Json(serde_json::json!({}))).into_response()
}
