//! A triangle mesh that can be edited: faces with, at each vertex, the list of faces around it.
//!
//! Terms: the *star* of an edge is the faces on it, the *link* of a vertex is the edges of its faces opposite to it.
//! Face lists, not half-edges, because scans may hold edges of three faces and vertices of two fans: such places are
//! marked [`VertexKind::Irregular`] and [`EdgeStar::Irregular`], and no more than split.

use crate::geometry::TriMesh;
use nalgebra::{Point3, Vector3};

/// Corners of a face that has been removed.
const REMOVED: [u32; 3] = [u32::MAX; 3];

/// Height over longest side up to which a face is a sliver.
const SLIVER_HEIGHT: f64 = 0.05;

/// Whether a face is so thin that its normal, twice its area long, says nothing.
#[inline]
pub(super) fn is_sliver([a, b, c]: [&Point3<f64>; 3], normal: &Vector3<f64>) -> bool {
    let longest = (b - a)
        .norm_squared()
        .max((c - b).norm_squared())
        .max((a - c).norm_squared());
    normal.norm_squared() <= (SLIVER_HEIGHT * longest).powi(2)
}

/// How the faces lie around a vertex.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum VertexKind {
    /// One closed fan.
    Interior,
    /// One open fan.
    Border,
    /// Anything else: several fans, edges of more than two faces, or faces of opposed orientation.
    Irregular,
}

/// A face on an edge, and its corner off the edge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Side {
    pub face: u32,
    pub apex: u32,
}

/// The faces on the edge from a to b.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum EdgeStar {
    /// A face on either side: `left` runs from a to b, `right` from b to a.
    Interior { left: Side, right: Side },
    /// One face only.
    Border(Side),
    /// More faces, faces of opposed orientation, or none.
    Irregular,
}

/// A mesh with the faces around each vertex.
#[derive(Clone, Debug)]
pub(super) struct DynamicMesh {
    /// Vertex positions, metres, all finite; those of removed vertices mean nothing.
    pub positions: Vec<Point3<f64>>,
    faces: Vec<[u32; 3]>,
    faces_of: Vec<Vec<u32>>,
    kinds: Vec<VertexKind>,
}

impl DynamicMesh {
    /// Takes over a mesh, without faces that repeat a vertex or have a corner that is not finite.
    pub fn new(mesh: &TriMesh) -> Self {
        let sound = mesh.filter_faces(|face| {
            let [a, b, c] = mesh.faces[face];
            let finite = |corner: &Point3<f64>| corner.iter().all(|x| x.is_finite());
            a != b && b != c && c != a && mesh.corners(face).iter().all(finite)
        });
        let mut faces_of: Vec<Vec<u32>> = vec![Vec::new(); sound.vertices.len()];
        for (face, corners) in sound.faces.iter().enumerate() {
            for &vertex in corners {
                faces_of[vertex as usize].push(face as u32);
            }
        }
        let mut dynamic = DynamicMesh {
            positions: sound.vertices,
            faces: sound.faces,
            faces_of,
            kinds: Vec::new(),
        };
        dynamic.kinds = (0..dynamic.positions.len() as u32)
            .map(|vertex| dynamic.classify(vertex))
            .collect();
        dynamic
    }

    /// The mesh without what has been removed, faces and vertices numbered as they are reached from the first face on:
    /// neighbours lie close together in memory.
    pub fn to_mesh(&self) -> TriMesh {
        let mut mesh = TriMesh::default();
        let mut new_index = vec![u32::MAX; self.positions.len()];
        let order = self.faces_by_reach();
        mesh.faces.reserve(order.len());
        for face in order {
            mesh.faces.push(self.faces[face as usize].map(|vertex| {
                let index = &mut new_index[vertex as usize];
                if *index == u32::MAX {
                    *index = mesh.vertices.len() as u32;
                    mesh.vertices.push(self.positions[vertex as usize]);
                }
                *index
            }));
        }
        mesh
    }

    /// The faces breadth first, one component after the other.
    fn faces_by_reach(&self) -> Vec<u32> {
        let mut is_reached: Vec<bool> = self.faces.iter().map(|&face| face == REMOVED).collect();
        let mut order = Vec::with_capacity(self.faces.len());
        let mut n_done = 0;
        for first in 0..self.faces.len() as u32 {
            if !std::mem::replace(&mut is_reached[first as usize], true) {
                order.push(first);
            }
            while let Some(&face) = order.get(n_done) {
                n_done += 1;
                for vertex in self.faces[face as usize] {
                    for &next in &self.faces_of[vertex as usize] {
                        if !std::mem::replace(&mut is_reached[next as usize], true) {
                            order.push(next);
                        }
                    }
                }
            }
        }
        order
    }

