//! Closing a mesh: every hole in every component is filled, so that each edge has two faces.
//!
//! The mesh is cut to a manifold first, whose border falls into simple loops; what then is smaller than 1 cm² and hangs on nothing
//! is left out. A loop of up to 200 edges gets the triangulation of least area (Barequet and Sharir 1995), by dynamic programming. A longer one is shortened to that by a ring of triangles
//! along it, each over two of its edges, and another ring, and so on: rings follow a ragged rim more quietly than one fan.
//! A triangle's new edge must not be one that the mesh already has; where nothing else is left, a fan about the loop's centre
//! closes it.
//!
//! Not handled: fillings may pass through other parts of the surface; nothing is known of what they stand for.

use super::manifold::{Manifold, border_loops, cut_to_manifold};
use super::{EdgeAdjacency, MIN_PART_AREA_M2, TriMesh};
use nalgebra::{Point3, Vector3};

/// Loops of more edges are shortened first: the work grows with the third power, 8 million triangles here.
const MAX_EXACT_EDGES: usize = 200;

/// A mesh without holes.
#[derive(Clone, Debug, PartialEq)]
pub struct Watertight {
    /// The mesh, first with the faces that it had, then with those that fill the holes.
    pub mesh: TriMesh,
    /// The vertex of the old mesh that each vertex was; for the centre of a fan one on its rim.
    pub from: Vec<u32>,
    /// How many holes were filled.
    pub n_holes: usize,
    /// Area of the fillings, m².
    pub filled_m2: f64,
}

/// Fills all holes.
pub fn close_holes(mesh: &TriMesh) -> Watertight {
    let Manifold { mesh, from } = without_splinters(mesh);
    let loops = border_loops(&mesh);
    let mut filling = Filling {
        edges: EdgeAdjacency::new(&mesh).edges,
        n_faces: mesh.faces.len(),
        mesh,
        from,
    };
    for border in &loops {
        filling.fill(border);
    }
    let Filling {
        mesh,
        from,
        n_faces,
        ..
    } = filling;
    let filled = n_faces..mesh.faces.len();
    Watertight {
        n_holes: loops.len(),
        filled_m2: mesh.faces_area_m2(filled),
        mesh,
        from,
    }
}

/// Cuts a mesh to a manifold and takes away what then hangs on nothing and is smaller than [`MIN_PART_AREA_M2`], but for the largest.
fn without_splinters(mesh: &TriMesh) -> Manifold {
    let cut = cut_to_manifold(mesh);
    let is_kept = cut.mesh.is_of_large_component(MIN_PART_AREA_M2);
    if is_kept.iter().all(|&is_kept| is_kept) {
        return cut;
    }
    let kept = cut.mesh.faces.iter().zip(&is_kept);
    let kept = kept.filter(|(_, is_kept)| **is_kept);
    let of_mesh = |face: &[u32; 3]| face.map(|vertex| cut.from[vertex as usize]);
    // Without them fewer faces meet at an edge, so that no further ones come off.
    cut_to_manifold(&TriMesh {
        faces: kept.map(|(face, _)| of_mesh(face)).collect(),
        vertices: mesh.vertices.clone(),
    })
}

/// A mesh whose holes are being filled.
struct Filling {
    mesh: TriMesh,
    from: Vec<u32>,
    /// Edges that the mesh had, in order. Those of a filling lie within its own loop, where none is made twice.
    edges: Vec<[u32; 2]>,
    /// Faces that the mesh had.
    n_faces: usize,
}

impl Filling {
    fn fill(&mut self, border: &[u32]) {
        let mut border = border.to_vec();
        while border.len() > MAX_EXACT_EDGES {
            let shorter = self.ring(&border);
            if shorter.len() == border.len() {
                break;
            }
            border = shorter;
        }
        let triangles = match border.len() {
            0..=MAX_EXACT_EDGES => self.least_area(&border),
            _ => None,
        };
        match triangles {
            Some(triangles) => self.mesh.faces.extend(triangles),
            None => self.fan(&border),
        }
    }

    /// Whether two vertices of a loop may be joined.
    fn may_join(&self, a: u32, b: u32) -> bool {
        let edge = [a.min(b), a.max(b)];
        self.edges.binary_search(&edge).is_err()
    }

    /// Cuts off every other vertex of a loop by a triangle where that may be; returns the loop that is left.
    fn ring(&mut self, border: &[u32]) -> Vec<u32> {
        let mut left = Vec::with_capacity(border.len() / 2 + 2);
        let mut vertex = 0;
        while vertex < border.len() {
            left.push(border[vertex]);
            let [a, b, c] = [0, 1, 2].map(|step| border[(vertex + step) % border.len()]);
            // The last triangle may reach round to the first vertex, but not beyond.
            let may_cut = vertex + 2 <= border.len() && self.may_join(a, c);
            if may_cut {
                self.mesh.faces.push([a, b, c]);
            }
            vertex += if may_cut { 2 } else { 1 };
        }
        left
    }

