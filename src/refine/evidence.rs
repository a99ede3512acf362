//! What the images say of every vertex of a refined surface, beside where they put it.
//!
//! *Sigma* is the standard deviation of a vertex's displacement given all images: the root of the diagonal of the inverse of
//! the normal matrix at the solution, robust weights and neighbours' displacements included. *Confidence* is the share of
//! the variance without images that the images took away. *Coverage* looks at tilt alone: of the direction about which the
//! tilt of the surface round a vertex is known worst, the share of what is known that the images say and not the prior.
//! A surface seen along the light alone has a coverage of 0, from however many views.
//!
//! Where sites are at vertices, the normal matrix here is the bound that couples by edges alone.
//!
//! Not covered: errors that all views share, such as those of the calibration, and a wrong albedo of a whole group. Sigma is
//! therefore one of detail: on a scan with known truth it puts vertices in the order of their errors, and lies between the error
//! of their detail and the whole one, in which the slow shape is.

use super::energy::Problem;
use super::rounds::{Rounds, State, final_loss};
use super::side_by_side::{map_sites, unit_normals};
use super::site_blocks::Estimate;
use super::sites::{SiteKind, Sites, ViewSet};
use super::surface::Surface;
use super::tint::Tint;
use crate::geometry::tangents;
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector3};
use rayon::prelude::*;
use serde::Serialize;

/// The residuals of a site go together over views and neighbours, which makes the data so many times too sure;
/// `RefineParams::patch_sigma_m` is stated in the same units, as two fifths of depth's slow error.
const REDUNDANCY: f64 = 25.0;
/// Below this coverage the prior knows more of a tilt than the images do.
const WEAK_COVERAGE: f64 = 0.5;

/// What is known of every vertex.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Evidence {
    /// Standard deviation of the displacement, metres.
    pub sigma_m: Vec<f64>,
    /// Share of the displacement's variance that the images took away, 0 to 1.
    pub confidence: Vec<f64>,
    /// Share of what is known of the worst known tilt that the images say, 0 to 1; what may be tint as well they do not say.
    pub coverage: Vec<f64>,
    /// Views that see the surface round the vertex; where there are none the surface is as it was fused, but for some 8 mm beside what
    /// they see, where it goes along.
    pub n_views: Vec<u8>,
}

/// All of it in few numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct EvidenceSummary {
    /// Share of the vertices that no view sees.
    pub unseen_share: f64,
    /// Share of the vertices that views see, but of whose tilt the prior knows more than they do.
    pub weak_share: f64,
    /// Views of a vertex, median over those that are seen.
    pub median_views: usize,
    /// Sigma, median over those that are seen, metres.
    pub median_sigma_m: f64,
    /// Nine tenths of those that are seen have no larger one, metres.
    pub high_sigma_m: f64,
}

impl Evidence {
    /// As it is for vertices made from others: `from` names the old vertex of each new one.
    pub fn of_vertices(&self, from: &[u32]) -> Evidence {
        let pick = |values: &[f64]| from.iter().map(|&old| values[old as usize]).collect();
        Evidence {
            sigma_m: pick(&self.sigma_m),
            confidence: pick(&self.confidence),
            coverage: pick(&self.coverage),
            n_views: from.iter().map(|&old| self.n_views[old as usize]).collect(),
        }
    }

    /// In few numbers.
    pub fn summary(&self) -> EvidenceSummary {
        let n = self.n_views.len().max(1) as f64;
        let seen = || (0..self.n_views.len()).filter(|&vertex| self.n_views[vertex] > 0);
        let mut sigmas: Vec<f64> = seen().map(|vertex| self.sigma_m[vertex]).collect();
        let mut counts: Vec<u8> = seen().map(|vertex| self.n_views[vertex]).collect();
        sigmas.sort_unstable_by(f64::total_cmp);
        counts.sort_unstable();
        let n_weak = seen()
            .filter(|&vertex| self.coverage[vertex] < WEAK_COVERAGE)
            .count();
        let sigma_at = |share: f64| {
            let last = sigmas.len().saturating_sub(1);
            sigmas
                .get((share * last as f64) as usize)
                .copied()
                .unwrap_or(0.0)
        };
        EvidenceSummary {
            unseen_share: (n - sigmas.len() as f64).max(0.0) / n,
            weak_share: n_weak as f64 / n,
            median_views: counts.get(counts.len() / 2).copied().map_or(0, usize::from),
            median_sigma_m: sigma_at(0.5),
            high_sigma_m: sigma_at(0.9),
        }
    }
}

