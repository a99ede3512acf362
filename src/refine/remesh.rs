//! Isotropic remeshing: triangles of one size and nearly equal sides, on the surface of the scanned mesh.
//!
//! After Botsch & Kobbelt, *A Remeshing Approach to Multiresolution Modeling*, SGP 2004, Sec. 4: rounds of splitting long
//! edges, collapsing short ones, flipping edges towards valence 6, and moving vertices within their tangent planes, then
//! back onto the surface. Short edges are collapsed only where the link condition holds and no face turns over.
//!
//! Guarantees: manifold in, manifold out, with the same Euler characteristic, components and borders; equal results on
//! any number of threads. Border edges are split and, where the border is nearly straight, collapsed; border vertices do
//! not move. Not handled: sharp features, which are cut off by up to half an edge, and edges of more than two faces,
//! which are split but neither collapsed nor moved.

mod collapse;
mod dynamic_mesh;
mod flip;
mod hausdorff;
mod relax;
#[cfg(test)]
mod scenes;
mod split;
mod subdivide;

use crate::geometry::{TriMesh, TriangleBvh};
use collapse::{CollapseLimits, collapse_short_edges};
use dynamic_mesh::DynamicMesh;
use flip::equalise_valences;
pub use hausdorff::{Distances, RemeshDistance};
use relax::relax_onto;
use serde::{Deserialize, Serialize};
use split::split_long_edges;
pub use subdivide::{Subdivided, subdivide};

/// Edges longer than this many edge lengths are split. With [`MIN_LENGTH`] from the article: halves of a split edge are
/// then closer to the wanted length than the edge was, and so is a collapsed pair.
const MAX_LENGTH: f64 = 4.0 / 3.0;

/// Edges shorter than this many edge lengths are collapsed.
const MIN_LENGTH: f64 = 4.0 / 5.0;

/// Parameters of [`remesh`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RemeshParams {
    /// Wanted length of all edges, metres, positive.
    pub edge_length_m: f64,
    /// Rounds of splitting, collapsing, flipping and relaxing; from 5 on the edges hardly change.
    #[serde(default = "default_rounds")]
    pub n_rounds: usize,
}

impl RemeshParams {
    /// The default number of rounds for this edge length (m).
    pub fn new(edge_length_m: f64) -> Self {
        RemeshParams {
            edge_length_m,
            n_rounds: default_rounds(),
        }
    }
}

fn default_rounds() -> usize {
    5
}

/// Covers the surface of `source` with nearly equilateral triangles.
///
/// Faces that repeat a vertex or have a corner that is not finite are dropped, and so are vertices without faces.
///
/// # Panics
/// If the edge length is not positive and finite.
pub fn remesh(source: &TriMesh, params: &RemeshParams) -> TriMesh {
    let length_m = params.edge_length_m;
    assert!(
        length_m > 0.0 && length_m.is_finite(),
        "edge_length_m is {length_m}, must be positive"
    );
    let limits = CollapseLimits {
        min_length_m: MIN_LENGTH * length_m,
        max_length_m: MAX_LENGTH * length_m,
    };
    let surface = TriangleBvh::new(source);
    let mut mesh = DynamicMesh::new(source);
    for _ in 0..params.n_rounds {
        split_long_edges(&mut mesh, limits.max_length_m);
        // Renumbered, neighbours lie close together in memory, on which the speed of what follows depends.
        mesh = DynamicMesh::new(&mesh.to_mesh());
        collapse_short_edges(&mut mesh, &limits);
        equalise_valences(&mut mesh);
        relax_onto(&mut mesh, &surface);
    }
    mesh.to_mesh()
}

#[cfg(test)]
mod tests {
    use super::scenes::{level_set, plane, scatter, sphere, torus};
    use super::*;
    use crate::geometry::EdgeAdjacency;
    use nalgebra::Point3;

    fn remeshed(source: &TriMesh, edge_length_m: f64) -> TriMesh {
        remesh(source, &RemeshParams::new(edge_length_m))
    }

