//! The operator's side of a running pipeline: signals in, progress out, and the daemon with its page and API.
//!
//! tokio lives here. Handlers look at the pipeline through a [`Watch`](crate::pipeline::Watch) and return at once; the
//! pipeline's own threads never wait for them. Terms: a *scan* is one run of the pipeline, a *session* is what it leaves
//! behind in the data directory, a *job* is the refinement of a session by another process.
//!
//! Routes; every one is described in `/api/v1/openapi.json`, and in `docs/api.md` with examples. Refusals are
//! `application/problem+json` with a stable `code`.
//!
//! | route | effect |
//! |---|---|
//! | `GET /`, `/assets/{name}` | the page, part of the program |
//! | `GET /healthz`, `/readyz`, `/metrics` | for supervisors: the process answers; a scan could start; Prometheus |
//! | `GET /api/v1/status`, `/devices` | what the daemon is doing, what it may scan with |
//! | `GET /api/v1/events` | events, numbered, as server-sent events |
//! | `GET /api/v1/ws` | WebSocket: status and previews, newest only |
//! | `POST /api/v1/scan` | starts a scan |
//! | `POST /api/v1/scan/{pause, resume, snapshot, undo, refine, reset, finish, abandon}` | asks it for something, done between two frames |
//! | `GET /api/v1/scan/{mesh, path, snapshots, snapshots/N.png}` | what is seen of it |
//! | `GET /api/v1/sessions`, `/sessions/{id}`, `/sessions/{id}/files/{name}` | what scans left behind |
//! | `DELETE /api/v1/sessions/{id}` | removes one |
//! | `POST /api/v1/sessions/{id}/refine` | asks for its refinement |
//! | `GET /api/v1/sessions/{id}/mesh`, `/meshes/{sha256}` | its meshes, by content |
//! | `GET /api/v1/jobs`, `POST /api/v1/jobs/{id}/cancel` | refinements |
//! | `GET /api/v1/config`, `POST /api/v1/config/reload` | the configuration in force, read anew |
//!
//! Not handled: users and rights; who reaches the socket, with the token where one is asked for, is the operator.

mod operate;
mod progress;
mod progress_lines;
mod signals;
mod stderr;

mod daemon;
mod supervisor;

mod camera_source;
mod data_folder;
mod events;
mod interim;
mod observer;
mod refined_error;
mod scan_record;
mod sessions;
mod settings;
mod status_body;

mod http;
mod listen;
mod systemd;
mod tls;
mod token;
mod watchdog;

pub use camera_source::CameraSource;
pub use daemon::{DaemonError, DaemonSetup, run as run_daemon};
pub use data_folder::DataFolder;
pub use http::Wish;
pub use listen::ListenError;
pub use operate::{ControlError, operate, until_stopped};
pub use progress::{Progress, ProgressStyle};
pub use settings::{SettingsPlaces, all_processors, params_of_run};
pub use signals::EXIT_INTERRUPTED;
pub use stderr::Stderr;
pub use token::TokenError;