impl Rounds<'_> {
    /// What the views that see a state's sites say of its surface; `None` if memory does not suffice.
    pub fn evidence(&self, state: &State, sites: &Sites) -> Option<Evidence> {
        let State {
            surface,
            views,
            albedo,
        } = state;
        let observations = self.observe(sites, surface, views, None);
        let loss = final_loss(observations.residual_scale(sites, &albedo.by_site));
        let problem = self.problem(&observations, albedo, loss);
        let tints = problem.tints_apart(surface, &albedo.groups);
        let couplings = self.level.pattern.couplings();
        let mut with_images = problem.linearise(surface, &albedo.groups, &tints, couplings);
        // Inverses need no more than the matrix, and much memory.
        with_images.at_vertices = None;
        let without = problem.prior_matrix(&surface.total_m, couplings);
        let variances = |matrix| self.level.pattern.inverse_diagonal(matrix);
        let (posterior, prior) = rayon::join(|| variances(&with_images), || variances(&without));
        let (posterior, prior) = (posterior?, prior?);
        let sigma = |variance: &f64| (REDUNDANCY * variance).sqrt();
        let pairs = posterior.iter().zip(&prior);
        Some(Evidence {
            sigma_m: posterior.iter().map(sigma).collect(),
            confidence: pairs
                .map(|(with, without)| (1.0 - with / without).clamp(0.0, 1.0))
                .collect(),
            coverage: self.coverage(&problem, surface, (&albedo.groups, &tints), sites),
            n_views: views_of_vertices(surface, sites),
        })
    }

    fn coverage(
        &self,
        problem: &Problem,
        surface: &Surface,
        (albedos, tints): (&[f64], &[Option<Tint>]),
        sites: &Sites,
    ) -> Vec<f64> {
        let slope_sigma = self.params.slope_sigma_rad;
        let prior = 1.0 / (slope_sigma * slope_sigma);
        // What its observations say of its tilt, per rad².
        let estimate = Estimate {
            surface,
            albedos,
            tints,
        };
        let of_sites = map_sites(tints.len(), |indices, room| {
            let first = indices.start;
            let normals = unit_normals(indices, |site| Some(sites.normals[site]));
            let blocks = problem.blocks(&estimate, first, &normals, room);
            blocks.map(|block| Matrix3::from(block.jtj.fixed_view::<3, 3>(0, 0)))
        });
        let sums = match sites.kind {
            SiteKind::Face => {
                let mesh = &surface.mesh;
                mesh.sums_at_vertices(Matrix3::zeros(), |face| of_sites[face])
            }
            // It stands for a third of the facets round it.
            SiteKind::Vertex => of_sites.iter().map(|own| own * 3.0).collect(),
        };
        let normals = surface.mesh.vertex_normals();
        let share = |(information, normal): (&Matrix3<f64>, &Vector3<f64>)| {
            let worst = worst_known(information, normal) / REDUNDANCY;
            worst / (worst + prior)
        };
        sums.par_iter().zip(&normals).map(share).collect()
    }
}

/// The smaller eigenvalue of the information within the plane across a normal.
fn worst_known(information: &Matrix3<f64>, normal: &Vector3<f64>) -> f64 {
    let Some(axes) = tangents(normal) else {
        return 0.0;
    };
    let plane = Matrix2x3::from_rows(&axes.map(|axis| axis.transpose()));
    let within: Matrix2<f64> = plane * information * plane.transpose();
    let (mean, half) = (0.5 * within.trace(), 0.5 * (within.m11 - within.m22));
    (mean - half.hypot(within.m12)).max(0.0)
}

/// How many views see each vertex, or any of the facets round it.
fn views_of_vertices(surface: &Surface, sites: &Sites) -> Vec<u8> {
    let mut sets: Vec<ViewSet> = vec![0; surface.mesh.vertices.len()];
    match sites.kind {
        SiteKind::Vertex => sets.copy_from_slice(&sites.visible),
        SiteKind::Face => {
            for (face, visible) in surface.mesh.faces.iter().zip(&sites.visible) {
                for &vertex in face {
                    sets[vertex as usize] |= visible;
                }
            }
        }
    }
    sets.iter().map(|set| set.count_ones() as u8).collect()
}

#[cfg(test)]
mod tests {
    use super::super::scenes::{RippledPlane, calibration, optics, poses, rays};
    use super::super::{AlbedoParams, RefineParams, Refinement, Subject, refine};
    use super::*;
    use crate::geometry::{Pose, TriMesh};