    /// How many faces there are room for, removed ones included.
    pub fn n_face_slots(&self) -> usize {
        self.faces.len()
    }

    /// The corners of a face, unless it has been removed.
    pub fn face(&self, face: usize) -> Option<[u32; 3]> {
        Some(self.faces[face]).filter(|&corners| corners != REMOVED)
    }

    /// The corners of each face around a vertex, the vertex first.
    pub fn fan(&self, vertex: u32) -> impl Iterator<Item = [u32; 3]> + '_ {
        self.faces_of[vertex as usize]
            .iter()
            .map(move |&face| starting_at(self.faces[face as usize], vertex))
    }

    /// The faces that have a vertex as a corner; none once it has been removed.
    pub fn faces_of(&self, vertex: u32) -> &[u32] {
        &self.faces_of[vertex as usize]
    }

    /// How the faces lie around a vertex.
    pub fn kind(&self, vertex: u32) -> VertexKind {
        self.kinds[vertex as usize]
    }

    /// Position of a vertex, metres.
    pub fn position(&self, vertex: u32) -> &Point3<f64> {
        &self.positions[vertex as usize]
    }

    /// Normal of the triangle of three vertices, twice its area long.
    pub fn normal(&self, [a, b, c]: [u32; 3]) -> Vector3<f64> {
        let a = self.position(a);
        (self.position(b) - a).cross(&(self.position(c) - a))
    }

    /// Squared distance of two vertices, m².
    pub fn length_squared(&self, a: u32, b: u32) -> f64 {
        (self.position(a) - self.position(b)).norm_squared()
    }

    /// The faces on the edge from `a` to `b`.
    pub fn edge_star(&self, a: u32, b: u32) -> EdgeStar {
        let (mut left, mut right) = (None, None);
        let mut n_faces = 0;
        for &face in &self.faces_of[a as usize] {
            let [_, next, last] = starting_at(self.faces[face as usize], a);
            if next == b {
                left = Some(Side { face, apex: last });
                n_faces += 1;
            } else if last == b {
                right = Some(Side { face, apex: next });
                n_faces += 1;
            }
        }
        match (left, right, n_faces) {
            (Some(left), Some(right), 2) => EdgeStar::Interior { left, right },
            (Some(side), None, 1) | (None, Some(side), 1) => EdgeStar::Border(side),
            _ => EdgeStar::Irregular,
        }
    }

    /// The edges whose squared length satisfies `wanted`, with it; irregular ones may come several times.
    pub fn edges_by_length(&self, wanted: impl Fn(f64) -> bool) -> Vec<(f64, [u32; 2])> {
        let mut edges = Vec::new();
        for [a, b, c] in self
            .faces
            .iter()
            .copied()
            .filter(|&corners| corners != REMOVED)
        {
            for (p, q) in [(a, b), (b, c), (c, a)] {
                let length_squared = self.length_squared(p, q);
                if wanted(length_squared) && (p < q || !self.has_opposed_side(p, q)) {
                    edges.push((length_squared, [p, q]));
                }
            }
        }
        edges
    }

    /// Whether some face runs from `b` to `a`, given that one runs from `a` to `b`.
    fn has_opposed_side(&self, a: u32, b: u32) -> bool {
        self.kind(a) == VertexKind::Interior
            || self.kind(b) == VertexKind::Interior
            || self.fan(b).any(|[_, next, _]| next == a)
    }

    /// Whether two vertices are the ends of a border edge.
    pub fn is_border(&self, a: u32, b: u32) -> bool {
        self.kind(a) != VertexKind::Interior
            && self.kind(b) != VertexKind::Interior
            && matches!(self.edge_star(a, b), EdgeStar::Border(_))
    }

    /// The two neighbours of a border vertex along the border.
    pub fn border_neighbours(&self, vertex: u32) -> Option<[u32; 2]> {
        let mut along = self
            .fan(vertex)
            .flat_map(|[_, next, last]| [next, last])
            .filter(|&neighbour| self.is_border(vertex, neighbour));
        match (along.next(), along.next(), along.next()) {
            (Some(first), Some(second), None) => Some([first, second]),
            _ => None,
        }
    }

    /// Writes the neighbours of a vertex into `ring`, each once.
    pub fn one_ring(&self, vertex: u32, ring: &mut Vec<u32>) {
        ring.clear();
        for [_, next, last] in self.fan(vertex) {
            for neighbour in [next, last] {
                if !ring.contains(&neighbour) {
                    ring.push(neighbour);
                }
            }
        }
    }

    /// Whether some face has both vertices.
    pub fn are_joined(&self, a: u32, b: u32) -> bool {
        self.fan(a).any(|[_, next, last]| next == b || last == b)
    }

    /// Splits an edge at its middle, with all its faces, however many.
    pub fn split_edge(&mut self, a: u32, b: u32) {
        let faces: Vec<u32> = self.faces_of[a as usize]
            .iter()
            .copied()
            .filter(|&face| self.faces[face as usize].contains(&b))
            .collect();
        let middle = self.positions.len() as u32;
        self.positions
            .push(nalgebra::center(self.position(a), self.position(b)));
        self.kinds.push(match self.edge_star(a, b) {
            EdgeStar::Interior { .. } => VertexKind::Interior,
            EdgeStar::Border(_) => VertexKind::Border,
            EdgeStar::Irregular => VertexKind::Irregular,
        });
        self.faces_of.push(Vec::with_capacity(6));
        for face in faces {
            let new_face = self.faces.len() as u32;
            let corners = self.faces[face as usize];
            self.faces.push(replaced(corners, a, middle));
            self.faces[face as usize] = replaced(corners, b, middle);
            self.detach(b, face);
            for vertex in self.faces[new_face as usize] {
                self.faces_of[vertex as usize].push(new_face);
            }
            self.faces_of[middle as usize].push(face);
        }
    }

    /// Joins `removed` to its neighbour `kept`, which moves to `position`; the faces on their edge vanish.
    ///
    /// The caller has made sure that the result is a manifold wherever the mesh was one.
    pub fn collapse_edge(&mut self, removed: u32, kept: u32, position: Point3<f64>) {
        for face in std::mem::take(&mut self.faces_of[removed as usize]) {
            let corners = self.faces[face as usize];
            if corners.contains(&kept) {
                self.faces[face as usize] = REMOVED;
                for vertex in corners.into_iter().filter(|&vertex| vertex != removed) {
                    self.detach(vertex, face);
                }
            } else {
                self.faces[face as usize] = replaced(corners, removed, kept);
                self.faces_of[kept as usize].push(face);
            }
        }
        self.positions[kept as usize] = position;
    }

    /// Turns the edge between `a` and `b` into one between the apexes of its two faces.
    pub fn flip_edge(&mut self, a: u32, b: u32, left: Side, right: Side) {
        self.faces[left.face as usize] = [a, right.apex, left.apex];
        self.faces[right.face as usize] = [right.apex, b, left.apex];
        self.detach(a, right.face);
        self.detach(b, left.face);
        self.faces_of[left.apex as usize].push(right.face);
        self.faces_of[right.apex as usize].push(left.face);
    }

    fn detach(&mut self, vertex: u32, face: u32) {
        let faces = &mut self.faces_of[vertex as usize];
        if let Some(place) = faces.iter().position(|&other| other == face) {
            faces.swap_remove(place);
        }
    }

    /// Walks the link of a vertex: one cycle is an interior vertex, one path a border vertex.
    fn classify(&self, vertex: u32) -> VertexKind {
        let mut link: Vec<[u32; 2]> = self
            .fan(vertex)
            .map(|[_, next, last]| [next, last])
            .collect();
        let mut ends: Vec<u32> = link.iter().map(|edge| edge[1]).collect();
        link.sort_unstable();
        ends.sort_unstable();
        let forks = link.windows(2).any(|pair| pair[0][0] == pair[1][0])
            || ends.windows(2).any(|pair| pair[0] == pair[1]);
        let mut starts = link
            .iter()
            .filter(|edge| ends.binary_search(&edge[0]).is_err());
        let (first, kind) = match (starts.next(), starts.next(), link.first()) {
            (None, _, Some(edge)) => (edge[0], VertexKind::Interior),
            (Some(edge), None, _) => (edge[0], VertexKind::Border),
            _ => return VertexKind::Irregular,
        };
        let mut n_walked = 0;
        let mut at = first;
        while let Ok(edge) = link.binary_search_by_key(&at, |edge| edge[0]) {
            n_walked += 1;
            at = link[edge][1];
            if at == first || n_walked > link.len() {
                break;
            }
        }
        if forks || n_walked != link.len() {
            VertexKind::Irregular
        } else {
            kind
        }
    }
}

/// The corners of a face in their cyclic order, from `vertex` on.
fn starting_at([a, b, c]: [u32; 3], vertex: u32) -> [u32; 3] {
    if a == vertex {
        [a, b, c]
    } else if b == vertex {
        [b, c, a]
    } else {
        [c, a, b]
    }
}

fn replaced(corners: [u32; 3], old: u32, new: u32) -> [u32; 3] {
    corners.map(|vertex| if vertex == old { new } else { vertex })
}
