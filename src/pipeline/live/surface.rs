//! The surface for whoever looks on: patches of the live mesh sewn together, with normals and coverage.
//!
//! A thread of its own makes it, of what the fusion thread hands over between frames: capture does not wait for it. It takes a
//! quarter of a core at most, and only turns that nobody else wants.

use super::{LiveSurface, Slot};
use crate::{
    fusion::{LatticeEdge, SurfacePatch},
    geometry::TriMesh,
    pipeline::status::{MeshStatus, StatusSlot, StopToken},
    snapshot::Coverage,
};
use crossbeam::channel::Receiver;
use nalgebra::Vector3;
use std::{
    collections::HashMap,
    thread,
    time::{Duration, Instant},
};

/// Faces beyond these are left out: a browser shows no more, and memory stays bounded.
const MAX_FACES: usize = 1_500_000;
/// Time at rest for each second of work, and how long that may be at most.
const REST_SHARE: u32 = 3;
const MAX_REST: Duration = Duration::from_secs(2);
/// How often a thread at rest looks whether capture has ended.
const LOOK: Duration = Duration::from_millis(20);

/// What has changed of the surface since the last update.
#[derive(Clone, Debug, Default)]
pub struct SurfaceUpdate {
    /// Whether the patches so far are of another model.
    pub is_anew: bool,
    /// How many patches there are.
    pub n_patches: usize,
    /// Those that have changed, by number.
    pub changed: Vec<(u32, SurfacePatch)>,
    /// What the shading images so far tell.
    pub coverage: Coverage,
}

/// Makes surfaces of updates until there are no more; rests no longer once capture is to `end`.
pub fn run(
    updates: &Receiver<SurfaceUpdate>,
    slot: &Slot<LiveSurface>,
    status: &StatusSlot,
    end: &StopToken,
) {
    // Tracking waits in every frame for all of its threads, and would for one that shares a processor with this work.
    if let Err(error) = idle_class::enter() {
        tracing::debug!(%error, "the surface is not sewn in the idle class");
    }
    let mut sewing = Sewing::default();
    for update in updates {
        let start = Instant::now();
        let surface = sewing.take(update);
        let mesh = MeshStatus {
            revision: surface.revision,
            vertices: surface.positions.len(),
            faces: surface.faces.len(),
        };
        status.update(|status| status.mesh = Some(mesh));
        slot.write(Some(surface));
        rest((start.elapsed() * REST_SHARE).min(MAX_REST), end);
    }
}

fn rest(duration: Duration, end: &StopToken) {
    let start = Instant::now();
    while start.elapsed() < duration && !end.is_stopped() {
        thread::sleep(LOOK.min(duration));
    }
}

/// The patches in hand.
#[derive(Debug, Default)]
struct Sewing {
    patches: Vec<SurfacePatch>,
    revision: u32,
}

impl Sewing {
    fn take(&mut self, update: SurfaceUpdate) -> LiveSurface {
        if update.is_anew {
            self.patches.clear();
        }
        self.patches
            .resize(update.n_patches, SurfacePatch::default());
        for (number, patch) in update.changed {
            if let Some(place) = self.patches.get_mut(number as usize) {
                *place = patch;
            }
        }
        self.revision += 1;
        dressed(&self.sewn(), &update.coverage, self.revision)
    }

    /// One mesh, in which the patches share the vertices on their rims: those of two patches on one edge become one, though
    /// frames may have moved it between their extractions.
    fn sewn(&self) -> TriMesh {
        let mut mesh = TriMesh::default();
        let mut number_of: HashMap<LatticeEdge, u32> = HashMap::new();
        let mut numbers = Vec::new();
        for SurfacePatch { mesh: patch, rim } in &self.patches {
            if mesh.faces.len() + patch.faces.len() > MAX_FACES {
                break;
            }
            numbers.clear();
            let mut rim = rim.iter().peekable();
            for (index, vertex) in patch.vertices.iter().enumerate() {
                let next = mesh.vertices.len() as u32;
                let on_rim = rim.next_if(|(vertex, _)| *vertex as usize == index);
                let number =
                    on_rim.map_or(next, |(_, edge)| *number_of.entry(*edge).or_insert(next));
                if number == next {
                    mesh.vertices.push(*vertex);
                }
                numbers.push(number);
            }
            let faces = patch.faces.iter();
            mesh.faces
                .extend(faces.map(|face| face.map(|vertex| numbers[vertex as usize])));
        }
        mesh
    }
}

