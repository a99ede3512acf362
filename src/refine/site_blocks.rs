//! What the views of each site add to the normal equations, for [`SITES`] sites at once.

use super::energy::Problem;
use super::observations::Observation;
use super::side_by_side::{OfSites, Placed, SITES, Seen};
use super::surface::Surface;
use super::tint::Tint;
use crate::robust::Tukey;
use nalgebra::{Matrix4x3, SMatrix, SVector, Vector3};
use pulp::{Arch, Simd, WithSimd};

/// What the views of one site add to the normal equations.
#[derive(Clone, Copy)]
pub struct Block<const N: usize> {
    /// By what the residuals depend on: [`Problem::blocks`]' on the site's unit normal and its displacement, a facet's on the displacements
    /// of its corners.
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

impl Block<4> {
    /// The same sums by three numbers, of which normal and displacement are linear functions.
    pub fn by(&self, change: &Matrix4x3<f64>) -> Block<3> {
        let (coupling, diagonal, gradient) = &self.by_albedo;
        Block {
            jtj: change.tr_mul(&(self.jtj * change)),
            jtr: change.tr_mul(&self.jtr),
            by_albedo: (change.tr_mul(coupling), *diagonal, *gradient),
        }
    }
}

/// Derivatives of the residuals of each site in one view.
trait Rows<const N: usize> {
    /// Those in a view, of sites with these albedos.
    fn rows(&self, view: usize, seen: &Seen, albedo: &OfSites) -> [OfSites; N];
}

/// By the unit normal and the displacement, as of [`Seen::by_normal_and_motion`].
struct ByNormalAndMotion;

impl Rows<4> for ByNormalAndMotion {
    #[inline(always)]
    fn rows(&self, _: usize, seen: &Seen, albedo: &OfSites) -> [OfSites; 4] {
        seen.by_normal_and_motion(albedo)
    }
}

/// One site at a time, by a function of its place, what a view shows of it, its albedo and how far it has moved.
struct ByEach<'a, F> {
    views: [&'a [Observation]; SITES],
    placed: &'a Placed,
    row: F,
}

impl<F: Fn(usize, &Observation, f64, f64) -> Vector3<f64>> Rows<3> for ByEach<'_, F> {
    fn rows(&self, view: usize, _: &Seen, albedo: &OfSites) -> [OfSites; 3] {
        let mut rows = [[0.0; SITES]; 3];
        for (lane, views) in self.views.iter().enumerate() {
            if let Some(seen) = views.get(view) {
                let row = (self.row)(lane, seen, albedo[lane], self.placed.moved_m[lane]);
                for (of_sites, value) in rows.iter_mut().zip(&row) {
                    of_sites[lane] = *value;
                }
            }
        }
        rows
    }
}

/// Where sites are, what is thought of them, and room for what their views show.
pub struct Asked<'a> {
    /// The surface.
    pub surface: &'a Surface,
    /// Albedo of each group.
    pub albedos: &'a [f64],
    /// Tint of each site, where that follows the surface.
    pub tints: &'a [Option<Tint>],
}

