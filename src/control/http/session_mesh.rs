//! Meshes of finished scans, by what they hold: an address never changes its content, so that browsers keep them.

use super::{
    App, aside,
    mesh_format::encode_tri_mesh,
    problem::{Problem, ProblemBody},
    sessions::session_id,
};
use crate::{
    control::{
        data_folder::{DataFolder, SessionId},
        sessions,
    },
    export::read_ply,
    geometry::{TriMesh, TriangleBvh},
};
use axum::{
    body::Bytes,
    extract::{Path, Query, State, rejection::QueryRejection},
    http::{HeaderMap, StatusCode, header},
    response::{IntoResponse, Response},
};
use rayon::prelude::*;
use serde::Deserialize;
use sha2::{Digest, Sha256};
use std::{
    collections::VecDeque,
    fs,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::SystemTime,
};
use utoipa::{IntoParams, ToSchema};

/// Meshes that are held at most; three belong to a scan.
const HELD: usize = 6;

/// A difference of so many millimetres or more is shown as the largest.
const LARGEST_MM: f64 = 2.0;

/// Beyond this the refined surface has nothing to do with the base, metres.
const FARTHEST_M: f64 = 0.02;

/// Which mesh of a scan.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Which {
    /// The fused one.
    Base,
    /// The refined one.
    #[default]
    Refined,
    /// The refined one, with how far each vertex lies before the fused one: 128 + millimetres / 2 · 127.
    Difference,
}

/// Which mesh is wanted.
#[derive(Clone, Copy, Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct WhichQuery {
    /// `base`, `refined` or `difference`.
    #[serde(default)]
    #[param(inline)]
    which: Which,
}

/// The newest meshes that were asked for, in bytes.
#[derive(Debug, Default)]
pub struct HeldMeshes(Mutex<VecDeque<Held>>);

#[derive(Clone, Debug)]
struct Held {
    source: Source,
    hash: String,
    bytes: Bytes,
}

/// What a mesh was made from.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Source {
    id: SessionId,
    which: Which,
    modified: Vec<SystemTime>,
}

impl HeldMeshes {
    fn find(&self, is_it: impl Fn(&Held) -> bool) -> Option<Held> {
        self.held().iter().find(|held| is_it(held)).cloned()
    }

    fn keep(&self, mesh: Held) {
        let mut held = self.held();
        held.retain(|old| old.source != mesh.source);
        held.truncate(HELD - 1);
        held.push_front(mesh);
    }

