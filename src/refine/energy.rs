//! The energy of Eq. (5): data term Eq. (6) at all sites over all views, with what holds their tints, smoothness Eq. (7) and anchor
//! Eq. (8) on the total displacement; its value, and its normal equations by the displacements along fixed directions.
//!
//! A face site has the facet's own normal, so that each residual touches three displacements: `∂N/∂δ_a = m_a × (b − c)`
//! for `N = (b − a) × (c − a)`, and `∂n = (I − n nᵀ)/|N| ∂N`. All views of a site share that pattern and are summed into
//! one 3×3 block. Sites at vertices touch more ([`VertexSystem`]). Sums run over fixed tiles, in order.

use super::couplings::Couplings;
use super::numeric::{DisplacedNormals, JacobianMode};
use super::observations::{Observation, Observations};
use super::patches::Patch;
use super::priors::PriorWeights;
use super::sites::SiteKind;
use super::tint::Tint;
use super::vertex_system::VertexSystem;
use crate::geometry::{EdgeAdjacency, TriMesh};
use crate::shading::Tukey;
use nalgebra::{SMatrix, SVector, Vector3};
use rayon::prelude::*;

/// The surface and what the displacements mean.
#[derive(Clone, Debug)]
pub struct Surface {
    /// The mesh as displaced so far.
    pub mesh: TriMesh,
    /// Directions of the displacements, unit length, one a vertex.
    pub directions: Vec<Vector3<f64>>,
    /// Displacement from the base mesh so far, along the directions, metres.
    pub total_m: Vec<f64>,
}

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
    pub fn energy(&self, surface: &Surface, albedos: &[f64]) -> f64 {
        let (n_sites, normals) = (self.labels.len(), self.normals(&surface.mesh));
        let of_tile = |tile: usize| -> f64 {
            let sites = tile * TILE..((tile + 1) * TILE).min(n_sites);
            let energy = |index| {
                let normal = normals.unit(index)?;
                Some(self.energy_of(&self.site(surface, albedos, index, normal)))
            };
            sites.filter_map(energy).sum()
        };
        let tiles = (0..n_sites.div_ceil(TILE)).into_par_iter().with_max_len(1);
        // The priors keep one thread busy.
        let (prior, data) = rayon::join(
            || self.prior_energy(&surface.total_m),
            || tiles.map(of_tile).collect::<Vec<f64>>(),
        );
        data.iter().sum::<f64>() + prior
    }

    fn normals<'m>(&self, mesh: &'m TriMesh) -> Normals<'m> {
        match self.sites {
            SiteKind::Face => Normals::OfFaces(mesh),
            SiteKind::Vertex => Normals::OfVertices(mesh.vertex_normals()),
        }
    }

    /// A site as it is now.
    pub fn site(
        &self,
        surface: &Surface,
        albedos: &[f64],
        index: usize,
        normal: Vector3<f64>,
    ) -> Site {
        let (group, start) = (albedos[self.labels[index] as usize], self.tints[index]);
        let moved_m = self.observations.moved_m(surface, index);
        let seen = self.observations.of(index);
        let find = || Tint::best(seen, (&normal, moved_m), group, self.loss, start);
        let tint = self.finds_tints.then(find).flatten();
        Site {
            index,
            normal,
            albedo: group * tint.map_or(start, |tint| tint.factor),
            moved_m,
            tint,
        }
    }

    /// Tints of all sites as the surface has them.
    pub fn found_tints(&self, surface: &Surface, albedos: &[f64]) -> Vec<f64> {
        let normals = self.normals(&surface.mesh);
        let found = |index: usize| {
            let normal = normals.unit(index)?;
            let tint = self.site(surface, albedos, index, normal).tint?;
            Some(tint.factor)
        };
        let tints =
            in_tiles(self.labels.len()).map(|index| found(index).unwrap_or(self.tints[index]));
        tints.collect()
    }

    fn energy_of(&self, site: &Site) -> f64 {
        let mut energy = site.tint.map_or(0.0, |tint| tint.energy());
        for seen in self.observations.of(site.index) {
            let moved = seen.moved(site.moved_m);
            if let Some(residual) = moved.residual(&site.normal, site.albedo) {
                energy += f64::from(seen.covered) * self.loss.loss(residual);
            }
        }
        energy
    }

    /// Gauss-Newton normal equations about the surface and the groups' albedos, robust weights held.
    pub fn linearise(
        &self,
        surface: &Surface,
        albedos: &[f64],
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
                self.add_faces(surface, albedos, couplings, &mut matrix);
                matrix
            }
            SiteKind::Vertex => {
                let corners = &couplings.corners;
                let (mut matrix, system) = rayon::join(of_priors, || {
                    VertexSystem::new(self, surface, albedos, corners)
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
        albedos: &[f64],
        couplings: &Couplings,
        matrix: &mut NormalMatrix,
    ) {
        let blocks: Vec<Block<3>> = in_tiles(surface.mesh.faces.len())
            .map(|face| self.face_block(surface, albedos, face))
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
    pub fn face_block(&self, surface: &Surface, albedos: &[f64], face: usize) -> Block<3> {
        if self.observations.of(face).is_empty() {
            return Block::default();
        }
        let Some((normal, _)) = unit_normal(&surface.mesh, face) else {
            return Block::default();
        };
        let facet = self.site(surface, albedos, face, normal);
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

/// Unit normal and area (m²) of a face; `None` where it has no area.
pub fn unit_normal(mesh: &TriMesh, face: usize) -> Option<(Vector3<f64>, f64)> {
    let normal = mesh.face_normal(face);
    let norm = normal.norm();
    (norm > 0.0).then(|| (normal / norm, 0.5 * norm))
}

/// Derivatives of a facet's unit normal by the displacements of its corners, per metre.
fn normal_by_displacement(
    surface: &Surface,
    face: usize,
    normal: &Vector3<f64>,
) -> [Vector3<f64>; 3] {
    let inv_norm = 1.0 / surface.mesh.face_normal(face).norm();
    area_vector_by_displacement(surface, face)
        .map(|change| (change - normal * normal.dot(&change)) * inv_norm)
}

/// Derivatives of [`area_vector`](crate::geometry::area_vector) of a face by the displacements of its corners, m.
pub fn area_vector_by_displacement(surface: &Surface, face: usize) -> [Vector3<f64>; 3] {
    let corners = surface.mesh.corners(face);
    std::array::from_fn(|corner| {
        let direction = surface.directions[surface.mesh.faces[face][corner] as usize];
        direction.cross(&(corners[(corner + 1) % 3] - corners[(corner + 2) % 3]))
    })
}

impl Surface {
    /// Displacement of a site from the base mesh so far, metres.
    #[inline]
    pub fn displacement_m(&self, kind: SiteKind, site: usize) -> f64 {
        match kind {
            SiteKind::Face => self.mesh.mean_at_face(site, |vertex| self.total_m[vertex]),
            SiteKind::Vertex => self.total_m[site],
        }
    }

    /// The surface with every vertex moved along its direction.
    pub fn displaced(&self, step_m: &[f64]) -> Surface {
        let mut next = self.clone();
        for (vertex, &step) in step_m.iter().enumerate() {
            next.mesh.vertices[vertex] += self.directions[vertex] * step;
            next.total_m[vertex] += step;
        }
        next
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    #[test]
    fn derivative_of_the_normal_matches_central_differences() {
        let mesh = TriMesh {
            vertices: vec![
                Point3::new(0.0, 0.1, 0.6),
                Point3::new(0.0013, 0.1002, 0.6004),
                Point3::new(0.0005, 0.1011, 0.5997),
            ],
            faces: vec![[0, 1, 2]],
        };
        let directions = [[0.1, 0.2, -1.0], [-0.3, 0.1, -0.9], [0.2, -0.4, -0.8]]
            .map(|d| Vector3::from(d).try_normalize(0.0).expect("not zero"));
        let surface = Surface {
            mesh,
            directions: directions.to_vec(),
            total_m: vec![0.0; 3],
        };
        let normal_of = |surface: &Surface| unit_normal(&surface.mesh, 0).expect("has an area").0;
        let analytic = normal_by_displacement(&surface, 0, &normal_of(&surface));
        for corner in 0..3 {
            let moved = |step: f64| {
                let mut steps = [0.0; 3];
                steps[corner] = step;
                normal_of(&surface.displaced(&steps))
            };
            let numeric = (moved(1e-7) - moved(-1e-7)) / 2e-7;
            assert!((numeric - analytic[corner]).norm() < 1e-7 * analytic[corner].norm());
        }
    }
}