    /// Vertices − edges + faces.
    fn euler_characteristic(mesh: &TriMesh) -> i64 {
        let n_edges = EdgeAdjacency::new(mesh).edges.len();
        mesh.vertices.len() as i64 - n_edges as i64 + mesh.faces.len() as i64
    }

    /// Every directed side of a face once: at most two faces an edge, running opposite ways.
    fn assert_oriented_manifold(mesh: &TriMesh) {
        let mut sides: Vec<[u32; 2]> = mesh
            .faces
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
            .collect();
        sides.sort_unstable();
        assert!(sides.windows(2).all(|pair| pair[0] != pair[1]));
    }

    fn share(n: usize, of: usize) -> f64 {
        n as f64 / of as f64
    }

    fn assert_even_edges(mesh: &TriMesh, length_m: f64) {
        let edges = EdgeAdjacency::new(mesh).edges;
        let lengths: Vec<f64> = edges
            .iter()
            .map(|edge| edge.map(|vertex| mesh.vertices[vertex as usize]))
            .map(|[a, b]| (a - b).norm() / length_m)
            .collect();
        let n_even = lengths
            .iter()
            .filter(|length| (0.5..=1.6).contains(*length))
            .count();
        let mean = lengths.iter().sum::<f64>() / lengths.len() as f64;
        assert!(
            share(n_even, lengths.len()) >= 0.97,
            "{n_even} of {}",
            lengths.len()
        );
        assert!((0.9..1.1).contains(&mean), "mean edge length {mean}");
    }

    fn assert_wide_angles(mesh: &TriMesh) {
        let smallest_angle = |face: usize| {
            let [a, b, c] = mesh.corners(face);
            (b - a)
                .angle(&(c - a))
                .min((c - b).angle(&(a - b)))
                .min((a - c).angle(&(b - c)))
        };
        let n_wide = (0..mesh.faces.len())
            .filter(|&face| smallest_angle(face) > 20f64.to_radians())
            .count();
        assert!(
            share(n_wide, mesh.faces.len()) >= 0.99,
            "{n_wide} of {}",
            mesh.faces.len()
        );
    }

    fn largest(values: impl Iterator<Item = f64>) -> f64 {
        values.fold(0.0, f64::max)
    }

    #[test]
    fn a_sphere_becomes_evenly_covered_whether_refined_or_coarsened() {
        let source = level_set(24, |p| sphere(p, [0.01, 0.02, -0.03], 0.8));
        // Edges of tetrahedra are up to h = 0.083·√3 long. The source errs by linear interpolation along them, h²/8r, and
        // inside triangles of circumradius h/√3, h²/6r.
        let tolerance_m = (2.0f64 / 24.0).powi(2) * 3.0 * (1.0 / 8.0 + 1.0 / 6.0) / 0.8;
        for length_m in [0.03, 0.06, 0.15] {
            let mesh = remeshed(&source, length_m);
            assert_oriented_manifold(&mesh);
            assert_eq!(euler_characteristic(&mesh), 2);
            assert_even_edges(&mesh, length_m);
            assert_wide_angles(&mesh);
            let from_surface = |p: &Point3<f64>| sphere(p, [0.01, 0.02, -0.03], 0.8).abs();
            assert!(largest(mesh.vertices.iter().map(from_surface)) < tolerance_m);
            for face in 0..mesh.faces.len() {
                let outwards = mesh.centroid(face) - Point3::new(0.01, 0.02, -0.03);
                let normal = mesh.face_normal(face);
                assert!(normal.dot(&outwards) > 0.7 * normal.norm() * outwards.norm());
            }
        }
    }

    #[test]
    fn a_noisy_torus_keeps_its_hole_and_its_distance() {
        let noise =
            |p: &Point3<f64>| 0.004 * scatter(p.coords.map(|x| (x * 1e6).round() as i64).into());
        let source = level_set(30, |p| torus(p, 0.6, 0.25) + noise(p));
        let length_m = 0.03;
        let mesh = remeshed(&source, length_m);
        assert_oriented_manifold(&mesh);
        assert_eq!(euler_characteristic(&mesh), 0);
        assert_even_edges(&mesh, length_m);
        assert_wide_angles(&mesh);
        let surface = TriangleBvh::new(&source);
        let from_source = |face: usize| {
            let closest = surface.closest_point(&mesh.centroid(face), 1.0);
            closest.expect("within a metre").distance
        };
        // Noise of ±4 mm bends edges of 30 mm over facets of up to 115 mm by no more than the noise itself.
        assert!(largest((0..mesh.faces.len()).map(from_source)) < 0.008);
    }

