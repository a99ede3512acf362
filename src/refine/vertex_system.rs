//! The data term's normal equations where sites are at vertices, as in the paper.
//!
//! A vertex's normal is that of the sum `N = Σ N_f` of the area vectors of the faces round it, so that a residual touches all
//! displacements of the vertex's ring and the normal matrix those two edges apart. A factor of that matrix takes several times as
//! long as one of those that edges couple. So it is never put together: [`VertexSystem::times`] multiplies by it, face by face, and
//! what is factorised is a bound of it on edges alone, [`VertexSystem::add_bound`]. With `J = Σ w_f J_f` and `Σ w_f = 1`, where in
//! `J_f` the one face turns the normal by as much as all of them, `Jᵀ A J ≤ Σ w_f J_fᵀ A J_f` (Jensen), here with faces' sizes for
//! weights. The bound is right for what
//! is wider than a ring and too stiff for what is not; a few conjugate gradients make up for that.

use super::couplings::{Couplings, VertexCorners};
use super::energy::{NormalMatrix, Problem};
use super::side_by_side::{map_sites, unit_normals};
use super::site_blocks::{Block, Estimate};
use super::surface::{Surface, area_vector_by_displacement};
use super::tiles::{TILE, in_tiles};
use super::tint::Tint;
use nalgebra::{Matrix3, Vector3, Vector4};
use rayon::prelude::*;
use std::array::from_fn;

/// What is known of the data term about a surface.
#[derive(Clone, Debug)]
pub struct VertexSystem {
    faces: Vec<[u32; 3]>,
    /// Twice the area of each, m², at least [`MIN_SIZE`] of the mean: one without area still turns normals.
    sizes: Vec<f64>,
    /// Change of each face's area vector by the displacements of its corners, one a column, m.
    by_corners: Vec<Matrix3<f64>>,
    /// One a vertex.
    terms: Vec<Terms>,
}

/// Smallest size of a face that the bound goes by, in those of the mean face.
const MIN_SIZE: f64 = 0.1;

/// The sums of a vertex over its views, by the change of `N` over the size of its faces and by its displacement.
#[derive(Clone, Copy, Debug, Default)]
struct Terms {
    /// 1 over the size of all faces round it, m⁻².
    inv_size: f64,
    by_normal: Matrix3<f64>,
    by_both: Vector3<f64>,
    by_displacement: f64,
    gradient: Change,
    /// With the logarithm of the albedo, of both, and its derivative.
    coupling: Change,
    by_albedo: (f64, f64),
}

/// A derivative by the normal's change and by the displacement.
#[derive(Clone, Copy, Debug, Default)]
struct Change {
    normal: Vector3<f64>,
    displacement: f64,
}

/// A face's part of the bound.
struct FaceBound {
    jtj: Matrix3<f64>,
    gradient: Vector3<f64>,
    /// By the albedo of each corner's group.
    couplings: [Vector3<f64>; 3],
}

impl VertexSystem {
    /// Sums what the views say about a surface, the groups' albedos and the sites' tints, robust weights held.
    pub fn new(
        problem: &Problem,
        surface: &Surface,
        (albedos, tints): (&[f64], &[Option<Tint>]),
    ) -> VertexSystem {
        let mesh = &surface.mesh;
        let n_vertices = mesh.vertices.len();
        let n_faces = mesh.faces.len();
        let faces = in_tiles(n_faces);
        let normals: Vec<Vector3<f64>> = faces.clone().map(|face| mesh.face_normal(face)).collect();
        let sizes: Vec<f64> = normals.par_iter().map(Vector3::norm).collect();
        let least = MIN_SIZE * sizes.iter().sum::<f64>() / n_faces.max(1) as f64;
        let sizes: Vec<f64> = sizes.into_iter().map(|size| size.max(least)).collect();
        // Of the faces round each vertex: their area vectors, and their sizes.
        let rings = mesh.sums_at_vertices(Vector4::zeros(), |face| normals[face].push(sizes[face]));
        let estimate = Estimate {
            surface,
            albedos,
            tints,
        };
        let terms = map_sites(n_vertices, |vertices, room| {
            let first = vertices.start;
            let normals = unit_normals(vertices, |vertex| {
                let is_seen = !problem.observations.of(vertex).is_empty();
                rings[vertex].xyz().try_normalize(0.0).filter(|_| is_seen)
            });
            let blocks = problem.blocks(&estimate, first, &normals, room);
            from_fn(|lane| match &normals[lane] {
                Some(normal) => Terms::new(&blocks[lane], normal, &rings[first + lane]),
                None => Terms::default(),
            })
        });
        VertexSystem {
            faces: mesh.faces.clone(),
            sizes,
            terms,
            by_corners: faces
                .map(|face| Matrix3::from_columns(&area_vector_by_displacement(surface, face)))
                .collect(),
        }
    }

