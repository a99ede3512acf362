//! A surface measured by something better, and what of it a scan could have seen.

use super::weld::welded;
use crate::geometry::{CameraModel, EdgeAdjacency, PointGrid, Pose, TriMesh, TriangleBvh};
use nalgebra::{Point3, Vector3};

/// Cosine of incidence below which a surface does not count as seen.
const MIN_COSINE: f64 = 0.35;
/// Nearest depth that a camera measures, metres.
const MIN_DEPTH_M: f64 = 0.3;
/// Points this near the open border of the truth are left out, metres: beyond it there is surface that the truth lacks.
pub(super) const RIM_M: f64 = 0.006;

/// The part of a true surface that is compared with.
pub struct Truth {
    mesh: TriMesh,
    normals: Vec<Vector3<f64>>,
    bvh: TriangleBvh,
    rim: PointGrid,
    /// Box of what is compared.
    low: Point3<f64>,
    high: Point3<f64>,
}

/// The place on the truth that is closest to a point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Closest {
    /// It, metres.
    pub point: Point3<f64>,
    /// The truth's normal there, interpolated over the face.
    pub normal: Vector3<f64>,
    /// Its distance, metres.
    pub distance_m: f64,
}

impl Truth {
    /// Prepares a true mesh; what lies within a box (smallest and largest corner, the truth's frame) is compared, all of it
    /// without one. Where vertices lie at one place there is no border, as along the seams of a texture.
    pub fn new(mesh: TriMesh, bounds: Option<[Point3<f64>; 2]>) -> Self {
        let mesh = welded(&mesh);
        let whole = || {
            let [low, high] = ends(&mesh);
            // The box's own border is kept away from, which here is no cut.
            let air = Vector3::repeat(BORDER_M);
            [low - air, high + air]
        };
        let [low, high] = bounds.unwrap_or_else(whole);
        Truth {
            normals: mesh.vertex_normals(),
            bvh: TriangleBvh::new(&mesh),
            rim: PointGrid::new(border_points(&mesh), RIM_M),
            mesh,
            low,
            high,
        }
    }

    /// The true mesh.
    pub(super) fn mesh(&self) -> &TriMesh {
        &self.mesh
    }

    /// Its normals at the vertices.
    pub(super) fn normals(&self) -> &[Vector3<f64>] {
        &self.normals
    }

    /// Its longest side, metres.
    pub(super) fn width_m(&self) -> f64 {
        let [low, high] = ends(&self.mesh);
        (high - low).max()
    }

    /// Whether a point lies in the box made wider by so much, metres.
    pub(super) fn contains(&self, point: &Point3<f64>, wider_m: f64) -> bool {
        (0..3).all(|axis| {
            point[axis] > self.low[axis] - wider_m && point[axis] < self.high[axis] + wider_m
        })
    }

    /// Whether a point of the truth is compared: within the box and off the rim.
    pub(super) fn counts(&self, point: &Point3<f64>) -> bool {
        self.contains(point, -BORDER_M) && self.rim.near(point).next().is_none()
    }

    /// The closest place no farther away than `reach_m`.
    pub(super) fn closest(&self, point: &Point3<f64>, reach_m: f64) -> Option<Closest> {
        let found = self.bvh.closest_point(point, reach_m)?;
        let corners = self.mesh.faces[found.face].iter().zip(found.barycentric);
        let normal: Vector3<f64> = corners
            .map(|(&vertex, weight)| self.normals[vertex as usize] * weight)
            .sum();
        Some(Closest {
            point: found.point,
            normal: normal.try_normalize(0.0)?,
            distance_m: found.distance,
        })
    }

    /// Whether one of the cameras (poses: truth from camera) sees a point of the truth, not grazing and not hidden.
    pub(super) fn is_seen(
        &self,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
        camera: &CameraModel,
        truth_from_cameras: &[Pose],
    ) -> bool {
        truth_from_cameras.iter().any(|pose| {
            let centre = Point3::from(pose.translation.vector);
            let towards = centre - point;
            let point_camera = pose.inverse_transform_point(point);
            let pixel = camera.project(&point_camera);
            normal.dot(&towards) > MIN_COSINE * towards.norm()
                && point_camera.z > MIN_DEPTH_M
                && pixel.is_some_and(|pixel| camera.contains(&pixel, 2.0))
                && {
                    let off = point + normal * 1e-3;
                    !self.bvh.occluded(&off, &(centre - off), 1.0)
                }
        })
    }
}

/// The smallest and the largest corner of a mesh's box; the origin for one without vertices.
fn ends(mesh: &TriMesh) -> [Point3<f64>; 2] {
    let first = mesh.vertices.first().copied().unwrap_or(Point3::origin());
    let vertices = mesh.vertices.iter();
    vertices.fold([first; 2], |[low, high], vertex| {
        [low.inf(vertex), high.sup(vertex)]
    })
}

/// Points this near the border of the box are left out, metres.
const BORDER_M: f64 = 0.003;

/// The vertices at edges of one face.
fn border_points(mesh: &TriMesh) -> Vec<Point3<f64>> {
    let edges = EdgeAdjacency::new(mesh);
    let open = edges
        .edges
        .iter()
        .zip(&edges.n_faces)
        .filter(|(_, n)| **n == 1);
    let mut vertices: Vec<u32> = open.flat_map(|(edge, _)| *edge).collect();
    vertices.sort_unstable();
    vertices.dedup();
    vertices
        .iter()
        .map(|&vertex| mesh.vertices[vertex as usize])
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn on_plane(x: f64, y: f64) -> Point3<f64> {
        Point3::new(x, y, 0.3 * x + 0.2 * y)
    }

    /// A square of 40 mm in triangles of 5 mm, of which no two share a vertex.
    fn single_triangles() -> TriMesh {
        let at = |column: usize, row: usize| on_plane(0.005 * column as f64, 0.005 * row as f64);
        let cells = (0..64).map(|cell| (cell % 8, cell / 8));
        let corners = cells.flat_map(|(x, y)| {
            let (b, c) = (at(x + 1, y), at(x, y + 1));
            [at(x, y), b, c, c, b, at(x + 1, y + 1)]
        });
        TriMesh {
            vertices: corners.collect(),
            faces: (0..128)
                .map(|face| [3 * face, 3 * face + 1, 3 * face + 2])
                .collect(),
        }
    }

    #[test]
    fn a_seam_is_no_border() {
        let truth = Truth::new(single_triangles(), None);
        assert!(truth.counts(&on_plane(0.02, 0.02)));
        assert!(!truth.counts(&on_plane(0.004, 0.02)));
    }
}