    #[test]
    fn the_border_of_a_plane_stays() {
        for (n, length_m) in [(40, 0.05), (10, 0.03)] {
            let source = plane(n);
            let mesh = remeshed(&source, length_m);
            assert_oriented_manifold(&mesh);
            assert_eq!(euler_characteristic(&mesh), 1);
            assert_even_edges(&mesh, length_m);
            assert_wide_angles(&mesh);
            assert!((mesh.area_m2() - 0.7).abs() < 1e-9, "{}", mesh.area_m2());
            assert!(largest(mesh.vertices.iter().map(|p| p.z.abs())) < 1e-12);
            assert!((0..mesh.faces.len()).all(|face| mesh.face_normal(face).z > 0.0));
            for corner in [[0.0, 0.0], [1.0, 0.0], [0.0, 0.7], [1.0, 0.7]] {
                let corner = Point3::new(corner[0], corner[1], 0.0);
                assert!(mesh.vertices.iter().any(|p| (p - corner).norm() < 1e-12));
            }
        }
    }

    #[test]
    fn a_ragged_border_moves_by_less_than_its_tolerance() {
        let source = level_set(20, |p| p.z - 0.2 * p.x - 0.9 * p.y - 0.013);
        let mesh = remeshed(&source, 0.05);
        assert_oriented_manifold(&mesh);
        assert_eq!(euler_characteristic(&mesh), euler_characteristic(&source));
        assert_even_edges(&mesh, 0.05);
        assert_wide_angles(&mesh);
        // The border is that of the cube.
        let adjacency = EdgeAdjacency::new(&mesh);
        for (edge, _) in adjacency
            .edges
            .iter()
            .zip(&adjacency.n_faces)
            .filter(|(_, n)| **n == 1)
        {
            for vertex in edge {
                let p = mesh.vertices[*vertex as usize];
                assert!((p.coords.amax() - 1.0).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn components_stay_apart() {
        let field =
            |p: &Point3<f64>| sphere(p, [-0.5, 0.0, 0.0], 0.4).min(sphere(p, [0.5, 0.1, 0.0], 0.3));
        let mesh = remeshed(&level_set(20, field), 0.05);
        assert_eq!(mesh.face_components().1, 2);
        assert_eq!(euler_characteristic(&mesh), 4);
        assert_oriented_manifold(&mesh);
        assert_even_edges(&mesh, 0.05);
    }

    /// A mesh with its edges halved, on the surface of `source`.
    fn halved(mesh: &TriMesh, source: &TriMesh) -> Subdivided {
        let edges = EdgeAdjacency::new(mesh).edges;
        let number = |p: u32, q: u32| {
            let edge = edges.binary_search(&[p.min(q), p.max(q)]);
            edge.expect("an edge of the mesh") as u32
        };
        let sides = mesh.faces.iter();
        let sides = sides.map(|&[a, b, c]| [number(a, b), number(b, c), number(c, a)]);
        let sides: Vec<[u32; 3]> = sides.collect();
        subdivide(mesh, &sides, edges.len(), &TriangleBvh::new(source))
    }

    #[test]
    fn halved_edges_make_four_faces_of_each_on_the_same_surface() {
        let source = level_set(24, |p| torus(p, 0.6, 0.25));
        let coarse = remeshed(&source, 0.08);
        let Subdivided { mesh, parents } = halved(&coarse, &source);
        assert_eq!(mesh.faces.len(), 4 * coarse.faces.len());
        assert_oriented_manifold(&mesh);
        assert_eq!(euler_characteristic(&mesh), 0);
        assert_even_edges(&mesh, 0.04);
        assert_wide_angles(&mesh);
        let surface = TriangleBvh::new(&source);
        let from_source = |p: &Point3<f64>| {
            let closest = surface.closest_point(p, 1.0);
            closest.expect("within a metre").distance
        };
        assert!(largest(mesh.vertices.iter().map(from_source)) < 1e-9);
        // Each face has the corner of its parent that it is to have, or no corner of it.
        for (child, corners) in mesh.faces.iter().enumerate() {
            let parent = coarse.faces[child / 4];
            for vertex in corners {
                let [p, q] = parents[*vertex as usize];
                assert!(parent.contains(&p) && parent.contains(&q));
            }
            if child % 4 < 3 {
                let corner = parent[child % 4];
                assert!(corners.iter().any(|&v| parents[v as usize] == [corner; 2]));
            }
        }
    }

    #[test]
    fn a_cube_keeps_its_edges_when_those_of_its_mesh_are_halved() {
        let source = level_set(40, |p| p.x.abs().max(p.y.abs()).max(p.z.abs()) - 0.71);
        let length_m = 0.06;
        let mesh = halved(&remeshed(&source, 2.0 * length_m), &source).mesh;
        let surface = TriangleBvh::new(&mesh);
        let cut_off = source.vertices.iter().map(|p| {
            let closest = surface.closest_point(p, 1.0);
            closest.expect("within a metre").distance
        });
        let cut_off_m = largest(cut_off);
        assert!(cut_off_m < length_m, "{cut_off_m}");
    }

    #[test]
    fn the_border_of_a_plane_stays_when_its_edges_are_halved() {
        let source = plane(40);
        let mesh = halved(&remeshed(&source, 0.1), &source).mesh;
        assert_oriented_manifold(&mesh);
        assert_eq!(euler_characteristic(&mesh), 1);
        assert!((mesh.area_m2() - 0.7).abs() < 1e-9, "{}", mesh.area_m2());
    }

    #[test]
    fn small_components_shrink_no_further_than_a_tetrahedron() {
        let source = level_set(10, |p| sphere(p, [0.0, 0.0, 0.0], 0.3));
        let mesh = remeshed(&source, 5.0);
        assert_eq!(euler_characteristic(&mesh), 2);
        assert_oriented_manifold(&mesh);
        assert!((4..=12).contains(&mesh.faces.len()), "{}", mesh.faces.len());
    }

    #[test]
    fn edges_of_three_faces_and_vertices_of_two_fans_stay() {
        let mut source = plane(6);
        let fin = source.vertices.len() as u32;
        source.vertices.extend([
            Point3::new(0.5, 0.35, 0.4),
            Point3::new(1.2, 0.9, 0.0),
            Point3::new(1.2, 0.7, 0.1),
            Point3::new(f64::NAN, 0.0, 0.0),
        ]);
        let corner = fin - 1;
        source.faces.extend([
            [24, 25, fin],
            [corner, fin + 1, fin + 2],
            [0, 1, fin + 3],
            [3, 3, 4],
        ]);
        let mesh = remeshed(&source, 0.04);
        let n_faces = EdgeAdjacency::new(&mesh).n_faces;
        // The edge of three faces has been halved until its parts were short enough, and no more.
        let length_m = (source.vertices[24] - source.vertices[25]).norm();
        let n_parts = ((length_m / (MAX_LENGTH * 0.04)).ceil() as usize).next_power_of_two();
        assert_eq!(n_faces.iter().filter(|&&n| n == 3).count(), n_parts);
        assert!(n_faces.iter().all(|&n| n <= 3));
        assert!(
            mesh.vertices
                .iter()
                .all(|p| p.coords.iter().all(|x| x.is_finite()))
        );
        assert!(mesh.vertices.contains(&source.vertices[corner as usize]));
    }

    #[test]
    fn two_runs_are_equal() {
        let source = level_set(16, |p| torus(p, 0.6, 0.3));
        let single = rayon::ThreadPoolBuilder::new()
            .num_threads(1)
            .build()
            .expect("a thread");
        let alone = single.install(|| remeshed(&source, 0.04));
        assert_eq!(alone, remeshed(&source, 0.04));
    }

    #[test]
    fn a_mesh_without_faces_stays_empty() {
        assert_eq!(remeshed(&TriMesh::default(), 0.1), TriMesh::default());
    }
}