    /// Adds a matrix that is nowhere less than this data term's and couples by edges alone; gradient and what belongs to the
    /// albedos are exact.
    pub fn add_bound(&self, problem: &Problem, couplings: &Couplings, matrix: &mut NormalMatrix) {
        for (terms, &label) in self.terms.iter().zip(problem.labels) {
            let group = &mut matrix.groups[label as usize];
            let (diagonal, gradient) = terms.by_albedo;
            group.diagonal += diagonal;
            group.gradient += gradient;
        }
        let faces = in_tiles(self.faces.len());
        let bounds: Vec<FaceBound> = faces.map(|face| self.bound(face)).collect();
        let off_diagonal = &mut matrix.off_diagonal;
        let add_off_diagonal = || {
            for (sides, bound) in couplings.of_faces.iter().zip(&bounds) {
                for (corner, &side) in sides.iter().enumerate() {
                    off_diagonal[side as usize] += bound.jtj[(corner, (corner + 1) % 3)];
                }
            }
        };
        let mut tiles: Vec<Vec<&mut [f64]>> = Vec::new();
        tiles.resize_with(matrix.diagonal.len().div_ceil(TILE), Vec::new);
        for group in &mut matrix.groups {
            let couplings = group.coupling.chunks_mut(TILE);
            tiles
                .iter_mut()
                .zip(couplings)
                .for_each(|(tile, couplings)| tile.push(couplings));
        }
        let (diagonals, gradients) = (&mut matrix.diagonal, &mut matrix.gradient);
        let tiles = tiles.into_par_iter().zip(diagonals.par_chunks_mut(TILE));
        let tiles = tiles.zip(gradients.par_chunks_mut(TILE)).with_max_len(1);
        let tiles = tiles.enumerate();
        let add_own = || {
            tiles.for_each(|(tile, ((mut by_group, diagonal), gradient))| {
                for (k, (diagonal, gradient)) in diagonal.iter_mut().zip(gradient).enumerate() {
                    for [face, corner] in couplings.corners.of(tile * TILE + k) {
                        let bound = &bounds[face];
                        *diagonal += bound.jtj[(corner, corner)];
                        *gradient += bound.gradient[corner];
                        for (vertex, coupling) in self.faces[face].iter().zip(&bound.couplings) {
                            let group = problem.labels[*vertex as usize] as usize;
                            by_group[group][k] += coupling[corner];
                        }
                    }
                }
            })
        };
        // Two faces share an entry beside the diagonal, which keeps one thread busy.
        rayon::join(add_off_diagonal, add_own);
    }

    fn bound(&self, face: usize) -> FaceBound {
        let corners = self.faces[face].map(|vertex| &self.terms[vertex as usize]);
        // As if the face alone turned the normals of its corners.
        let size = self.sizes[face];
        let turns = self.by_corners[face] / size;
        let mut bound = FaceBound {
            jtj: Matrix3::zeros(),
            gradient: Vector3::zeros(),
            couplings: [Vector3::zeros(); 3],
        };
        let mut by_normal = Matrix3::zeros();
        for (corner, terms) in corners.into_iter().enumerate() {
            let share = size * terms.inv_size;
            by_normal += terms.by_normal * share;
            let by_both = turns.tr_mul(&terms.by_both) * share;
            for other in 0..3 {
                bound.jtj[(corner, other)] += by_both[other];
                bound.jtj[(other, corner)] += by_both[other];
            }
            bound.jtj[(corner, corner)] += share * terms.by_displacement;
            let of_corners = |change: &Change| {
                let mut of_corners = turns.tr_mul(&change.normal);
                of_corners[corner] += change.displacement;
                of_corners * share
            };
            bound.gradient += of_corners(&terms.gradient);
            bound.couplings[corner] = of_corners(&terms.coupling);
        }
        bound.jtj += turns.tr_mul(&(by_normal * turns));
        bound
    }

