//! The variables in the address of a request.

use super::problem::Problem;
use axum::{
    extract::{self, FromRequestParts},
    http::request::Parts,
};
use serde::de::DeserializeOwned;

/// The variables of a route; at an address whose bytes are no UTF-8 there is nothing.
pub struct Path<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned + Send> FromRequestParts<S> for Path<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        match extract::Path::from_request_parts(parts, state).await {
            Ok(extract::Path(variables)) => Ok(Path(variables)),
            Err(rejection) => Err(Problem::not_found(rejection.body_text())),
        }
    }
}