impl Problem<'_> {
    /// What the views say of up to [`SITES`] sites from the `first` on, by the unit normal of each and its displacement; nothing of one
    /// without a normal. `room` is for what they show.
    pub fn blocks(
        &self,
        asked: &Asked,
        first: usize,
        normals: &[Option<Vector3<f64>>],
        room: &mut Vec<Seen>,
    ) -> [Block<4>; SITES] {
        let (placed, albedo) = self.place(asked, first, normals, room);
        let sums = Arch::new().dispatch(SumOverViews {
            seen: room,
            placed: &placed,
            albedo: &albedo,
            loss: self.loss,
            rows: &ByNormalAndMotion,
        });
        self.finished(asked, first, normals.len(), &sums)
    }

    /// The same by three numbers; `row` gives the derivatives of a residual, from the place of its site among these, what a view shows, the
    /// albedo and how far the site has moved, metres.
    pub fn blocks_by_each(
        &self,
        asked: &Asked,
        first: usize,
        normals: &[Option<Vector3<f64>>],
        row: impl Fn(usize, &Observation, f64, f64) -> Vector3<f64>,
    ) -> [Block<3>; SITES] {
        let mut room = Vec::new();
        let (placed, albedo) = self.place(asked, first, normals, &mut room);
        let mut views: [&[Observation]; SITES] = [&[]; SITES];
        for (lane, (views, normal)) in views.iter_mut().zip(normals).enumerate() {
            if normal.is_some() {
                *views = self.observations.of(first + lane);
            }
        }
        let rows = ByEach {
            views,
            placed: &placed,
            row,
        };
        let sums = Arch::new().dispatch(SumOverViews {
            seen: &room,
            placed: &placed,
            albedo: &albedo,
            loss: self.loss,
            rows: &rows,
        });
        self.finished(asked, first, normals.len(), &sums)
    }

    /// Fills the room with what views show of sites; returns where they are, and their albedos.
    fn place(
        &self,
        asked: &Asked,
        first: usize,
        normals: &[Option<Vector3<f64>>],
        room: &mut Vec<Seen>,
    ) -> (Placed, OfSites) {
        let Asked {
            surface,
            albedos,
            tints,
        } = *asked;
        room.clear();
        let (mut placed, mut albedo) = (Placed::default(), [0.0; SITES]);
        for (lane, normal) in normals.iter().enumerate() {
            let Some(normal) = normal else { continue };
            let site = first + lane;
            placed.set(lane, normal, self.observations.moved_m(surface, site));
            let factor = tints[site].map_or(self.tints[site], |tint| tint.factor);
            albedo[lane] = albedos[self.labels[site] as usize] * factor;
            Seen::set_views(room, lane, self.observations.of(site));
        }
        (placed, albedo)
    }

    /// Site by site, with the tints that follow the surface.
    fn finished<const N: usize>(
        &self,
        asked: &Asked,
        first: usize,
        n_sites: usize,
        sums: &Sums<N>,
    ) -> [Block<N>; SITES] {
        let mut blocks = [Block::default(); SITES];
        for (lane, block) in blocks[..n_sites].iter_mut().enumerate() {
            let own = sums.of(lane);
            *block = match &asked.tints[first + lane] {
                Some(tint) => own.with_tint_following(tint),
                None => own,
            };
        }
        blocks
    }
}

/// The sums of blocks.
struct Sums<const N: usize> {
    /// The upper half.
    jtj: [[OfSites; N]; N],
    jtr: [OfSites; N],
    coupling: [OfSites; N],
    diagonal: OfSites,
    gradient: OfSites,
}

impl<const N: usize> Sums<N> {
    fn of(&self, lane: usize) -> Block<N> {
        let entry = |i: usize, j: usize| self.jtj[i.min(j)][i.max(j)][lane];
        Block {
            jtj: SMatrix::from_fn(entry),
            jtr: SVector::from_fn(|i, _| self.jtr[i][lane]),
            by_albedo: (
                SVector::from_fn(|i, _| self.coupling[i][lane]),
                self.diagonal[lane],
                self.gradient[lane],
            ),
        }
    }
}

struct SumOverViews<'a, const N: usize, R> {
    seen: &'a [Seen],
    placed: &'a Placed,
    albedo: &'a OfSites,
    loss: Tukey,
    rows: &'a R,
}