    /// The product of the data term's own matrix with displacements `x`.
    pub fn times(&self, corners: &VertexCorners, x: &[f64]) -> Vec<f64> {
        let at_corners = |face: usize| self.faces[face].map(|vertex| vertex as usize);
        let turned = in_tiles(self.faces.len())
            .map(|face| self.by_corners[face] * Vector3::from(at_corners(face).map(|at| x[at])));
        let turned: Vec<Vector3<f64>> = turned.collect();
        let changes = in_tiles(x.len()).map(|vertex| {
            let (x, terms) = (x[vertex], &self.terms[vertex]);
            let change: Vector3<f64> = corners.of(vertex).map(|[face, _]| turned[face]).sum();
            let by_size = change * terms.inv_size;
            let own = terms.by_both.dot(&by_size) + terms.by_displacement * x;
            let change = (terms.by_normal * by_size + terms.by_both * x) * terms.inv_size;
            (change, own)
        });
        let (changes, mut product): (Vec<Vector3<f64>>, Vec<f64>) = changes.unzip();
        let backwards = in_tiles(self.faces.len()).map(|face| {
            let [a, b, c] = at_corners(face);
            self.by_corners[face].tr_mul(&(changes[a] + changes[b] + changes[c]))
        });
        let backwards: Vec<Vector3<f64>> = backwards.collect();
        let tiles = product.par_chunks_mut(TILE).with_max_len(1).enumerate();
        tiles.for_each(|(tile, products)| {
            for (vertex, product) in (tile * TILE..).zip(products) {
                for [face, corner] in corners.of(vertex) {
                    *product += backwards[face][corner];
                }
            }
        });
        product
    }
}

