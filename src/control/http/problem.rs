//! What a client is told instead of an answer: a problem of RFC 9457 with a stable code.

use crate::{
    export::ExportError,
    jobs::{JobError, JobState},
    pipeline::CommandRefused,
};
use axum::{
    Json,
    extract::rejection::QueryRejection,
    http::{HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::Serialize;
use std::io;
use utoipa::ToSchema;

/// The body of every refusal, `application/problem+json`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, ToSchema)]
pub struct ProblemBody {
    /// `urn:relief:problem:` and the code.
    #[serde(rename = "type")]
    pub problem_type: String,
    /// The status in words.
    pub title: String,
    /// The HTTP status.
    pub status: u16,
    /// What happened, for the operator; may change.
    pub detail: String,
    /// What happened, for programs; stable.
    pub code: String,
}

/// Why a request is refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    status: StatusCode,
    code: &'static str,
    detail: String,
}

impl Problem {
    /// A refusal with a code that stays the same and a sentence that may change.
    pub fn new(status: StatusCode, code: &'static str, detail: impl ToString) -> Self {
        Problem {
            status,
            code,
            detail: detail.to_string(),
        }
    }

    /// There is no such thing.
    pub fn not_found(detail: impl ToString) -> Self {
        Self::new(StatusCode::NOT_FOUND, "not_found", detail)
    }

    /// What is asked for makes no sense now.
    pub fn conflict(code: &'static str, detail: impl ToString) -> Self {
        Self::new(StatusCode::CONFLICT, code, detail)
    }

    /// What is asked for makes no sense at all.
    pub fn bad_request(code: &'static str, detail: impl ToString) -> Self {
        Self::new(StatusCode::BAD_REQUEST, code, detail)
    }

    /// A fault of the program, which is logged here.
    pub fn internal(detail: impl ToString) -> Self {
        let problem = Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", detail);
        tracing::error!(detail = problem.detail, "a request failed");
        problem
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let body = ProblemBody {
            problem_type: format!("urn:relief:problem:{}", self.code),
            title: self.status.canonical_reason().unwrap_or("Error").to_owned(),
            status: self.status.as_u16(),
            detail: self.detail,
            code: self.code.to_owned(),
        };
        let mut response = (self.status, Json(body)).into_response();
        let headers = response.headers_mut();
        headers.insert(
            header::CONTENT_TYPE,
            HeaderValue::from_static("application/problem+json"),
        );
        if self.status == StatusCode::TOO_MANY_REQUESTS {
            headers.insert(header::RETRY_AFTER, HeaderValue::from_static("1"));
        }
        response
    }
}

impl From<CommandRefused> for Problem {
    fn from(refused: CommandRefused) -> Self {
        match refused {
            CommandRefused::BadUndo { .. } => Self::bad_request(refused.code(), refused),
            CommandRefused::Busy => {
                Self::new(StatusCode::TOO_MANY_REQUESTS, refused.code(), refused)
            }
            _ => Self::conflict(refused.code(), refused),
        }
    }
}

impl From<JobError> for Problem {
    fn from(error: JobError) -> Self {
        match error {
            JobError::Unknown(_) | JobError::NoScan { .. } => Self::not_found(error),
            JobError::NotRefinable { .. } => Self::conflict("not_refinable", error),
            JobError::Ended {
                state: JobState::Cancelled,
                ..
            } => Self::conflict("already_cancelled", error),
            JobError::Ended { .. } => Self::conflict("job_ended", error),
            JobError::Stopping => Self::conflict("draining", error),
            JobError::InUse(_) | JobError::Io { .. } => Self::from_storage(error),
        }
    }
}

impl From<ExportError> for Problem {
    fn from(error: ExportError) -> Self {
        Self::from_storage(error)
    }
}

impl From<io::Error> for Problem {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::NotFound => Self::not_found("there is no such file"),
            _ => Self::from_storage(error),
        }
    }
}

impl From<QueryRejection> for Problem {
    fn from(rejection: QueryRejection) -> Self {
        Self::bad_request("bad_query", rejection.body_text())
    }
}

impl Problem {
    fn from_storage(error: impl ToString) -> Self {
        let problem = Self::new(StatusCode::INTERNAL_SERVER_ERROR, "storage_failed", error);
        tracing::error!(detail = problem.detail, "a request failed");
        problem
    }
}