    /// The triangulation of a loop that has the least area; `None` if every one needs an edge that there is already.
    fn least_area(&self, border: &[u32]) -> Option<Vec<[u32; 3]>> {
        let n = border.len();
        let places: Vec<Point3<f64>> = border
            .iter()
            .map(|&vertex| self.mesh.vertices[vertex as usize])
            .collect();
        // Of the polygon from vertex i to vertex k: its least area, and the third corner of the triangle on its edge i–k.
        let mut least = vec![0.0; n * n];
        let mut middle = vec![0; n * n];
        for span in 2..n {
            for i in 0..n - span {
                let k = i + span;
                // The edge from the last vertex to the first is the loop's own.
                let is_own = span == n - 1;
                least[i * n + k] = f64::INFINITY;
                if !is_own && !self.may_join(border[i], border[k]) {
                    continue;
                }
                for j in i + 1..k {
                    let area = least[i * n + j]
                        + least[j * n + k]
                        + doubled_area(&places[i], &places[j], &places[k]);
                    if area < least[i * n + k] {
                        least[i * n + k] = area;
                        middle[i * n + k] = j;
                    }
                }
            }
        }
        least[n - 1].is_finite().then(|| {
            let mut triangles = Vec::with_capacity(n - 2);
            let mut pending = vec![(0, n - 1)];
            while let Some((i, k)) = pending.pop() {
                if k > i + 1 {
                    let j = middle[i * n + k];
                    triangles.push([border[i], border[j], border[k]]);
                    pending.extend([(i, j), (j, k)]);
                }
            }
            triangles
        })
    }

    /// Closes a loop by a fan about its centre.
    fn fan(&mut self, border: &[u32]) {
        let sum = border.iter().fold(Vector3::zeros(), |sum, &vertex| {
            sum + self.mesh.vertices[vertex as usize].coords
        });
        let centre = self.mesh.vertices.len() as u32;
        self.mesh
            .vertices
            .push(Point3::from(sum / border.len() as f64));
        self.from.push(self.from[border[0] as usize]);
        let ends = border.iter().cycle().skip(1);
        let faces = border.iter().zip(ends).map(|(&a, &b)| [a, b, centre]);
        self.mesh.faces.extend(faces);
    }
}