impl Terms {
    /// Of a vertex with a unit normal, from what its views say and the sum of the area vectors and sizes of the faces round it.
    fn new(block: &Block<4>, normal: &Vector3<f64>, ring: &Vector4<f64>) -> Terms {
        // By how much the unit normal turns with the change of `N` over the size of its faces.
        let per_turn = ring.w / ring.xyz().norm();
        let turn = (Matrix3::identity() - normal * normal.transpose()) * per_turn;
        let change = |by: &Vector4<f64>| Change {
            normal: turn * by.xyz(),
            displacement: by.w,
        };
        let (coupling, diagonal, gradient) = &block.by_albedo;
        let by_unit: Matrix3<f64> = block.jtj.fixed_view::<3, 3>(0, 0).into();
        let with_displacement: Vector3<f64> = block.jtj.fixed_view::<3, 1>(0, 3).into();
        Terms {
            inv_size: 1.0 / ring.w,
            by_normal: turn * by_unit * turn,
            by_both: turn * with_displacement,
            by_displacement: block.jtj[(3, 3)],
            gradient: change(&block.jtr),
            coupling: change(coupling),
            by_albedo: (*diagonal, *gradient),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::RefineParams;
    use super::super::observations::Observations;
    use super::super::priors::PriorWeights;
    use super::super::scenes::{
        ALBEDO, RippledPlane, calibration, optics, poses, rays, solved, surface_of, views,
    };
    use super::super::site_motion::{Linearisation, SiteMotion};
    use super::super::sites::{SiteKind, Sites, ViewSet};
    use super::super::solver::SolverParams;
    use super::*;
    use crate::geometry::{EdgeAdjacency, TriMesh};
    use crate::refine::JacobianMode;
    use crate::robust::Tukey;

    const HIDDEN: RippledPlane = RippledPlane {
        amplitude_m: 0.0003,
    };

    fn dot(a: &[f64], b: &[f64]) -> f64 {
        a.iter().zip(b).map(|(a, b)| a * b).sum()
    }

    /// Displacements of one vertex, of wide waves, and such as alternate.
    fn directions(surface: &Surface) -> Vec<Vec<f64>> {
        let vertices = &surface.mesh.vertices;
        let n = vertices.len();
        let wide = vertices.iter().map(|p| (200.0 * p.x).sin() + p.y / 0.05);
        let mixed = (0..n).map(|v| (12.9898 * v as f64).sin());
        let mut one = vec![0.0; n];
        let off_middle = |v: &usize| (1e6 * vertices[*v].coords.xy().norm()) as u64;
        one[(0..n).min_by_key(off_middle).expect("not empty")] = 1.0;
        vec![wide.collect(), mixed.collect(), one]
    }

    #[test]
    fn the_matrix_is_the_gradients_derivative_and_its_bound_is_no_less() {
        check(HIDDEN.mesh(0.002), 0.05, false);
    }

    #[test]
    fn so_they_are_where_tints_follow_the_surface() {
        check(HIDDEN.mesh(0.002), 0.05, true);
    }

    #[test]
    fn a_face_without_area_turns_normals_too() {
        let mut mesh = HIDDEN.mesh(0.002);
        let [a, b, _] = mesh.faces[mesh.faces.len() / 2];
        mesh.vertices[b as usize] = mesh.vertices[a as usize];
        // That the normals of so uneven faces are not the surface's leaves residuals.
        check(mesh, 0.2, false);
    }

    /// Compares the matrix with differences of the gradient, to a share of it, and with its bound.
    fn check(mesh: TriMesh, tolerance: f64, finds_tints: bool) {
        let (rays, calibration) = (rays(), calibration());
        let optics = optics(&rays, &calibration);
        let views = views(&HIDDEN, &mesh, &optics, &poses(0.5));
        let surface = surface_of(mesh);
        let sites = Sites::new(SiteKind::Vertex, &surface.mesh, &views, ViewSet::MAX);
        let motion = SiteMotion::of(&surface, SiteKind::Vertex, Linearisation::Full);
        let edges = EdgeAdjacency::new(&surface.mesh);
        let couplings = Couplings::new(&surface.mesh, &edges, &[]);
        let n_sites = sites.points.len();
        let problem = Problem {
            sites: SiteKind::Vertex,
            observations: &Observations::new(&sites, &views, motion, None),
            labels: &vec![0; n_sites],
            tints: &vec![1.0; n_sites],
            finds_tints,
            // All weights are 1, and residuals of the true surface are next to nothing.
            loss: Tukey {
                scale: 1.0,
                cutoff: 1e6,
            },
            priors: PriorWeights::new(&RefineParams::default(), 0.002),
            patches: &[],
            edges: &edges,
            jacobian: JacobianMode::Analytic,
        };
        let linearise = |surface: &Surface| {
            let tints = problem.evaluate(surface, &[ALBEDO]).tints;
            problem.linearise(surface, &[ALBEDO], &tints, &couplings)
        };
        let matrix = linearise(&surface);
        let system = matrix.at_vertices.as_ref().expect("sites are at vertices");
        let prior = problem.prior_matrix(&surface.total_m, &couplings);
        for x in directions(&surface) {
            let data = system.times(&couplings.corners, &x);
            let steps = |by: f64| -> Vec<f64> { x.iter().map(|x| by * x).collect() };
            let gradient = |by: f64| linearise(&surface.displaced(&steps(by))).gradient;
            let (back, forth) = (gradient(-1e-8), gradient(1e-8));
            let held = problem.prior_times(&x);
            let numeric = back.iter().zip(&forth).map(|(b, f)| (f - b) / 2e-8);
            let numeric: Vec<f64> = numeric.zip(&held).map(|(all, prior)| all - prior).collect();
            let apart: Vec<f64> = numeric.iter().zip(&data).map(|(n, d)| n - d).collect();
            let share = (dot(&apart, &apart) / dot(&data, &data)).sqrt();
            assert!(share < tolerance, "{share}");
            let of_pairs = |off: &[f64], diagonal: &[f64]| {
                let own: f64 = x.iter().zip(diagonal).map(|(x, d)| d * x * x).sum();
                let pairs = couplings.pairs.iter().zip(off);
                let beside = pairs.map(|(&[i, j], h)| 2.0 * h * x[i as usize] * x[j as usize]);
                own + beside.sum::<f64>()
            };
            let prior = of_pairs(&prior.off_diagonal, &prior.diagonal);
            assert!((prior / dot(&x, &held) - 1.0).abs() < 1e-9);
            let bound = of_pairs(&matrix.off_diagonal, &matrix.diagonal) - prior;
            let exact = dot(&x, &data);
            assert!(bound > exact && exact > 0.0, "{bound} for {exact}");
        }
    }

    #[test]
    fn either_kind_of_site_finds_hidden_ripples() {
        let error_of = |mesh: &TriMesh| {
            let normals = mesh.vertex_normals();
            let inner = mesh.vertices.iter().zip(&normals);
            let inner = inner.filter(|(p, _)| p.x.abs() < 0.025 && p.y.abs() < 0.025);
            let angles: Vec<f64> = inner
                .map(|(p, n)| n.angle(&HIDDEN.normal(p.x, p.y)))
                .collect();
            angles.iter().sum::<f64>() / angles.len() as f64
        };
        let solver = SolverParams {
            max_steps: 5,
            min_decrease: 1e-6,
            max_step_m: 1e-3,
        };
        let flat = RippledPlane { amplitude_m: 0.0 }.mesh(0.002);
        let before = error_of(&flat);
        for sites in [SiteKind::Face, SiteKind::Vertex] {
            let params = RefineParams {
                edge_length_m: 0.002,
                sites,
                ..RefineParams::default()
            };
            let (surface, _) = solved(&HIDDEN, (flat.clone(), ALBEDO), &params, &solver);
            let after = error_of(&surface.mesh);
            assert!(
                after < 0.4 * before,
                "{sites:?}: from {before} to {after} rad"
            );
        }
    }
}
