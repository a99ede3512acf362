//! A bounding-volume hierarchy over the triangles of a mesh, for closest points and for shadow rays.
//!
//! Boxes are halved at the median centroid along their longest axis, so that the depth is the logarithm of the number of
//! faces whatever the mesh. Answers do not depend on the order of traversal: of equally close faces the one with the
//! smaller index is returned. Not handled: moving meshes, and the first hit of a ray.

use super::TriMesh;
use super::triangle::{closest_on_triangle, ray_meets};
use nalgebra::{Point3, Vector3};

/// Faces in a leaf at most; 4 to 16 are equally fast, fewer only cost memory.
const LEAF_FACES: usize = 8;

/// Pending nodes of a traversal at most: the depth of a median-split tree over 2³² faces, with room to spare.
const STACK_NODES: usize = 64;

/// The point of a mesh closest to a query point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClosestPoint {
    /// Index of the face on which the point lies.
    pub face: usize,
    /// The point, metres.
    pub point: Point3<f64>,
    /// Its distance from the query point, metres.
    pub distance: f64,
    /// Weights of the corners of the face, of sum 1, all within [0, 1].
    pub barycentric: [f64; 3],
}

/// A hierarchy of boxes over the triangles of a mesh, with its own copy of the triangles.
#[derive(Clone, Debug, Default)]
pub struct TriangleBvh {
    /// Nodes depth first: the first child of an inner node follows it. Empty for a mesh without faces.
    nodes: Vec<Node>,
    /// Corners of the triangles, leaf by leaf.
    triangles: Vec<[Point3<f64>; 3]>,
    /// Index in the mesh of each of `triangles`.
    faces: Vec<u32>,
}

#[derive(Clone, Copy, Debug)]
struct Node {
    low: Vector3<f64>,
    high: Vector3<f64>,
    content: Content,
}

#[derive(Clone, Copy, Debug)]
enum Content {
    Leaf { first: u32, end: u32 },
    Inner { second_child: u32 },
}

impl TriangleBvh {
    /// Builds the hierarchy; faces with a corner that is not finite are left out.
    pub fn new(mesh: &TriMesh) -> Self {
        let mut items: Vec<Item> = (0..mesh.faces.len())
            .filter_map(|face| Item::new(mesh, face))
            .collect();
        let mut bvh = TriangleBvh {
            nodes: Vec::with_capacity(items.len() / 2 + 1),
            triangles: Vec::with_capacity(items.len()),
            faces: Vec::with_capacity(items.len()),
        };
        if !items.is_empty() {
            bvh.build(mesh, &mut items);
        }
        bvh
    }

    /// The point of the mesh closest to `query` and no farther than `max_distance` (m), if there is one.
    pub fn closest_point(&self, query: &Point3<f64>, max_distance: f64) -> Option<ClosestPoint> {
        let root = self.nodes.first()?;
        let mut limit = max_distance * max_distance;
        let mut best: Option<(u32, [f64; 3], Point3<f64>)> = None;
        let mut stack = [(0u32, 0.0f64); STACK_NODES];
        stack[0] = (0, root.distance_squared(query));
        let mut n_pending = 1;
        while n_pending > 0 {
            n_pending -= 1;
            let (node, box_distance) = stack[n_pending];
            if box_distance > limit {
                continue;
            }
            match self.nodes[node as usize].content {
                Content::Leaf { first, end } => {
                    for triangle in first as usize..end as usize {
                        let (face, corners) = (self.faces[triangle], &self.triangles[triangle]);
                        let (low, high) = box_of(corners);
                        if distance_squared(&low, &high, query) > limit {
                            continue;
                        }
                        let (point, weights) = closest_on_triangle(corners, query);
                        let distance = (query - point).norm_squared();
                        let first_of_equals = best.is_none_or(|(other, ..)| face < other);
                        if distance < limit || (distance == limit && first_of_equals) {
                            limit = distance;
                            best = Some((face, weights, point));
                        }
                    }
                }
                Content::Inner { second_child } => {
                    let child =
                        |index: u32| (index, self.nodes[index as usize].distance_squared(query));
                    let (mut far, mut near) = (child(second_child), child(node + 1));
                    if far.1 < near.1 {
                        (far, near) = (near, far);
                    }
                    stack[n_pending] = far;
                    stack[n_pending + 1] = near;
                    n_pending += 2;
                }
            }
        }
        best.map(|(face, barycentric, point)| ClosestPoint {
            face: face as usize,
            point,
            distance: limit.sqrt(),
            barycentric,
        })
    }