fn dressed(mesh: &TriMesh, coverage: &Coverage, revision: u32) -> LiveSurface {
    let normals = mesh.vertex_normals();
    let pairs = mesh.vertices.iter().zip(&normals);
    let covered = pairs.map(|(vertex, normal)| {
        let share = coverage.share(vertex, normal);
        (255.0 * share).round() as u8
    });
    LiveSurface {
        revision,
        coverage: covered.collect(),
        positions: mesh
            .vertices
            .iter()
            .map(|v| v.coords.cast().into())
            .collect(),
        normals: normals.iter().map(small).collect(),
        faces: mesh.faces.clone(),
    }
}

fn small(normal: &Vector3<f64>) -> [i8; 3] {
    normal.map(|x| (127.0 * x).round() as i8).into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    /// A square of two faces at this x, one metre wide, facing towards −z; its sides at either end are rims.
    fn square(x: i32) -> SurfacePatch {
        let corner = |u: i32, v: i32| Point3::new(f64::from(x + u), f64::from(v), 0.5);
        let edge = |u: i32, v: i32| LatticeEdge::of_voxel([x + u, v, 0], 2);
        let corners = [[0, 0], [0, 1], [1, 1], [1, 0]];
        SurfacePatch {
            mesh: TriMesh {
                vertices: corners.map(|[u, v]| corner(u, v)).to_vec(),
                faces: vec![[0, 1, 2], [0, 2, 3]],
            },
            rim: (0..).zip(corners.map(|[u, v]| edge(u, v))).collect(),
        }
    }

    #[test]
    fn patches_are_sewn_and_only_the_changed_ones_replaced() {
        let mut sewing = Sewing::default();
        let update = SurfaceUpdate {
            n_patches: 2,
            changed: vec![(0, square(0)), (1, square(1))],
            ..SurfaceUpdate::default()
        };
        let both = sewing.take(update);
        assert_eq!((both.positions.len(), both.faces.len()), (6, 4));
        assert_eq!(both.normals, [[0, 0, -127]; 6]);
        assert_eq!((both.revision, both.coverage), (1, vec![0; 6]));
        let apart = sewing.take(SurfaceUpdate {
            n_patches: 2,
            changed: vec![(1, square(3))],
            ..SurfaceUpdate::default()
        });
        assert_eq!((apart.positions.len(), apart.revision), (8, 2));
        let anew = sewing.take(SurfaceUpdate {
            is_anew: true,
            n_patches: 1,
            ..SurfaceUpdate::default()
        });
        assert!(anew.faces.is_empty());
    }

    #[test]
    fn patches_of_different_times_leave_no_seam_open() {
        let mut later = square(1);
        for vertex in &mut later.mesh.vertices {
            vertex.z += 0.001;
        }
        let mut inner = square(0);
        inner.rim.retain(|(vertex, _)| *vertex >= 2);
        let mut sewing = Sewing::default();
        let surface = sewing.take(SurfaceUpdate {
            n_patches: 2,
            changed: vec![(0, inner), (1, later)],
            ..SurfaceUpdate::default()
        });
        assert_eq!(surface.faces, [[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]]);
        let depths: Vec<f32> = surface.positions.iter().map(|place| place[2]).collect();
        assert_eq!(depths, [0.5, 0.5, 0.5, 0.5, 0.501, 0.501]);
    }
}