impl<const N: usize, R: Rows<N>> WithSimd for SumOverViews<'_, N, R> {
    type Output = Sums<N>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Sums<N> {
        let mut sums = Sums {
            jtj: [[[0.0; SITES]; N]; N],
            jtr: [[0.0; SITES]; N],
            coupling: [[0.0; SITES]; N],
            diagonal: [0.0; SITES],
            gradient: [0.0; SITES],
        };
        for (view, seen) in self.seen.iter().enumerate() {
            let shown = seen.shown(self.placed);
            let residuals = shown.residuals(self.albedo);
            let rows = self.rows.rows(view, seen, self.albedo);
            let (mut weight, mut weighed) = ([0.0; SITES], [0.0; SITES]);
            let mut by_albedo = [0.0; SITES];
            for i in 0..SITES {
                // Where the light does not reach a site, nothing tells how to light it.
                let is_lit = shown.unit[i] > 0.0;
                let robust = self.loss.weight(residuals[i]) * shown.covered[i];
                weight[i] = if is_lit { robust } else { 0.0 };
                weighed[i] = weight[i] * residuals[i];
                let by_log_albedo = residuals[i] - shown.observed[i];
                by_albedo[i] = weight[i] * by_log_albedo;
                sums.diagonal[i] += by_albedo[i] * by_log_albedo;
                sums.gradient[i] += by_albedo[i] * residuals[i];
            }
            for row in 0..N {
                for column in row..N {
                    for i in 0..SITES {
                        sums.jtj[row][column][i] += rows[row][i] * rows[column][i] * weight[i];
                    }
                }
                for i in 0..SITES {
                    sums.jtr[row][i] += rows[row][i] * weighed[i];
                    sums.coupling[row][i] += rows[row][i] * by_albedo[i];
                }
            }
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use super::super::RefineParams;
    use super::super::scenes::{ALBEDO, RippledPlane, with_problem};
    use super::*;

    fn bits<const N: usize>(block: &Block<N>) -> Vec<u64> {
        let (coupling, diagonal, gradient) = &block.by_albedo;
        let numbers = block.jtj.iter().chain(&block.jtr).chain(coupling);
        let numbers = numbers.chain([diagonal, gradient]);
        numbers.map(|number| number.to_bits()).collect()
    }

    #[test]
    fn a_site_has_the_bits_beside_others_that_it_has_alone_and_the_sums_over_its_views() {
        let hidden = RippledPlane {
            amplitude_m: 0.0003,
        };
        let params = RefineParams {
            edge_length_m: 0.004,
            ..RefineParams::default()
        };
        let plane = RippledPlane { amplitude_m: 0.0 }.mesh(params.edge_length_m);
        with_problem(&hidden, plane, &params, |problem, surface, _| {
            let problem = Problem {
                finds_tints: true,
                observations: problem.observations,
                labels: problem.labels,
                tints: problem.tints,
                patches: problem.patches,
                edges: problem.edges,
                ..*problem
            };
            let albedos = [1.1 * ALBEDO];
            let tints = problem.evaluate(&surface, &albedos).tints;
            assert!(tints.iter().any(Option::is_some) && tints.iter().any(Option::is_none));
            let asked = Asked {
                surface: &surface,
                albedos: &albedos,
                tints: &tints,
            };
            let normals: Vec<_> = surface
                .mesh
                .vertex_normals()
                .into_iter()
                .map(Some)
                .collect();
            let (mut room, mut n_seen) = (Vec::new(), 0);
            for first in (0..normals.len()).step_by(SITES) {
                let normals = &normals[first..normals.len().min(first + SITES)];
                let together = problem.blocks(&asked, first, normals, &mut room);
                for (lane, normal) in normals.iter().enumerate() {
                    let (site, own) = (first + lane, std::slice::from_ref(normal));
                    let [alone, ..] = problem.blocks(&asked, site, own, &mut room);
                    assert_eq!(bits(&together[lane]), bits(&alone), "site {site}");
                    let tint = tints[site].map_or(problem.tints[site], |tint| tint.factor);
                    let albedo = albedos[0] * tint;
                    let of_view = |seen: &Observation| {
                        let residual = seen.residual(&normal.expect("a plane's"), albedo)?;
                        let weight = problem.loss.weight(residual) * f64::from(seen.covered);
                        Some(weight * residual * (residual - f64::from(seen.observed)))
                    };
                    let views = problem.observations.of(site);
                    let gradient: f64 = views.iter().filter_map(of_view).sum();
                    let apart = (alone.by_albedo.2 - gradient).abs();
                    assert!(apart <= 1e-12 * gradient.abs(), "site {site}: {apart}");
                    n_seen += usize::from(gradient != 0.0);
                }
            }
            assert!(n_seen > 100, "{n_seen} sites are seen");
        });
    }
}
