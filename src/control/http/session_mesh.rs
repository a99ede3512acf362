//! Meshes of finished scans, by what they hold: an address never changes its content, so that browsers keep them.

use super::{
    App, aside,
    mesh_format::encode_tri_mesh,
    path::Path,
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
    lock::lock,
    pipeline::{BASE_PLY, REFINED_PLY, idle_pool},
};
use axum::{
    body::Bytes,
    extract::{Query, State, rejection::QueryRejection},
    http::{HeaderMap, StatusCode, header},
    response::{IntoResponse, Response},
};
use rayon::prelude::*;
use serde::Deserialize;
use sha2::{Digest, Sha256};
use std::{
    collections::VecDeque,
    fs,
    num::NonZeroUsize,
    sync::{Arc, Mutex, MutexGuard},
    time::SystemTime,
};
use tokio::sync::Mutex as AsyncMutex;
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
pub struct HeldMeshes {
    newest: Mutex<VecDeque<Held>>,
    /// Held while a mesh is made, which takes all processors and much memory.
    making: Arc<AsyncMutex<()>>,
}

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
    /// The hash of a mesh that is held from here on: made once however many ask, and no two at a time.
    async fn find_or_make(
        self: Arc<Self>,
        source: Source,
        make: impl FnOnce(&Source) -> Result<Vec<u8>, Problem> + Send + 'static,
    ) -> Result<String, Problem> {
        if let Some(held) = self.find(|held| held.source == source) {
            return Ok(held.hash);
        }
        let making = self.making.clone().lock_owned().await;
        // Whoever held the lock may have made it.
        if let Some(held) = self.find(|held| held.source == source) {
            return Ok(held.hash);
        }
        aside(move || {
            // To its end, also for a client that does not wait for it.
            let _making = making;
            let bytes = Bytes::from(make(&source)?);
            let digest = Sha256::digest(&bytes);
            let hash: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
            self.keep(Held {
                source,
                hash: hash.clone(),
                bytes,
            });
            Ok(hash)
        })
        .await
    }

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
        lock(&self.newest)
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
    let looked = app.clone();
    let source = aside(move || Source::of(&looked.supervisor.data, id, which)).await?;
    let meshes = app.held_meshes.clone();
    let made = meshes.find_or_make(source, move |source| {
        let supervisor = &app.supervisor;
        let n_threads = supervisor.settings.n_threads();
        beside_a_scan(n_threads, || make(&supervisor.data, source))
    });
    let hash = made.await?;
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

impl Source {
    /// What the files of a scan's mesh hold now.
    fn of(data: &DataFolder, id: SessionId, which: Which) -> Result<Self, Problem> {
        let mut modified = Vec::new();
        for name in which.files() {
            let (_, path) = sessions::file(data, &id, name)?;
            modified.push(fs::metadata(path)?.modified()?);
        }
        Ok(Source {
            id,
            which,
            modified,
        })
    }
}

impl Which {
    fn files(self) -> &'static [&'static str] {
        match self {
            Which::Base => &[BASE_PLY],
            Which::Refined => &[REFINED_PLY],
            Which::Difference => &[REFINED_PLY, BASE_PLY],
        }
    }
}

/// Makes something that a scan is not to wait for, on threads of the idle class, which end with it: there is no way back out of it.
fn beside_a_scan<T: Send>(
    n_threads: NonZeroUsize,
    make: impl FnOnce() -> Result<T, Problem> + Send,
) -> Result<T, Problem> {
    let pool = idle_pool("meshes", n_threads).map_err(Problem::internal)?;
    pool.install(make)
}

fn make(data: &DataFolder, source: &Source) -> Result<Vec<u8>, Problem> {
    let mut meshes = Vec::new();
    for name in source.which.files() {
        let (_, path) = sessions::file(data, &source.id, name)?;
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
    use std::sync::atomic::{AtomicUsize, Ordering};
    use tokio::runtime;

    #[test]
    fn a_mesh_is_made_once_however_many_ask() {
        let meshes = Arc::new(HeldMeshes::default());
        let n_made = Arc::new(AtomicUsize::new(0));
        let source = Source {
            id: SessionId::generate(),
            which: Which::Base,
            modified: Vec::new(),
        };
        let ask = || {
            let n_made = n_made.clone();
            meshes.clone().find_or_make(source.clone(), move |_| {
                n_made.fetch_add(1, Ordering::Relaxed);
                Ok(vec![1, 2, 3])
            })
        };
        let runtime = runtime::Builder::new_current_thread().build().unwrap();
        let hashes = runtime.block_on(async { tokio::join!(ask(), ask(), ask()) });
        assert!(hashes.0.is_ok());
        assert_eq!((&hashes.0, &hashes.0), (&hashes.1, &hashes.2));
        assert_eq!(n_made.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn a_mesh_is_made_in_the_idle_class() {
        /// `SCHED_IDLE`, sched(7).
        const IDLE: &str = "5";
        // The 41st field, proc_pid_stat(5), of which the name is the second.
        let policy = beside_a_scan(NonZeroUsize::MIN, || {
            let stat = fs::read_to_string("/proc/thread-self/stat")?;
            let (_, after_name) = stat.rsplit_once(") ").unwrap();
            Ok(after_name.split(' ').nth(38).unwrap().to_owned())
        });
        assert_eq!(policy.unwrap(), IDLE);
    }

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
