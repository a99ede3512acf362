//! The growing mesh of the scan that goes on.

use super::{
    App, aside,
    mesh_format::MeshParts,
    problem::{Problem, ProblemBody},
    scan,
};
use crate::{
    geometry::{Clustering, cluster_vertices},
    pipeline::LiveSurface,
};
use axum::{
    body::Bytes,
    extract::{Query, State, rejection::QueryRejection},
    http::{HeaderMap, HeaderName, StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::Deserialize;
use std::sync::Arc;
use tokio::sync::Mutex;
use utoipa::{IntoParams, ToSchema};

/// Faces of a preview at most: what a phone turns round smoothly.
const PREVIEW_FACES: usize = 60_000;

const REVISION: HeaderName = HeaderName::from_static("x-mesh-revision");

/// How much of the mesh is wanted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum LevelOfDetail {
    /// All of it.
    #[default]
    Full,
    /// At most 60 000 faces.
    Preview,
}

/// What of the mesh is wanted.
#[derive(Clone, Copy, Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct MeshQuery {
    /// How much of it: `full` or `preview`.
    #[serde(default)]
    #[param(inline)]
    lod: LevelOfDetail,
}

/// The newest mesh in bytes, for each level of detail: made once however many ask.
#[derive(Debug, Default)]
pub struct LiveMeshes {
    full: Mutex<Option<(String, Bytes)>>,
    preview: Mutex<Option<(String, Bytes)>>,
}

/// The mesh so far, in the layout of `docs/api.md`; its last part is the coverage of each vertex
#[utoipa::path(get, path = "/api/v1/scan/mesh", params(MeshQuery), responses(
    (status = 200, content_type = "application/octet-stream", body = Vec<u8>),
    (status = 304, description = "it is still the one that the client has"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn mesh(
    State(app): State<Arc<App>>,
    query: Result<Query<MeshQuery>, QueryRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let lod = query?.lod;
    let scan = scan::running(&app)?;
    let surface = scan.watch.live().surface();
    let surface = surface.ok_or_else(|| {
        let detail = "there is no mesh yet; one is made while somebody asks";
        Problem::new(StatusCode::NOT_FOUND, "no_mesh", detail)
    })?;
    let revision = surface.revision;
    let (held, suffix) = match lod {
        LevelOfDetail::Full => (&app.live_meshes.full, 'f'),
        LevelOfDetail::Preview => (&app.live_meshes.preview, 'p'),
    };
    let tag = format!("\"{}-{revision}-{suffix}\"", scan.record.id);
    let caching = [
        (header::ETAG, tag.clone()),
        (header::CACHE_CONTROL, "no-cache".to_owned()),
        (REVISION, revision.to_string()),
    ];
    let known = headers.get(header::IF_NONE_MATCH);
    if known.is_some_and(|known| known.as_bytes() == tag.as_bytes()) {
        return Ok((StatusCode::NOT_MODIFIED, caching).into_response());
    }
    let mut held = held.lock().await;
    let bytes = match &*held {
        Some((of, bytes)) if *of == tag => bytes.clone(),
        _ => {
            let bytes = aside(move || Ok(Bytes::from(encode(&surface, lod)))).await?;
            *held = Some((tag, bytes.clone()));
            bytes
        }
    };
    drop(held);
    let kind = [(header::CONTENT_TYPE, "application/octet-stream")];
    Ok((caching, kind, bytes).into_response())
}

fn encode(surface: &LiveSurface, lod: LevelOfDetail) -> Vec<u8> {
    match lod {
        LevelOfDetail::Full => MeshParts {
            revision: surface.revision,
            positions: &surface.positions,
            normals: &surface.normals,
            amounts: &surface.coverage,
            faces: &surface.faces,
        }
        .encode(),
        LevelOfDetail::Preview => {
            let coarse = cluster_vertices(&surface.positions, &surface.faces, PREVIEW_FACES);
            encode_coarse(surface, &coarse)
        }
    }
}

fn encode_coarse(surface: &LiveSurface, coarse: &Clustering) -> Vec<u8> {
    let kept = || coarse.kept.iter().map(|&vertex| vertex as usize);
    let positions: Vec<_> = kept().map(|vertex| surface.positions[vertex]).collect();
    let normals: Vec<_> = kept().map(|vertex| surface.normals[vertex]).collect();
    let amounts: Vec<_> = kept().map(|vertex| surface.coverage[vertex]).collect();
    MeshParts {
        revision: surface.revision,
        positions: &positions,
        normals: &normals,
        amounts: &amounts,
        faces: &coarse.faces,
    }
    .encode()
}
