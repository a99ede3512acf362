//! The energy of Eq. (5): data term Eq. (6) at all sites over all views, with what holds their tints, smoothness Eq. (7) and anchor
//! Eq. (8) on the total displacement; its value, and its normal equations by the displacements along fixed directions.
//!
//! A face site has the facet's own normal, so that each residual touches three displacements. All views of a site share that
//! pattern and are summed into one 3×3 block. Sites at vertices touch more ([`VertexSystem`]). Sums run over fixed tiles, in
//! order.

use super::couplings::Couplings;
use super::numeric::{DisplacedNormals, JacobianMode};
use super::observations::{Observation, Observations};
use super::patches::Patch;
use super::priors::PriorWeights;
use super::sites::SiteKind;
use super::surface::{Surface, normal_by_displacement, unit_normal};
use super::tint::Tint;
use super::vertex_system::VertexSystem;
use crate::geometry::EdgeAdjacency;
use crate::robust::Tukey;
use nalgebra::{SMatrix, SVector, Vector3};
use rayon::prelude::*;

/// What stays fixed while displacements are solved for.
pub struct Problem<'a> {
    /// Where the residuals are.
    pub sites: SiteKind,
    /// What the views show at each site: sampled and lit where it was at the start of the round.
    pub observations: &'a Observations,
    /// Group of albedo of each site.
    pub labels: &'a [u8],
    /// By which factor the albedo of each site differs from its group's, or is first thought to.
    pub tints: &'a [f64],
    /// Whether tints follow the surface, each at its best value.
    pub finds_tints: bool,
    /// Scale of the residuals in sigmas, and the Tukey cut-off in that scale.
    pub loss: Tukey,
    /// Priors.
    pub priors: PriorWeights,
    /// Patches whose mean displacement is held.
    pub patches: &'a [Patch],
    /// Edges of the mesh.
    pub edges: &'a EdgeAdjacency,
    /// How the derivatives of the data term are found; those at vertices are exact.
    pub jacobian: JacobianMode,
}

/// Normal equations: `diagonal` by vertex, `off_diagonal` by edge, `gradient` by vertex; the groups' albedos beside them.
#[derive(Clone, Debug)]
pub struct NormalMatrix {
    /// One entry a vertex.
    pub diagonal: Vec<f64>,
    /// One entry a coupling.
    pub off_diagonal: Vec<f64>,
    /// Derivative of the energy by each displacement.
    pub gradient: Vec<f64>,
    /// One for each group of albedo.
    pub groups: Vec<GroupTerms>,
    /// The data term of sites at vertices, which couples more than edges: `diagonal` and `off_diagonal` then have an upper bound
    /// of it in its place.
    pub at_vertices: Option<VertexSystem>,
}

/// What the normal equations hold of the logarithm of one group's albedo. Groups share no site and so do not couple.
#[derive(Clone, Debug)]
pub struct GroupTerms {
    /// With itself.
    pub diagonal: f64,
    /// With the displacement of each vertex.
    pub coupling: Vec<f64>,
    /// Derivative of the energy.
    pub gradient: f64,
}

/// Sites in a tile of a sum.
pub const TILE: usize = 2048;

/// The numbers of `n` sites, faces or vertices, of which threads that have nothing left to do take [`TILE`] from others.
pub fn in_tiles(n: usize) -> impl IndexedParallelIterator<Item = usize> + Clone {
    let all = (0..n).into_par_iter();
    all.with_min_len(TILE).with_max_len(TILE)
}

/// What the views of one site add to the normal equations.
#[derive(Clone, Copy)]
pub struct Block<const N: usize> {
    /// By what the residuals depend on: a face's on the displacements of its corners, a vertex's on its unit normal and its
    /// displacement.
    pub jtj: SMatrix<f64, N, N>,
    /// Derivative of the energy by that.
    pub jtr: SVector<f64, N>,
    /// The same sums with the logarithm of the albedo in the place of one of these, of both, and its derivative.
    pub by_albedo: (SVector<f64, N>, f64, f64),
}

impl<const N: usize> Default for Block<N> {
    fn default() -> Self {
        Block {
            jtj: SMatrix::zeros(),
            jtr: SVector::zeros(),
            by_albedo: (SVector::zeros(), 0.0, 0.0),
        }
    }
}

/// A site as the views are asked about it.
pub struct Site {
    index: usize,
    /// Unit normal.
    pub normal: Vector3<f64>,
    /// Albedo.
    pub albedo: f64,
    moved_m: f64,
    /// Its tint, where that follows the surface.
    tint: Option<Tint>,
}

