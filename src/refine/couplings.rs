//! Which displacements meet in the normal matrix: those of every edge of the mesh, and those of every two vertices that
//! stand for the same patch.

use super::patches::Patch;
use crate::geometry::{EdgeAdjacency, Lists, TriMesh};
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
    /// What meets in each vertex.
    pub corners: VertexCorners,
}

/// The corners of faces that meet in each vertex: three times the face, and the corner, in rising order.
#[derive(Clone, Debug)]
pub struct VertexCorners(Lists);

impl VertexCorners {
    fn new(mesh: &TriMesh) -> VertexCorners {
        let vertices = mesh.faces.as_flattened().iter().zip(0..);
        let corners = vertices.map(|(&vertex, corner)| [vertex, corner]);
        VertexCorners(Lists::new(mesh.vertices.len(), corners))
    }

    /// Face and corner of those at a vertex, in rising order.
    #[inline]
    pub fn of(&self, vertex: usize) -> impl Iterator<Item = [usize; 2]> {
        let corners = self.0.of(vertex).iter();
        corners.map(|&corner| [corner as usize / 3, corner as usize % 3])
    }
}

impl Couplings {
    /// Finds the couplings of a mesh with edges and patches.
    pub fn new(mesh: &TriMesh, edges: &EdgeAdjacency, patches: &[Patch]) -> Couplings {
        let mut pairs = edges.edges.clone();
        pairs.extend(patches.iter().flat_map(pairs_of));
        // Those of the edges are in order, which a merge sort finds.
        pairs.sort();
        pairs.dedup();
        let seconds = Lists::new(mesh.vertices.len(), pairs.iter().copied());
        let find = |&[first, second]: &[u32; 2]| {
            let found = seconds.of(first as usize).binary_search(&second);
            (seconds.start(first as usize) + found.expect("every term's pair is there")) as u32
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
            corners: VertexCorners::new(mesh),
        }
    }
}

/// All pairs of a patch's vertices, which are in ascending order.
fn pairs_of(patch: &Patch) -> impl Iterator<Item = [u32; 2]> {
    (1..patch.len())
        .flat_map(move |second| (0..second).map(move |first| [patch[first], patch[second]]))
}