fn doubled_area(a: &Point3<f64>, b: &Point3<f64>, c: &Point3<f64>) -> f64 {
    (b - a).cross(&(c - a)).norm()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sphere of radius 1 in rings, without the faces that `keep` rejects by their centre.
    fn sphere(n: usize, keep: impl Fn(&Point3<f64>) -> bool) -> TriMesh {
        let angle = |i: usize, of: usize| std::f64::consts::PI * i as f64 / of as f64;
        let mut vertices = vec![Point3::new(0.0, 0.0, 1.0)];
        for ring in 1..n {
            let (z, r) = (angle(ring, n).cos(), angle(ring, n).sin());
            for step in 0..2 * n {
                let at = angle(step, n);
                vertices.push(Point3::new(r * at.cos(), r * at.sin(), z));
            }
        }
        vertices.push(Point3::new(0.0, 0.0, -1.0));
        let south = vertices.len() as u32 - 1;
        let at = |ring: usize, step: usize| (1 + (ring - 1) * 2 * n + step % (2 * n)) as u32;
        let mut faces = Vec::new();
        for step in 0..2 * n {
            faces.push([0, at(1, step), at(1, step + 1)]);
            for ring in 1..n - 1 {
                let [a, b] = [at(ring, step), at(ring, step + 1)];
                let [c, d] = [at(ring + 1, step), at(ring + 1, step + 1)];
                faces.extend([[a, c, d], [a, d, b]]);
            }
            faces.push([south, at(n - 1, step + 1), at(n - 1, step)]);
        }
        let mesh = TriMesh { vertices, faces };
        mesh.filter_faces(|face| keep(&mesh.centroid(face)))
    }

    fn assert_closed(mesh: &TriMesh) {
        assert!(border_loops(mesh).is_empty());
        let edges = EdgeAdjacency::new(mesh);
        assert!(edges.n_faces.iter().all(|&n| n == 2));
        // Each edge is run along once in each direction: closed, and one way round.
        assert_eq!(
            cut_to_manifold(mesh).mesh.vertices.len(),
            mesh.vertices.len()
        );
    }

    fn volume(mesh: &TriMesh) -> f64 {
        (0..mesh.faces.len())
            .map(|face| {
                let [a, b, c] = mesh.corners(face).map(|p| p.coords);
                a.dot(&b.cross(&c)) / 6.0
            })
            .sum()
    }

    #[test]
    fn a_bowl_gets_a_flat_lid_however_long_its_rim() {
        // Rims of 40 edges and of 480, which is shortened by rings.
        for n in [20, 240] {
            let bowl = sphere(n, |centre| centre.z < 0.0);
            let closed = close_holes(&bowl);
            assert_closed(&closed.mesh);
            assert_eq!(closed.n_holes, 1);
            let rim = std::f64::consts::PI / n as f64;
            // The lid is the regular polygon of 2n corners: triangulated without overlap it has its area.
            let polygon = n as f64 * rim.sin();
            assert!(
                (closed.filled_m2 - polygon).abs() < 1e-9,
                "{}",
                closed.filled_m2
            );
            let half = 2.0 / 3.0 * std::f64::consts::PI;
            let volume = volume(&closed.mesh);
            assert!((volume - half).abs() < 0.03 * half, "{volume}");
        }
    }

    #[test]
    fn every_component_is_closed_by_itself() {
        let mut mesh = sphere(16, |centre| centre.z.abs() < 0.8);
        let far = sphere(10, |centre| centre.x < 0.4 || centre.y < 0.1);
        let first = mesh.vertices.len() as u32;
        let moved = far.vertices.iter().map(|p| p + Vector3::new(5.0, 0.0, 0.0));
        mesh.vertices.extend(moved);
        mesh.faces
            .extend(far.faces.iter().map(|face| face.map(|v| v + first)));
        let closed = close_holes(&mesh);
        assert_closed(&closed.mesh);
        assert_eq!(closed.n_holes, 3);
        assert_eq!(closed.mesh.face_components().1, 2);
        assert_eq!(closed.from.len(), closed.mesh.vertices.len());
    }

    #[test]
    fn a_splinter_that_hangs_on_a_corner_alone_is_left_out() {
        let bowl = sphere(12, |centre| centre.z < 0.0);
        let mut mesh = bowl.clone();
        let first = mesh.vertices.len() as u32;
        let corner = mesh.vertices[0];
        mesh.vertices.push(corner + Vector3::new(0.002, 0.0, 0.0));
        mesh.vertices.push(corner + Vector3::new(0.0, 0.002, 0.0));
        mesh.faces.insert(0, [0, first, first + 1]);
        let closed = close_holes(&mesh);
        assert_closed(&closed.mesh);
        assert_eq!((closed.n_holes, closed.mesh.face_components().1), (1, 1));
        assert!(closed.from.iter().all(|&vertex| vertex < first));
        assert_eq!(closed.mesh.faces, close_holes(&bowl).mesh.faces);
        // Alone it is all there is.
        let splinter = mesh.filter_faces(|face| face == 0);
        assert_eq!(close_holes(&splinter).mesh.faces.len(), 2);
    }

    #[test]
    fn faces_missing_at_random_make_holes_that_meet_in_points_and_all_are_closed() {
        let mut random = fastrand::Rng::with_seed(5);
        for share in [0.05, 0.3, 0.7] {
            let whole = sphere(40, |_| true);
            let kept = whole.filter_faces(|_| random.f64() > share);
            let closed = close_holes(&kept);
            assert!(closed.n_holes > 50, "{}", closed.n_holes);
            assert_closed(&closed.mesh);
            for (vertex, &from) in closed.from.iter().enumerate().take(kept.vertices.len()) {
                assert_eq!(closed.mesh.vertices[vertex], kept.vertices[from as usize]);
            }
        }
    }

    #[test]
    fn where_every_chord_is_an_edge_already_a_fan_closes_the_hole() {
        let corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
        let mesh = TriMesh {
            vertices: corners.map(|(x, y)| Point3::new(x, y, 0.0)).to_vec(),
            faces: Vec::new(),
        };
        let mut filling = Filling {
            edges: vec![[0, 2], [1, 3]],
            n_faces: 0,
            mesh,
            from: vec![0, 1, 2, 3],
        };
        filling.fill(&[0, 1, 2, 3]);
        let Filling { mesh, from, .. } = filling;
        assert_eq!(mesh.vertices[4], Point3::new(0.5, 0.5, 0.0));
        assert_eq!(mesh.faces, [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]);
        assert_eq!(from, [0, 1, 2, 3, 0]);
    }

    #[test]
    fn a_closed_mesh_stays_as_it_is() {
        let whole = sphere(12, |_| true);
        let closed = close_holes(&whole);
        assert!(closed.filled_m2 == 0.0 && closed.filled_m2.is_sign_positive());
        assert_eq!(closed.n_holes, 0);
        assert_eq!(closed.mesh.faces.len(), whole.faces.len());
        assert_closed(&closed.mesh);
    }
}
