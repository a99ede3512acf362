//! The energy of Eq. (5): data term Eq. (6) at all sites over all views, with what holds their tints, smoothness Eq. (7) and anchor
//! Eq. (8) on the total displacement; its normal equations by the displacements along fixed directions.
//!
//! All views of a site are summed into one [`Block`]. A face site has the facet's own normal, so that it touches three displacements;
//! sites at vertices touch more ([`VertexSystem`]). Sums run over fixed tiles, in order.

use super::couplings::Couplings;
use super::numeric::{DisplacedNormals, JacobianMode};
use super::observations::Observations;
use super::patches::Patch;
use super::priors::PriorWeights;
use super::side_by_side::{SITES, Seen, map_sites, unit_normals};
use super::site_blocks::{Block, Estimate};
use super::sites::SiteKind;
use super::surface::{Surface, normal_by_displacement, unit_normal};
use super::tint::Tint;
use super::vertex_system::VertexSystem;
use crate::geometry::EdgeAdjacency;
use crate::robust::Tukey;
use nalgebra::{Matrix4x3, Vector3};
use std::array::from_fn;
use std::ops::Range;

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
        let estimate = Estimate {
            surface,
            albedos,
            tints,
        };
        let blocks = map_sites(surface.mesh.faces.len(), |faces, room| {
            self.face_blocks(&estimate, faces, room)
        });
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

    /// What the views say of up to [`SITES`] facets, by the displacements of their corners, metres; nothing of lanes past the last. `room` is
    /// for what they show.
    pub fn face_blocks(
        &self,
        estimate: &Estimate,
        faces: Range<usize>,
        room: &mut Vec<Seen>,
    ) -> [Block<3>; SITES] {
        let (surface, first) = (estimate.surface, faces.start);
        let mut normals = unit_normals(faces, |face| {
            let is_seen = !self.observations.of(face).is_empty();
            let normal = is_seen.then(|| unit_normal(&surface.mesh, face));
            normal.flatten().map(|(normal, _)| normal)
        });
        if self.jacobian == JacobianMode::Numeric {
            let displaced: [Option<DisplacedNormals>; SITES] = from_fn(|lane| {
                normals[lane].and_then(|_| DisplacedNormals::of(surface, first + lane))
            });
            for (normal, displaced) in normals.iter_mut().zip(&displaced) {
                *normal = normal.filter(|_| displaced.is_some());
            }
            return self.blocks_by_each(estimate, first, &normals, room, |lane, seen, albedo| {
                let displaced = displaced[lane].as_ref();
                displaced.map_or(Vector3::zeros(), |of| of.row(seen, albedo))
            });
        }
        let blocks = self.blocks(estimate, first, &normals, room);
        from_fn(|lane| match &normals[lane] {
            Some(normal) => {
                let by_corner = normal_by_displacement(surface, first + lane, normal);
                // Each corner takes the centroid a third of its way.
                let by_corner = by_corner.map(|by_normal| by_normal.push(1.0 / 3.0));
                blocks[lane].by(&Matrix4x3::from_columns(&by_corner))
            }
            None => Block::default(),
        })
    }
}