impl Problem<'_> {
    /// Tints of a surface as far as they may not be shape: where too few views tell one, it is as it was thought to be, and no less free.
    pub fn tints_apart(&self, surface: &Surface, albedos: &[f64]) -> Vec<Option<Tint>> {
        let found = self.evaluate(surface, albedos).tints;
        if !self.finds_tints {
            return found;
        }
        let apart = |(index, found): (usize, Option<Tint>)| {
            let seen = self.observations.of(index);
            found.or_else(|| (!seen.is_empty()).then(|| Tint::untold(seen, self.tints[index])))
        };
        found.into_iter().enumerate().map(apart).collect()
    }

    /// The factors of tints that were found, and of the others as they were thought to be.
    pub fn factors(&self, found: &[Option<Tint>]) -> Vec<f64> {
        let pairs = found.iter().zip(self.tints);
        let factor =
            |(found, start): (&Option<Tint>, &f64)| found.map_or(*start, |tint| tint.factor);
        pairs.map(factor).collect()
    }

    /// A site as it is now, with its tint if that follows the surface.
    pub fn site(
        &self,
        surface: &Surface,
        albedos: &[f64],
        (index, normal): (usize, Vector3<f64>),
        tint: Option<Tint>,
    ) -> Site {
        let factor = tint.map_or(self.tints[index], |tint| tint.factor);
        Site {
            index,
            normal,
            albedo: albedos[self.labels[index] as usize] * factor,
            moved_m: self.observations.moved_m(surface, index),
            tint,
        }
    }

    /// Gauss-Newton normal equations about the surface and the groups' albedos, robust weights held; `tints` are those that
    /// [`Self::evaluate`] finds there, and follow the surface.
    pub fn linearise(
        &self,
        surface: &Surface,
        albedos: &[f64],
        tints: &[Option<Tint>],
        couplings: &Couplings,
    ) -> NormalMatrix {
        let of_priors = || {
            let nothing = GroupTerms {
                diagonal: 0.0,
                coupling: vec![0.0; surface.total_m.len()],
                gradient: 0.0,
            };
            NormalMatrix {
                groups: vec![nothing; albedos.len()],
                ..self.prior_matrix(&surface.total_m, couplings)
            }
        };
        match self.sites {
            SiteKind::Face => {
                let mut matrix = of_priors();
                self.add_faces(surface, (albedos, tints), couplings, &mut matrix);
                matrix
            }
            SiteKind::Vertex => {
                let (mut matrix, system) = rayon::join(of_priors, || {
                    VertexSystem::new(self, surface, (albedos, tints))
                });
                system.add_bound(self, couplings, &mut matrix);
                matrix.at_vertices = Some(system);
                matrix
            }
        }
    }

    fn add_faces(
        &self,
        surface: &Surface,
        (albedos, tints): (&[f64], &[Option<Tint>]),
        couplings: &Couplings,
        matrix: &mut NormalMatrix,
    ) {
        let blocks: Vec<Block<3>> = in_tiles(surface.mesh.faces.len())
            .map(|face| self.face_block(surface, albedos, (face, tints[face])))
            .collect();
        let faces = surface.mesh.faces.iter().zip(self.labels);
        for (((face, &label), block), sides) in faces.zip(&blocks).zip(&couplings.of_faces) {
            let group = &mut matrix.groups[label as usize];
            let (coupling, diagonal, gradient) = block.by_albedo;
            group.diagonal += diagonal;
            group.gradient += gradient;
            for corner in 0..3 {
                matrix.diagonal[face[corner] as usize] += block.jtj[(corner, corner)];
                matrix.gradient[face[corner] as usize] += block.jtr[corner];
                matrix.off_diagonal[sides[corner] as usize] +=
                    block.jtj[(corner, (corner + 1) % 3)];
                group.coupling[face[corner] as usize] += coupling[corner];
            }
        }
    }

    /// What the views say of one facet.
    pub fn face_block(
        &self,
        surface: &Surface,
        albedos: &[f64],
        (face, tint): (usize, Option<Tint>),
    ) -> Block<3> {
        if self.observations.of(face).is_empty() {
            return Block::default();
        }
        let Some((normal, _)) = unit_normal(&surface.mesh, face) else {
            return Block::default();
        };
        let facet = self.site(surface, albedos, (face, normal), tint);
        let albedo = facet.albedo;
        match self.jacobian {
            JacobianMode::Analytic => {
                let by_corner = normal_by_displacement(surface, face, &normal);
                self.sum_over_views(&facet, |seen| {
                    let by_normal = seen.light() * -albedo;
                    // Each corner takes the centroid a third of its way.
                    let by_motion = seen.by_motion(albedo) / 3.0;
                    Vector3::from_fn(|corner, _| by_normal.dot(&by_corner[corner]) + by_motion)
                })
            }
            JacobianMode::Numeric => match DisplacedNormals::of(surface, face) {
                Some(displaced) => {
                    self.sum_over_views(&facet, |seen| displaced.row(seen, albedo, facet.moved_m))
                }
                None => Block::default(),
            },
        }
    }

    /// Sums what the views say of a site; `row` gives the derivatives of a residual.
    #[inline]
    pub fn sum_over_views<const N: usize>(
        &self,
        site: &Site,
        row: impl Fn(&Observation) -> SVector<f64, N>,
    ) -> Block<N> {
        let mut block = Block::default();
        for seen in self.observations.of(site.index) {
            let moved = seen.moved(site.moved_m);
            let Some(residual) = moved.residual(&site.normal, site.albedo) else {
                continue;
            };
            let weight = self.loss.weight(residual) * f64::from(seen.covered);
            let row = row(seen);
            block.jtj += row * row.transpose() * weight;
            block.jtr += row * (weight * residual);
            let by_log_albedo = residual - moved.observed();
            let (coupling, diagonal, gradient) = &mut block.by_albedo;
            *coupling += row * (weight * by_log_albedo);
            *diagonal += weight * by_log_albedo * by_log_albedo;
            *gradient += weight * by_log_albedo * residual;
        }
        match &site.tint {
            Some(tint) => block.with_tint_following(tint),
            None => block,
        }
    }
}
