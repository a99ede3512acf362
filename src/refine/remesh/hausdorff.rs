//! How far a remeshed surface lies from its source: Hausdorff distance and root mean square, by points of either.

use crate::geometry::{TriMesh, TriangleBvh};
use nalgebra::Point3;
use rayon::prelude::*;

/// Most points that are asked each way, so that the time stays that of the two hierarchies; arbitrary.
const MAX_POINTS: usize = 20_000;

/// How far points of one surface lie from another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Distances {
    /// Points that were asked.
    pub n_points: usize,
    /// The largest, metres.
    pub max_m: f64,
    /// Root mean square, metres.
    pub rms_m: f64,
}

/// How far a remeshed surface and its source lie apart: Hausdorff distance over at most 20 000 points each way, every n-th where there
/// are more.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RemeshDistance {
    /// From vertices of the source to the mesh; those of parts that remeshing removed are among them.
    pub from_source: Distances,
    /// From middles of the mesh's faces to the source, on which its vertices lie.
    pub from_mesh: Distances,
}

impl RemeshDistance {
    /// Measures it both ways.
    pub fn between(source: &TriMesh, mesh: &TriMesh) -> RemeshDistance {
        let n_vertices = source.vertices.len();
        let (from_source, from_mesh) = rayon::join(
            || Distances::to(mesh, n_vertices, |vertex| source.vertices[vertex]),
            || Distances::to(source, mesh.faces.len(), |face| mesh.centroid(face)),
        );
        RemeshDistance {
            from_source,
            from_mesh,
        }
    }

    /// The larger of the largest, metres.
    pub fn hausdorff_m(&self) -> f64 {
        self.from_source.max_m.max(self.from_mesh.max_m)
    }
}

impl Distances {
    /// From `n_points` points, or every n-th of them, to a surface; those that are not finite are passed over.
    fn to(
        surface: &TriMesh,
        n_points: usize,
        point: impl Fn(usize) -> Point3<f64> + Sync,
    ) -> Distances {
        let bvh = TriangleBvh::new(surface);
        let step = n_points.div_ceil(MAX_POINTS).max(1);
        let distance = |k: usize| {
            let closest = bvh.closest_point(&point(k * step), f64::INFINITY);
            closest.map(|closest| closest.distance)
        };
        let asked = (0..n_points.div_ceil(step)).into_par_iter();
        let distances: Vec<f64> = asked.filter_map(distance).collect();
        let squares: f64 = distances.iter().map(|distance| distance * distance).sum();
        Distances {
            n_points: distances.len(),
            max_m: distances.iter().copied().fold(0.0, f64::max),
            rms_m: (squares / distances.len().max(1) as f64).sqrt(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::scenes::{level_set, plane, sphere};
    use super::super::{RemeshParams, remesh};
    use super::*;

    #[test]
    fn a_shifted_plane_is_as_far_as_it_was_shifted() {
        let source = plane(160);
        let mut mesh = source.clone();
        mesh.vertices.iter_mut().for_each(|vertex| vertex.z += 0.01);
        let RemeshDistance {
            from_source,
            from_mesh,
        } = RemeshDistance::between(&source, &mesh);
        for distances in [from_source, from_mesh] {
            assert!((distances.max_m - 0.01).abs() < 1e-12, "{distances:?}");
            assert!((distances.rms_m - 0.01).abs() < 1e-12, "{distances:?}");
        }
        // Every second of 25 921 vertices, every third of 51 200 faces.
        assert_eq!(from_source.n_points, 12_961);
        assert_eq!(from_mesh.n_points, 17_067);
    }

    #[test]
    fn what_was_removed_counts_one_way() {
        let source = plane(40);
        let mesh = source.filter_faces(|face| source.centroid(face).x < 0.5);
        let distance = RemeshDistance::between(&source, &mesh);
        // Faces of 25 mm and vertices scattered by 10 mm make a ragged border.
        assert!((distance.hausdorff_m() - 0.5).abs() < 0.06, "{distance:?}");
        assert!(distance.from_source.rms_m < 0.3, "{distance:?}");
        assert!(distance.from_mesh.max_m < 1e-12, "{distance:?}");
    }

    #[test]
    fn a_sphere_is_off_by_the_sagitta_of_its_faces() {
        let source = level_set(40, |p| sphere(p, [0.0, 0.0, 0.0], 0.8));
        let mesh = remesh(&source, &RemeshParams::new(0.1));
        // r²/2R with the circumradius r of equilateral faces; edges are up to 4/3 of the wanted length, the source has facets, too.
        let sagitta_m = 0.1f64.powi(2) / 3.0 / 1.6;
        let distance = RemeshDistance::between(&source, &mesh);
        let hausdorff_m = distance.hausdorff_m();
        assert!(
            (0.5..3.0).contains(&(hausdorff_m / sagitta_m)),
            "{distance:?}"
        );
        assert!(distance.from_mesh.rms_m < 1.5 * sagitta_m, "{distance:?}");
    }
}
