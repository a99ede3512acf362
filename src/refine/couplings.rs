//! Which displacements meet in the normal matrix: those of every edge of the mesh, and those of every two vertices that
//! stand for the same patch.

use super::patches::Patch;
use crate::geometry::{EdgeAdjacency, TriMesh};
use rayon::prelude::*;

/// The off-diagonal entries of the normal matrix and where each term finds its own.
#[derive(Clone, Debug)]
pub struct Couplings {
    /// Vertices of each entry, the smaller index first, sorted.
    pub pairs: Vec<[u32; 2]>,
    /// Entry of each edge of the mesh.
    pub of_edges: Vec<u32>,
    /// Entries of each face's sides from corner 0 to 1, 1 to 2 and 2 to 0.
    pub of_faces: Vec<[u32; 3]>,
    /// Entries of all pairs within each patch: second with first, third with first, third with second, …
    pub of_patches: Vec<Vec<u32>>,
}

impl Couplings {
    /// Finds the couplings of a mesh with edges and patches.
    pub fn new(mesh: &TriMesh, edges: &EdgeAdjacency, patches: &[Patch]) -> Couplings {
        let mut pairs = edges.edges.clone();
        pairs.extend(patches.iter().flat_map(pairs_of));
        pairs.par_sort_unstable();
        pairs.dedup();
        let find = |pair: &[u32; 2]| {
            pairs
                .binary_search(pair)
                .expect("every term's pair is there") as u32
        };
        let side = |face: &[u32; 3], corner: usize| {
            let (p, q) = (face[corner], face[(corner + 1) % 3]);
            find(&[p.min(q), p.max(q)])
        };
        let of_edges = edges.edges.par_iter().map(find).collect();
        let of_faces = mesh
            .faces
            .par_iter()
            .map(|face| std::array::from_fn(|corner| side(face, corner)))
            .collect();
        let of_patches = patches
            .par_iter()
            .map(|patch| pairs_of(patch).map(|pair| find(&pair)).collect())
            .collect();
        Couplings {
            pairs,
            of_edges,
            of_faces,
            of_patches,
        }
    }
}

/// All pairs of a patch's vertices, which are in ascending order.
fn pairs_of(patch: &Patch) -> impl Iterator<Item = [u32; 2]> {
    (1..patch.len())
        .flat_map(move |second| (0..second).map(move |first| [patch[first], patch[second]]))
}
