//! Indexed triangle meshes.

use super::Lists;
use super::disjoint_sets::DisjointSets;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use std::ops::{Add, AddAssign, Div, Range};

/// Sums at more vertices than this are worth several threads.
const PARALLEL: usize = 10_000;
/// All faces are gone through for each part of the vertices, of which there are so many at most.
const MAX_PARTS: usize = 8;

/// Parts of a fused surface that are smaller are noise, m²; arbitrary.
pub const MIN_PART_AREA_M2: f64 = 1e-4;

/// A triangle mesh: vertices in metres, faces counter-clockwise seen from outside.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriMesh {
    /// Vertex positions, metres.
    pub vertices: Vec<Point3<f64>>,
    /// Vertex indices of each face, counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
}

/// The normal of a triangle, twice its area long (m²): `(b−a)×(c−a)`.
pub fn area_vector([a, b, c]: [Point3<f64>; 3]) -> Vector3<f64> {
    (b - a).cross(&(c - a))
}

/// The label of most corners of a face, the first one's where all differ.
///
/// # Panics
/// If a corner has no label.
pub fn label_of_most_corners(face: [u32; 3], labels: &[u8]) -> u8 {
    let [a, b, c] = face.map(|vertex| labels[vertex as usize]);
    if b == c { b } else { a }
}

/// The side of a cube that a normal faces most: twice the axis, and one more if it points against that.
pub fn facing_side(normal: &Vector3<f64>) -> usize {
    let axis = normal.iamax();
    2 * axis + usize::from(normal[axis] < 0.0)
}

impl TriMesh {
    /// The three corners of a face.
    pub fn corners(&self, face: usize) -> [Point3<f64>; 3] {
        self.faces[face].map(|vertex| self.vertices[vertex as usize])
    }

    /// The normal of a face, twice its area long (m²), pointing outside: [`area_vector`].
    pub fn face_normal(&self, face: usize) -> Vector3<f64> {
        area_vector(self.corners(face))
    }

    /// Centre of a face.
    pub fn centroid(&self, face: usize) -> Point3<f64> {
        Point3::from(self.mean_at_face(face, |vertex| self.vertices[vertex].coords))
    }

    /// Mean of a value of the vertices over the corners of a face.
    pub fn mean_at_face<T: Add<Output = T> + Div<f64, Output = T>>(
        &self,
        face: usize,
        of_vertex: impl Fn(usize) -> T,
    ) -> T {
        let [a, b, c] = self.faces[face].map(|vertex| of_vertex(vertex as usize));
        (a + b + c) / 3.0
    }

    /// Unit normals at the vertices, weighted by face area; zero where the faces around a vertex cancel or there are none.
    pub fn vertex_normals(&self) -> Vec<Vector3<f64>> {
        let mut normals = self.sums_at_vertices(Vector3::zeros(), |face| self.face_normal(face));
        for normal in &mut normals {
            *normal = normal.try_normalize(0.0).unwrap_or_default();
        }
        normals
    }

    /// Sums of a value of each face over the faces around each vertex, from `zero`, in the order of the faces. Within a pool each
    /// thread sums for a part of the vertices.
    pub fn sums_at_vertices<T: Copy + AddAssign + Send + Sync>(
        &self,
        zero: T,
        of_face: impl Fn(usize) -> T + Sync,
    ) -> Vec<T> {
        let n_vertices = self.vertices.len();
        let mut sums = vec![zero; n_vertices];
        let n_parts = match rayon::current_thread_index() {
            Some(_) if n_vertices > PARALLEL => rayon::current_num_threads().min(MAX_PARTS),
            _ => 1,
        };
        let n_in_part = n_vertices.div_ceil(n_parts).max(1);
        let sum_part = |(part, sums): (usize, &mut [T])| {
            for (face, corners) in self.faces.iter().enumerate() {
                debug_assert!(corners.iter().all(|&vertex| (vertex as usize) < n_vertices));
                let at = corners.map(|vertex| (vertex as usize).wrapping_sub(part * n_in_part));
                if at.iter().all(|&at| at >= sums.len()) {
                    continue;
                }
                let value = of_face(face);
                for at in at {
                    if let Some(sum) = sums.get_mut(at) {
                        *sum += value;
                    }
                }
            }
        };
        match n_parts {
            1 => sum_part((0, &mut sums)),
            _ => sums
                .par_chunks_mut(n_in_part)
                .enumerate()
                .for_each(sum_part),
        }
        sums
    }