    fn refined(object: &TriMesh, poses: &[Pose]) -> Refinement {
        refined_with(object, poses, true)
    }

    fn refined_with(object: &TriMesh, poses: &[Pose], tints: bool) -> Refinement {
        let (rays, calibration) = (rays(), calibration());
        let optics = optics(&rays, &calibration);
        let rippled = RippledPlane {
            amplitude_m: 0.0003,
        };
        let snapshots: Vec<_> = poses
            .iter()
            .map(|pose| rippled.snapshot(&optics, pose))
            .collect();
        let subject = Subject {
            scene: object,
            object,
            snapshots: &snapshots,
            optics: &optics,
        };
        let albedo = AlbedoParams {
            tints,
            ..AlbedoParams::default()
        };
        let params = RefineParams {
            edge_length_m: 0.0025,
            albedo,
            ..RefineParams::default()
        };
        refine(&subject, &params, |_| true).expect("visible")
    }

    /// Mean over the vertices in the middle of the plane.
    fn inside(mesh: &TriMesh, values: &[f64]) -> f64 {
        let middle = mesh.vertices.iter().zip(values);
        let middle: Vec<f64> = middle
            .filter(|(p, _)| p.x.abs() < 0.02 && p.y.abs() < 0.02)
            .map(|(_, value)| *value)
            .collect();
        middle.iter().sum::<f64>() / middle.len() as f64
    }

    #[test]
    fn views_from_all_sides_know_more_than_one_from_the_front() {
        let flat = RippledPlane { amplitude_m: 0.0 }.mesh(0.0025);
        let (round, front) = (
            refined(&flat, &poses(0.5)),
            refined(&flat, &poses(0.0)[..1]),
        );
        let mean = |of: &Refinement, values: &dyn Fn(&Evidence) -> Vec<f64>| {
            inside(&of.mesh, &values(&of.evidence))
        };
        let coverage = |of: &Refinement| mean(of, &|e| e.coverage.clone());
        let confidence = |of: &Refinement| mean(of, &|e| e.confidence.clone());
        assert!(coverage(&round) > 0.8, "{}", coverage(&round));
        assert!(
            coverage(&front) < 0.5 * coverage(&round),
            "{}",
            coverage(&front)
        );
        assert!(confidence(&round) > confidence(&front));
        assert_eq!(round.evidence.summary().median_views, 7);
        assert_eq!(front.evidence.summary().median_views, 1);
    }

    #[test]
    fn what_may_be_a_tint_is_not_known_as_tilt_and_a_further_view_is_no_loss() {
        let flat = RippledPlane { amplitude_m: 0.0 }.mesh(0.0025);
        let poses = poses(0.5);
        let of = |n_views: usize, tints: bool| {
            let refined = refined_with(&flat, &poses[..n_views], tints);
            let evidence = &refined.evidence;
            [&evidence.coverage, &evidence.confidence].map(|of| inside(&refined.mesh, of))
        };
        let mut before = [0.0; 2];
        for n_views in [2, 3, 4, 7] {
            let (free, held) = (of(n_views, true), of(n_views, false));
            for k in 0..2 {
                assert!(free[k] < held[k], "{n_views}: {free:?} for {held:?}");
                assert!(
                    free[k] > 0.98 * before[k],
                    "{n_views}: {free:?} after {before:?}"
                );
            }
            before = free;
        }
    }

    #[test]
    fn what_nobody_sees_has_no_evidence() {
        // The plane once more behind itself, where nobody sees it.
        let mut parts = RippledPlane { amplitude_m: 0.0 }.mesh(0.0025);
        let n_front = parts.vertices.len() as u32;
        let behind = parts.clone();
        let offset = Vector3::new(0.0, 0.0, 0.05);
        parts
            .vertices
            .extend(behind.vertices.iter().map(|vertex| vertex + offset));
        parts
            .faces
            .extend(behind.faces.iter().map(|face| face.map(|v| v + n_front)));
        let refined = refined(&parts, &poses(0.5));
        let evidence = &refined.evidence;
        for (vertex, point) in refined.mesh.vertices.iter().enumerate() {
            if point.z > 0.63 {
                assert_eq!(evidence.n_views[vertex], 0);
                assert_eq!(evidence.coverage[vertex], 0.0);
                assert!(evidence.confidence[vertex] < 1e-6);
            }
        }
        // Those of the front too that lie on its rim, where depth is not smooth.
        let unseen = evidence.summary().unseen_share;
        assert!(unseen > 0.5 && unseen < 0.65, "{unseen}");
    }
}