    fn held(&self) -> MutexGuard<'_, VecDeque<Held>> {
        // Meshes are put whole: what a panic left behind is as good as any.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A mesh of a scan that has ended: leads to its address by content
#[utoipa::path(get, path = "/api/v1/sessions/{id}/mesh", params(("id" = String, Path), WhichQuery), responses(
    (status = 302, description = "to `/api/v1/meshes/{sha256}`"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn mesh(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    query: Result<Query<WhichQuery>, QueryRejection>,
) -> Result<Response, Problem> {
    let (id, which) = (session_id(&id)?, query?.which);
    let hash = aside(move || find_or_make(&app, id, which)).await?;
    let location = [
        (header::LOCATION, format!("/api/v1/meshes/{hash}")),
        (header::CACHE_CONTROL, "no-cache".to_owned()),
    ];
    Ok((StatusCode::FOUND, location).into_response())
}

/// A mesh by the SHA-256 of its bytes, in the layout of `docs/api.md`; ask the scan again for one that is not held any more
#[utoipa::path(get, path = "/api/v1/meshes/{sha256}", params(("sha256" = String, Path)), responses(
    (status = 200, content_type = "application/octet-stream", body = Vec<u8>),
    (status = 304, description = "it never changes"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn by_hash(
    State(app): State<Arc<App>>,
    Path(hash): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let held = app.held_meshes.find(|held| held.hash == hash);
    let held = held.ok_or_else(|| {
        let detail = "no such mesh is held; ask the scan for its mesh again";
        Problem::new(StatusCode::NOT_FOUND, "mesh_not_held", detail)
    })?;
    let tag = format!("\"{hash}\"");
    let known = headers.get(header::IF_NONE_MATCH);
    let is_known = known.is_some_and(|known| known.as_bytes() == tag.as_bytes());
    let caching = [
        (header::ETAG, tag),
        (
            header::CACHE_CONTROL,
            "private, max-age=31536000, immutable".to_owned(),
        ),
    ];
    let kind = [(header::CONTENT_TYPE, "application/octet-stream")];
    Ok(match is_known {
        true => (StatusCode::NOT_MODIFIED, caching).into_response(),
        false => (caching, kind, held.bytes).into_response(),
    })
}

/// The hash of a mesh that is held from here on.
fn find_or_make(app: &App, id: SessionId, which: Which) -> Result<String, Problem> {
    let data = &app.supervisor.data;
    let mut modified = Vec::new();
    for name in which.files() {
        let (_, path) = sessions::file(data, &id, name)?;
        modified.push(fs::metadata(path)?.modified()?);
    }
    let source = Source {
        id,
        which,
        modified,
    };
    if let Some(held) = app.held_meshes.find(|held| held.source == source) {
        return Ok(held.hash);
    }
    let bytes = Bytes::from(make(data, &source.id, which)?);
    let digest = Sha256::digest(&bytes);
    let hash: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
    app.held_meshes.keep(Held {
        source,
        hash: hash.clone(),
        bytes,
    });
    Ok(hash)
}

impl Which {
    fn files(self) -> &'static [&'static str] {
        match self {
            Which::Base => &["base.ply"],
            Which::Refined => &["refined.ply"],
            Which::Difference => &["refined.ply", "base.ply"],
        }
    }
}

fn make(data: &DataFolder, id: &SessionId, which: Which) -> Result<Vec<u8>, Problem> {
    let mut meshes = Vec::new();
    for name in which.files() {
        let (_, path) = sessions::file(data, id, name)?;
        meshes.push(read_ply(&path)?);
    }
    Ok(match &meshes[..] {
        [refined, base] => encode_tri_mesh(refined, &differences(refined, base)),
        [mesh, ..] => encode_tri_mesh(mesh, &vec![u8::MAX; mesh.vertices.len()]),
        [] => return Err(Problem::internal("no file makes no mesh")),
    })
}

/// How far each vertex of a mesh lies before another surface, along that surface's normal: 128 is none, or nothing near.
fn differences(mesh: &TriMesh, surface: &TriMesh) -> Vec<u8> {
    let bvh = TriangleBvh::new(surface);
    let difference_mm = |vertex| {
        let closest = bvh.closest_point(vertex, FARTHEST_M)?;
        let offset = vertex - closest.point;
        let side = offset.dot(&surface.face_normal(closest.face)).signum();
        Some(1e3 * side * closest.distance)
    };
    mesh.vertices
        .par_iter()
        .map(|vertex| encode_mm(difference_mm(vertex).unwrap_or(0.0)))
        .collect()
}

fn encode_mm(difference_mm: f64) -> u8 {
    let share = (difference_mm / LARGEST_MM).clamp(-1.0, 1.0);
    (128.0 + 127.0 * share).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    fn square_at(z: f64) -> TriMesh {
        TriMesh {
            vertices: vec![
                Point3::new(0.0, 0.0, z),
                Point3::new(1.0, 0.0, z),
                Point3::new(0.0, 1.0, z),
                Point3::new(1.0, 1.0, z),
            ],
            faces: vec![[0, 1, 2], [1, 3, 2]],
        }
    }

    #[test]
    fn differences_have_sign_scale_and_ends() {
        let base = square_at(0.0);
        // Normals of the base point along +z.
        for (mm, byte) in [
            (0.0, 128),
            (1.0, 192),
            (-1.0, 65),
            (2.0, 255),
            (-5.0, 1),
            (100.0, 128),
        ] {
            assert_eq!(
                differences(&square_at(1e-3 * mm), &base),
                [byte; 4],
                "{mm} mm"
            );
        }
    }
}
