//! The value of the energy of Eq. (5), and the tints of the sites that it is about least for.

use super::MAX_VIEWS;
use super::energy::Problem;
use super::side_by_side::{OfSites, Placed, SITES, Seen, Shown, unit_normals};
use super::sites::SiteKind;
use super::surface::{Surface, unit_normal};
use super::tiles::tiles;
use super::tint::{Tint, best_tints};
use crate::geometry::TriMesh;
use nalgebra::Vector3;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use std::ops::Range;

/// The energy of a surface with given albedos of the groups, and the tints that it is about least for.
pub struct Evaluation {
    /// Its value.
    pub energy: f64,
    /// Tint of each site; `None` where it does not follow the surface and is as it was thought to be.
    pub tints: Vec<Option<Tint>>,
}

/// Unit normals of a surface's sites.
enum Normals<'a> {
    OfFaces(&'a TriMesh),
    OfVertices(Vec<Vector3<f64>>),
}

impl Normals<'_> {
    /// Of a site; `None` where it has no area.
    #[inline]
    fn unit(&self, site: usize) -> Option<Vector3<f64>> {
        match self {
            Normals::OfFaces(mesh) => unit_normal(mesh, site).map(|(normal, _)| normal),
            Normals::OfVertices(normals) => {
                Some(normals[site]).filter(|normal| *normal != Vector3::zeros())
            }
        }
    }
}

impl Problem<'_> {
    /// Energy of the surface with the groups' albedos.
    pub fn evaluate(&self, surface: &Surface, albedos: &[f64]) -> Evaluation {
        let normals = match self.sites {
            SiteKind::Face => Normals::OfFaces(&surface.mesh),
            SiteKind::Vertex => Normals::OfVertices(surface.mesh.vertex_normals()),
        };
        let arch = Arch::new();
        let of_tile = |sites: Range<usize>| {
            arch.dispatch(EvaluateTile {
                problem: self,
                surface,
                albedos,
                normals: &normals,
                sites,
            })
        };
        // The priors keep one thread busy.
        let (prior, tiles) = rayon::join(
            || self.prior_energy(&surface.total_m),
            || tiles(self.labels.len()).map(of_tile).collect::<Vec<_>>(),
        );
        Evaluation {
            energy: tiles.iter().map(|(energy, _)| energy).sum::<f64>() + prior,
            tints: tiles.into_iter().flat_map(|(_, tints)| tints).collect(),
        }
    }
}

/// What some sites add to the energy.
struct EvaluateTile<'a> {
    problem: &'a Problem<'a>,
    surface: &'a Surface,
    albedos: &'a [f64],
    normals: &'a Normals<'a>,
    sites: Range<usize>,
}

/// Room for what views show of sites side by side.
struct Views {
    seen: Vec<Seen>,
    shown: Vec<Shown>,
}

impl WithSimd for EvaluateTile<'_> {
    type Output = (f64, Vec<Option<Tint>>);

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Self::Output {
        let mut energy = 0.0;
        let mut tints = Vec::with_capacity(self.sites.len());
        let mut views = Views {
            seen: Vec::with_capacity(MAX_VIEWS),
            shown: Vec::with_capacity(MAX_VIEWS),
        };
        for first in self.sites.clone().step_by(SITES) {
            let sites = first..(first + SITES).min(self.sites.end);
            let n_sites = sites.len();
            let (own, found) = self.of_lanes(sites, &mut views);
            for lane in 0..n_sites {
                let held = match &found[lane] {
                    Some(tint) => tint.energy(),
                    None => 0.0,
                };
                energy += own[lane] + held;
            }
            tints.extend_from_slice(&found[..n_sites]);
        }
        (energy, tints)
    }
}

impl EvaluateTile<'_> {
    /// What the views of sites add to the energy, and the tints that follow the surface.
    #[inline(always)]
    fn of_lanes(&self, sites: Range<usize>, views: &mut Views) -> (OfSites, [Option<Tint>; SITES]) {
        let Problem {
            observations, loss, ..
        } = self.problem;
        let Views { seen, shown } = views;
        // Where there is no area nothing is seen.
        let normals = unit_normals(sites.clone(), |site| self.normals.unit(site));
        let placed = Placed::new(observations, self.surface, sites.start, &normals, seen);
        let (mut group, mut albedo) = ([0.0; SITES], [0.0; SITES]);
        let mut start = [1.0; SITES];
        for (lane, site) in sites.enumerate() {
            group[lane] = self.albedos[self.problem.labels[site] as usize];
            start[lane] = self.problem.tints[site];
        }
        // A view that a step turns a site away from does not cease to count: it shows what unlit surface would not.
        shown.clear();
        for seen in seen.iter() {
            shown.push(seen.shown(&placed));
        }
        let tints = match self.problem.finds_tints {
            true => best_tints(shown, &placed.n_views, &group, *loss, &start),
            false => [None; SITES],
        };
        for lane in 0..SITES {
            let factor = match &tints[lane] {
                Some(tint) => tint.factor,
                None => start[lane],
            };
            albedo[lane] = group[lane] * factor;
        }
        let mut data = [0.0; SITES];
        for shown in shown.iter() {
            let residuals = shown.residuals(&albedo);
            for i in 0..SITES {
                data[i] += shown.covered[i] * loss.loss(residuals[i]);
            }
        }
        (data, tints)
    }
}