    /// Mean of the vertices; not a number without any.
    pub fn centre(&self) -> Point3<f64> {
        let vertices = self.vertices.iter();
        let sum = vertices.fold(Vector3::zeros(), |sum, vertex| sum + vertex.coords);
        Point3::from(sum / self.vertices.len() as f64)
    }

    /// How far the farthest vertex is from a point, metres; 0 without any.
    pub fn radius_about(&self, point: &Point3<f64>) -> f64 {
        let vertices = self.vertices.iter();
        let squared = vertices.map(|vertex| (vertex - point).norm_squared());
        squared.fold(0.0, f64::max).sqrt()
    }

    /// Whole surface area, m².
    pub fn area_m2(&self) -> f64 {
        self.faces_area_m2(0..self.faces.len())
    }

    /// The area of some of the faces, m².
    pub fn faces_area_m2(&self, faces: Range<usize>) -> f64 {
        let areas = faces.map(|face| 0.5 * self.face_normal(face).norm());
        // A sum of nothing is -0.
        0.0 + areas.sum::<f64>()
    }

    /// The mesh of the faces for which `keep` holds, with the vertices that they use, in the old order.
    pub fn filter_faces(&self, mut keep: impl FnMut(usize) -> bool) -> TriMesh {
        let faces: Vec<[u32; 3]> = (0..self.faces.len())
            .filter(|&face| keep(face))
            .map(|face| self.faces[face])
            .collect();
        let mut new_index = vec![u32::MAX; self.vertices.len()];
        for &vertex in faces.iter().flatten() {
            new_index[vertex as usize] = 0;
        }
        let mut vertices = Vec::new();
        for (vertex, index) in new_index.iter_mut().enumerate() {
            if *index == 0 {
                *index = vertices.len() as u32;
                vertices.push(self.vertices[vertex]);
            }
        }
        let faces = faces
            .into_iter()
            .map(|face| face.map(|vertex| new_index[vertex as usize]))
            .collect();
        TriMesh { vertices, faces }
    }

    /// Of each face whether its component ([`Self::face_components`]) has so large an area, m², or is the largest.
    pub fn is_of_large_component(&self, least_m2: f64) -> Vec<bool> {
        let (labels, area_m2) = self.components_with_areas();
        let largest_m2 = area_m2.iter().copied().fold(0.0, f64::max);
        let is_large = |&label: &u32| area_m2[label as usize] >= least_m2.min(largest_m2);
        labels.iter().map(is_large).collect()
    }

    /// [`Self::face_components`] and their areas, m².
    pub fn components_with_areas(&self) -> (Vec<u32>, Vec<f64>) {
        let (labels, n_components) = self.face_components();
        let mut area_m2 = vec![0.0; n_components];
        for (face, &label) in labels.iter().enumerate() {
            area_m2[label as usize] += 0.5 * self.face_normal(face).norm();
        }
        (labels, area_m2)
    }

    /// The component of each face, faces being joined where they share a vertex; components are numbered by their first
    /// face. Also returns how many there are.
    pub fn face_components(&self) -> (Vec<u32>, usize) {
        let mut joined = DisjointSets::new(self.vertices.len());
        for &[a, b, c] in &self.faces {
            joined.join(a, b);
            joined.join(b, c);
        }
        let mut label_of_root = vec![u32::MAX; self.vertices.len()];
        let mut n_components = 0;
        let labels = self
            .faces
            .iter()
            .map(|face| {
                let label = &mut label_of_root[joined.root(face[0]) as usize];
                if *label == u32::MAX {
                    *label = n_components;
                    n_components += 1;
                }
                *label
            })
            .collect();
        (labels, n_components as usize)
    }
}