    /// Whether a ray meets the mesh, from either side, at `origin + t·direction` with 0 < t < `max_t`.
    ///
    /// Rays through an edge may slip between its faces by rounding; callers start off the surface and allow for that.
    pub fn occluded(&self, origin: &Point3<f64>, direction: &Vector3<f64>, max_t: f64) -> bool {
        if self.nodes.is_empty() {
            return false;
        }
        let inverse = direction.map(|d| 1.0 / d);
        let mut stack = [0u32; STACK_NODES];
        let mut n_pending = 1;
        while n_pending > 0 {
            n_pending -= 1;
            let index = stack[n_pending];
            let node = &self.nodes[index as usize];
            if !node.is_crossed(origin, &inverse, max_t) {
                continue;
            }
            match node.content {
                Content::Leaf { first, end } => {
                    let triangles = &self.triangles[first as usize..end as usize];
                    if triangles.iter().any(|triangle| {
                        ray_meets(triangle, origin, direction).is_some_and(|t| t > 0.0 && t < max_t)
                    }) {
                        return true;
                    }
                }
                Content::Inner { second_child } => {
                    stack[n_pending] = second_child;
                    stack[n_pending + 1] = index + 1;
                    n_pending += 2;
                }
            }
        }
        false
    }

    /// Appends the subtree of `items` (at least one) and returns its box.
    fn build(&mut self, mesh: &TriMesh, items: &mut [Item]) -> (Vector3<f64>, Vector3<f64>) {
        let index = self.nodes.len();
        let first = self.faces.len() as u32;
        let end = first + items.len() as u32;
        self.nodes.push(Node {
            low: Vector3::repeat(f64::INFINITY),
            high: Vector3::repeat(f64::NEG_INFINITY),
            content: Content::Leaf { first, end },
        });
        let (low, high) = if items.len() <= LEAF_FACES {
            items.sort_unstable_by_key(|item| item.face);
            self.push_triangles(mesh, items)
        } else {
            let (left, right) = halve(items);
            let a = self.build(mesh, left);
            let second_child = self.nodes.len() as u32;
            self.nodes[index].content = Content::Inner { second_child };
            let b = self.build(mesh, right);
            (a.0.inf(&b.0), a.1.sup(&b.1))
        };
        (self.nodes[index].low, self.nodes[index].high) = (low, high);
        (low, high)
    }

    /// Appends the triangles of a leaf and returns their box.
    fn push_triangles(&mut self, mesh: &TriMesh, items: &[Item]) -> (Vector3<f64>, Vector3<f64>) {
        let mut low = Vector3::repeat(f64::INFINITY);
        let mut high = Vector3::repeat(f64::NEG_INFINITY);
        for item in items {
            let triangle = mesh.corners(item.face as usize);
            let around = box_of(&triangle);
            (low, high) = (low.inf(&around.0), high.sup(&around.1));
            self.triangles.push(triangle);
            self.faces.push(item.face);
        }
        (low, high)
    }
}

impl Node {
    /// Squared distance of a point from the box; 0 within.
    fn distance_squared(&self, point: &Point3<f64>) -> f64 {
        distance_squared(&self.low, &self.high, point)
    }

