//! Where the surface is compared with the images: one site a facet, at its centroid.

use super::energy::unit_normal;
use super::view::View;
use crate::geometry::TriMesh;
use nalgebra::Point3;
use rayon::prelude::*;

/// The sites of a mesh and the views that see them.
pub struct Sites {
    /// Centroid of each face.
    pub points: Vec<Point3<f64>>,
    /// Bit k of a face is set where view k sees it.
    pub visible: Vec<ViewSet>,
}

/// How well a view's image is predicted.
pub struct ViewError {
    /// Sites that the view sees.
    pub n_sites: usize,
    /// Root mean square of observed less predicted linear intensity, as a share of the mean observed one.
    pub rmse: f64,
}

/// A set of views: bit k stands for view k.
pub type ViewSet = u64;

impl Sites {
    /// Finds the sites of a mesh and who of a set of views sees them.
    pub fn new(mesh: &TriMesh, views: &[View], set: ViewSet) -> Sites {
        let points: Vec<Point3<f64>> = (0..mesh.faces.len())
            .map(|face| mesh.centroid(face))
            .collect();
        let visible = points
            .par_iter()
            .enumerate()
            .map(|(face, point)| {
                let Some((normal, _)) = unit_normal(mesh, face) else {
                    return 0;
                };
                let seen = views
                    .iter()
                    .enumerate()
                    .filter(|(k, view)| set >> k & 1 == 1 && view.sees(point, &normal));
                seen.fold(0, |mask, (k, _)| mask | 1 << k)
            })
            .collect();
        Sites { points, visible }
    }

    /// The same sites, seen by a set of views alone.
    pub fn only(&self, set: ViewSet) -> Sites {
        Sites {
            points: self.points.clone(),
            visible: self.visible.iter().map(|visible| visible & set).collect(),
        }
    }

    /// The faces that a view sees.
    pub fn faces_of(&self, view: usize) -> Vec<u32> {
        (0..self.visible.len() as u32)
            .filter(|&face| self.visible[face as usize] >> view & 1 == 1)
            .collect()
    }

    /// Rendered against observed linear intensity, by view.
    pub fn view_errors(&self, mesh: &TriMesh, views: &[View], albedo: &[f64]) -> Vec<ViewError> {
        views
            .par_iter()
            .enumerate()
            .map(|(k, view)| {
                let (mut square, mut sum, mut n_sites) = (0.0, 0.0, 0usize);
                for face in self.faces_of(k) {
                    let face = face as usize;
                    let Some((normal, _)) = unit_normal(mesh, face) else {
                        continue;
                    };
                    let Some(sample) = view.sample(&self.points[face], &normal) else {
                        continue;
                    };
                    square +=
                        (sample.look.observed - albedo[face] * sample.unit_prediction).powi(2);
                    sum += sample.look.observed;
                    n_sites += 1;
                }
                let n = n_sites.max(1) as f64;
                ViewError {
                    n_sites,
                    rmse: (square / n).sqrt() / (sum / n).max(f64::MIN_POSITIVE),
                }
            })
            .collect()
    }
}
