//! Bodies of requests: small JSON objects, checked before they are looked at.

use super::problem::Problem;
use axum::{
    body::{Body, to_bytes},
    extract::{FromRequest, Request},
    http::StatusCode,
};
use serde::de::DeserializeOwned;

/// Longest body of a request, bytes.
pub const MAX_BODY_BYTES: usize = 64 * 1024;

/// A JSON object as a body; an empty body stands for the default, as `null` does.
pub struct JsonBody<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned + Default> FromRequest<S> for JsonBody<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, _state: &S) -> Result<Self, Problem> {
        let bytes = read(request.into_body()).await?;
        if bytes.is_empty() {
            return Ok(JsonBody(T::default()));
        }
        // What is read as an object would also be read as the list of its values.
        if bytes.trim_ascii_start().starts_with(b"[") {
            let detail = "the body is an array, must be an object or null";
            return Err(Problem::bad_request("bad_body", detail));
        }
        serde_json::from_slice::<Option<T>>(&bytes)
            .map(|body| JsonBody(body.unwrap_or_default()))
            .map_err(|error| Problem::bad_request("bad_body", error))
    }
}

async fn read(body: Body) -> Result<Vec<u8>, Problem> {
    match to_bytes(body, MAX_BODY_BYTES).await {
        Ok(bytes) => Ok(bytes.into()),
        Err(_) => Err(too_long()),
    }
}

/// The refusal of a body beyond [`MAX_BODY_BYTES`].
pub fn too_long() -> Problem {
    Problem::new(
        StatusCode::PAYLOAD_TOO_LARGE,
        "body_too_long",
        format!("the body must be whole and at most {MAX_BODY_BYTES} bytes long"),
    )
}