    /// Whether the ray of this origin and inverse direction passes through the box before `max_t`.
    fn is_crossed(&self, origin: &Point3<f64>, inverse: &Vector3<f64>, max_t: f64) -> bool {
        let (mut enter, mut leave) = (0.0f64, max_t);
        for axis in 0..3 {
            let a = (self.low[axis] - origin[axis]) * inverse[axis];
            let b = (self.high[axis] - origin[axis]) * inverse[axis];
            // A ray within the plane of a side gives 0·∞; `max` and `min` pass over the NaN, which keeps the box.
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        enter <= leave
    }
}

/// The box of a triangle.
fn box_of([a, b, c]: &[Point3<f64>; 3]) -> (Vector3<f64>, Vector3<f64>) {
    let low = a.coords.inf(&b.coords).inf(&c.coords);
    (low, a.coords.sup(&b.coords).sup(&c.coords))
}

/// Squared distance of a point from a box; 0 within.
fn distance_squared(low: &Vector3<f64>, high: &Vector3<f64>, point: &Point3<f64>) -> f64 {
    let (below, above) = (low - point.coords, point.coords - high);
    below.sup(&above).sup(&Vector3::zeros()).norm_squared()
}

/// A face while the tree is built; `f32` suffices to sort by and halves the memory that is moved.
#[derive(Clone, Copy)]
struct Item {
    centroid: [f32; 3],
    face: u32,
}

impl Item {
    fn new(mesh: &TriMesh, face: usize) -> Option<Self> {
        let centroid = mesh.centroid(face).coords;
        centroid.iter().all(|x| x.is_finite()).then(|| Item {
            centroid: centroid.map(|x| x as f32).into(),
            face: face as u32,
        })
    }
}

/// Splits items at the median along the axis on which their centroids spread most.
fn halve(items: &mut [Item]) -> (&mut [Item], &mut [Item]) {
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for item in items.iter() {
        for axis in 0..3 {
            low[axis] = low[axis].min(item.centroid[axis]);
            high[axis] = high[axis].max(item.centroid[axis]);
        }
    }
    let spread = |axis: usize| high[axis] - low[axis];
    let axis = (1..3).fold(0, |best, axis| {
        if spread(axis) > spread(best) {
            axis
        } else {
            best
        }
    });
    let middle = items.len() / 2;
    items.select_nth_unstable_by(middle, |a, b| {
        a.centroid[axis]
            .total_cmp(&b.centroid[axis])
            .then(a.face.cmp(&b.face))
    });
    items.split_at_mut(middle)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::triangle::tests::{point, uniform};

    /// Small triangles scattered over the unit cube; every tenth is a needle without area.
    fn scattered_triangles(n: usize, random: &mut impl FnMut() -> f64) -> TriMesh {
        let mut mesh = TriMesh::default();
        for face in 0..n {
            let a = point(random);
            let b = a + (point(random) - a) * 0.1;
            let c = if face % 10 == 0 {
                a + (b - a) * 0.5
            } else {
                a + (point(random) - a) * 0.1
            };
            let first = mesh.vertices.len() as u32;
            mesh.vertices.extend([a, b, c]);
            mesh.faces.push([first, first + 1, first + 2]);
        }
        mesh
    }

    #[test]
    fn closest_points_are_those_of_brute_force() {
        let mut random = uniform(7);
        for n in [1, 8, 9, 700] {
            let mesh = scattered_triangles(n, &mut random);
            let bvh = TriangleBvh::new(&mesh);
            for _ in 0..300 {
                let query = Point3::from(point(&mut random).coords * 2.0);
                let found = bvh
                    .closest_point(&query, f64::INFINITY)
                    .expect("there are faces");
                let least = (0..n)
                    .map(|face| (closest_on_triangle(&mesh.corners(face), &query).0 - query).norm())
                    .fold(f64::INFINITY, f64::min);
                assert!((found.distance - least).abs() < 1e-12);
                assert!(((found.point - query).norm() - least).abs() < 1e-12);
                let corners = mesh.corners(found.face);
                let weighted = (0..3).fold(Vector3::zeros(), |sum, corner| {
                    sum + corners[corner].coords * found.barycentric[corner]
                });
                assert!((weighted - found.point.coords).norm() < 1e-12);
                assert!(bvh.closest_point(&query, least * 0.999).is_none());
                assert!(bvh.closest_point(&query, least * 1.001).is_some());
            }
        }
    }

    #[test]
    fn rays_are_occluded_as_by_brute_force() {
        let mut random = uniform(13);
        let mesh = scattered_triangles(500, &mut random);
        let bvh = TriangleBvh::new(&mesh);
        let mut n_occluded = 0;
        for _ in 0..1000 {
            let origin = point(&mut random);
            let mut direction = point(&mut random) - origin;
            if random() < 0.2 {
                direction.y = 0.0;
            }
            let expected = (0..mesh.faces.len()).any(|face| {
                ray_meets(&mesh.corners(face), &origin, &direction)
                    .is_some_and(|t| t > 0.0 && t < 1.0)
            });
            assert_eq!(bvh.occluded(&origin, &direction, 1.0), expected);
            n_occluded += usize::from(expected);
        }
        assert!((100..900).contains(&n_occluded), "{n_occluded}");
    }

    #[test]
    fn of_equally_close_faces_the_first_is_returned() {
        let mut mesh = scattered_triangles(1, &mut uniform(3));
        mesh.faces = vec![mesh.faces[0]; 100];
        let found = TriangleBvh::new(&mesh).closest_point(&Point3::origin(), 10.0);
        assert_eq!(found.map(|closest| closest.face), Some(0));
    }

    #[test]
    fn a_mesh_without_faces_has_no_closest_point() {
        let bvh = TriangleBvh::new(&TriMesh::default());
        assert!(
            bvh.closest_point(&Point3::origin(), f64::INFINITY)
                .is_none()
        );
        assert!(!bvh.occluded(&Point3::origin(), &Vector3::x(), 1.0));
    }
}