/// The undirected edges of a mesh, each once, sorted by their vertices.
#[derive(Clone, Debug)]
pub struct EdgeAdjacency {
    /// Vertices of each edge, the smaller index first.
    pub edges: Vec<[u32; 2]>,
    /// How many faces share each edge: 1 on a border, 2 inside, more where the mesh is not a manifold.
    pub n_faces: Vec<u32>,
}

impl EdgeAdjacency {
    /// Finds the edges of a mesh.
    pub fn new(mesh: &TriMesh) -> Self {
        let sides = mesh.faces.iter();
        let sides = sides.flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]);
        let sides = sides.map(|[p, q]| [p.min(q), p.max(q)]);
        // The sides from one vertex to larger ones are few.
        let seconds = Lists::new(mesh.vertices.len(), sides).sorted();
        let (mut edges, mut n_faces) = (Vec::new(), Vec::new());
        for first in 0..seconds.len() {
            for equal in seconds.of(first).chunk_by(|second, next| second == next) {
                edges.push([first as u32, equal[0]]);
                n_faces.push(equal.len() as u32);
            }
        }
        EdgeAdjacency { edges, n_faces }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_separate_triangles() -> TriMesh {
        let point = |x: f64, y: f64| Point3::new(x, y, 0.0);
        TriMesh {
            vertices: vec![
                point(0.0, 0.0),
                point(1.0, 0.0),
                point(0.0, 1.0),
                point(5.0, 0.0),
                point(6.0, 0.0),
                point(5.0, 1.0),
            ],
            faces: vec![[0, 1, 2], [3, 4, 5]],
        }
    }

    #[test]
    fn sums_at_vertices_are_the_same_on_any_number_of_threads() {
        let n = PARALLEL as u32 + 3_001;
        let scattered = |k: u32| (u64::from(k) * 7_919 % u64::from(n)) as u32;
        let mut mesh = TriMesh {
            vertices: vec![Point3::origin(); n as usize],
            faces: (0..2 * n)
                .map(|k| [k % n, scattered(k), scattered(k + 5)])
                .collect(),
        };
        mesh.faces.push([4, 4, n - 1]);
        let value = |face: usize| 1.0 / (face as f64 + 3.7);
        let mut expected = vec![0.0; n as usize];
        for (face, corners) in mesh.faces.iter().enumerate() {
            for &vertex in corners {
                expected[vertex as usize] += value(face);
            }
        }
        assert_eq!(mesh.sums_at_vertices(0.0, value), expected);
        for n_threads in [1, 2, 3] {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(n_threads)
                .build();
            let sums = pool
                .expect("threads")
                .install(|| mesh.sums_at_vertices(0.0, value));
            assert!(sums == expected, "{n_threads} threads");
        }
    }

    #[test]
    fn edges_are_counted_once_in_order() {
        let mut mesh = two_separate_triangles();
        mesh.faces[1] = [2, 1, 3];
        let adjacency = EdgeAdjacency::new(&mesh);
        assert_eq!(
            adjacency.edges,
            vec![[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
        );
        assert_eq!(adjacency.n_faces, vec![1, 1, 2, 1, 1]);
    }

    #[test]
    fn components_and_filter_agree() {
        let mesh = two_separate_triangles();
        let (labels, n) = mesh.face_components();
        assert_eq!((labels, n), (vec![0, 1], 2));
        let second = mesh.filter_faces(|face| face == 1);
        assert_eq!(second.faces, vec![[0, 1, 2]]);
        assert_eq!(second.vertices[0].x, 5.0);
        assert!((mesh.area_m2() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn the_area_of_nothing_is_no_negative_zero() {
        assert!(TriMesh::default().area_m2().is_sign_positive());
    }
}
