//! What the views of each site add to the normal equations, for [`SITES`] sites at once.

use super::energy::Problem;
use super::observations::{Moved, Observation};
use super::side_by_side::{OfSites, Placed, SITES, Seen, UnitNormals};
use super::surface::Surface;
use super::tint::Tint;
use crate::robust::Tukey;
use nalgebra::{Matrix4x3, SMatrix, SVector, Vector3};
use pulp::{Arch, Simd, WithSimd};
use std::array::from_fn;

/// What the views of one site add to the normal equations.
#[derive(Clone, Copy)]
pub struct Block<const N: usize> {
    /// By what the residuals depend on: [`Problem::blocks`]' on the site's unit normal, x, y and z, and its displacement, metres; a facet's
    /// on the displacements of its corners, metres.
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
    /// Those in a view, of sites that lie so and have these albedos.
    fn rows(&self, view: usize, seen: &Seen, placed: &Placed, albedo: &OfSites) -> [OfSites; N];
}

/// By the unit normal and the displacement, as of [`Seen::by_normal_and_motion`].
struct ByNormalAndMotion;

impl Rows<4> for ByNormalAndMotion {
    #[inline(always)]
    fn rows(&self, _: usize, seen: &Seen, _: &Placed, albedo: &OfSites) -> [OfSites; 4] {
        seen.by_normal_and_motion(albedo)
    }
}

/// One site at a time, by a function of its lane, what a view shows of it, and its albedo.
struct ByEach<'a, F> {
    views: [&'a [Observation]; SITES],
    row: F,
}

impl<F: Fn(usize, &Moved, f64) -> Vector3<f64>> Rows<3> for ByEach<'_, F> {
    fn rows(&self, view: usize, _: &Seen, placed: &Placed, albedo: &OfSites) -> [OfSites; 3] {
        let mut rows = [[0.0; SITES]; 3];
        for (lane, views) in self.views.iter().enumerate() {
            if let Some(seen) = views.get(view) {
                let moved = seen.moved(placed.moved_m[lane]);
                let row = (self.row)(lane, &moved, albedo[lane]);
                for (of_sites, value) in rows.iter_mut().zip(&row) {
                    of_sites[lane] = *value;
                }
            }
        }
        rows
    }
}

/// What sites are thought to be.
pub struct Estimate<'a> {
    /// The surface.
    pub surface: &'a Surface,
    /// Albedo of each group, square metres, as of a refinement.
    pub albedos: &'a [f64],
    /// Tint of each site, where that follows the surface.
    pub tints: &'a [Option<Tint>],
}

impl Problem<'_> {
    /// What the views say of the sites from the `first` on, by the unit normal of each and its displacement, metres; nothing of one without
    /// a normal. `room` is for what they show.
    pub fn blocks(
        &self,
        estimate: &Estimate,
        first: usize,
        normals: &UnitNormals,
        room: &mut Vec<Seen>,
    ) -> [Block<4>; SITES] {
        self.blocks_by(&ByNormalAndMotion, estimate, first, normals, room)
    }

    /// The same by three numbers; `row` gives the derivatives of a residual by them, from the lane of its site, what a view shows of it, and
    /// its albedo.
    pub fn blocks_by_each(
        &self,
        estimate: &Estimate,
        first: usize,
        normals: &UnitNormals,
        room: &mut Vec<Seen>,
        row: impl Fn(usize, &Moved, f64) -> Vector3<f64>,
    ) -> [Block<3>; SITES] {
        let views = from_fn(|lane| match normals[lane] {
            Some(_) => self.observations.of(first + lane),
            None => &[],
        });
        self.blocks_by(&ByEach { views, row }, estimate, first, normals, room)
    }

    fn blocks_by<const N: usize>(
        &self,
        rows: &impl Rows<N>,
        estimate: &Estimate,
        first: usize,
        normals: &UnitNormals,
        room: &mut Vec<Seen>,
    ) -> [Block<N>; SITES] {
        let Estimate {
            surface,
            albedos,
            tints,
        } = *estimate;
        let placed = Placed::new(self.observations, surface, first, normals, room);
        let sites = || (0..SITES).filter(|lane| normals[*lane].is_some());
        let mut albedo = [0.0; SITES];
        for lane in sites() {
            let site = first + lane;
            let factor = tints[site].map_or(self.tints[site], |tint| tint.factor);
            albedo[lane] = albedos[self.labels[site] as usize] * factor;
        }
        let sums = Arch::new().dispatch(SumOverViews {
            seen: room,
            placed: &placed,
            albedo: &albedo,
            loss: self.loss,
            rows,
        });
        let mut blocks = [Block::default(); SITES];
        for lane in sites() {
            let own = sums.of(lane);
            blocks[lane] = match &tints[first + lane] {
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
            let rows = self.rows.rows(view, seen, self.placed, self.albedo);
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
    use super::*;
    use crate::geometry::lanes::arch_levels;

    fn bits<const N: usize>(block: &Block<N>) -> Vec<u64> {
        let (coupling, diagonal, gradient) = &block.by_albedo;
        let numbers = block.jtj.iter().chain(&block.jtr).chain(coupling);
        let numbers = numbers.chain([diagonal, gradient]);
        numbers.map(|number| number.to_bits()).collect()
    }

    /// Five views, of which the third gets no light.
    fn views() -> Vec<Observation> {
        let view = |k: usize| {
            let k = k as f32;
            Observation {
                observed: 41.0 + 3.0 * k,
                light: [
                    3.0 - k,
                    2.0 + 0.3 * k,
                    if k == 2.0 { -90.0 } else { 50.0 + k },
                ],
                covered: 1.0 / (1.0 + k),
                image_slope: 900.0 - 130.0 * k,
                light_slope: 70.0 * k - 200.0,
                is_clear: true,
            }
        };
        (0..5).map(view).collect()
    }

    fn summed_one_by_one(
        views: &[Observation],
        normal: &Vector3<f64>,
        moved_m: f64,
        albedo: f64,
        loss: Tukey,
    ) -> Block<4> {
        let mut block = Block::default();
        for seen in views {
            let Some(residual) = seen.moved(moved_m).residual(normal, albedo) else {
                continue;
            };
            let weight = loss.weight(residual) * f64::from(seen.covered);
            let observed = f64::from(seen.observed) + f64::from(seen.image_slope) * moved_m;
            let by_motion = f64::from(seen.image_slope) - albedo * f64::from(seen.light_slope);
            let by_normal = Vector3::from(seen.light.map(f64::from)) * -albedo;
            let row = by_normal.push(by_motion);
            let by_albedo = residual - observed;
            let (coupling, diagonal, gradient) = &mut block.by_albedo;
            block.jtj += row * row.transpose() * weight;
            block.jtr += row * (weight * residual);
            *coupling += row * (weight * by_albedo);
            *diagonal += weight * by_albedo * by_albedo;
            *gradient += weight * by_albedo * residual;
        }
        block
    }

    #[test]
    fn every_lane_has_the_sums_over_its_own_views_with_any_instructions() {
        let all = views();
        let loss = Tukey {
            scale: 3.0,
            cutoff: 9.0,
        };
        let (mut seen, mut placed, mut albedo) = (Vec::new(), Placed::default(), [0.0; SITES]);
        let mut expected = [Block::<4>::default(); SITES];
        for lane in 0..SITES {
            let views = &all[..[5, 0, 1, 3, 2, 5, 4, 0][lane]];
            let tilt = 0.1 * lane as f64;
            let normal = Vector3::new(tilt.sin(), 0.0, tilt.cos());
            for (axis, normals) in placed.normals.iter_mut().enumerate() {
                normals[lane] = normal[axis];
            }
            placed.moved_m[lane] = 0.001 * lane as f64 - 0.002;
            albedo[lane] = 0.7 + 0.05 * lane as f64;
            Seen::set_views(&mut seen, lane, views);
            expected[lane] =
                summed_one_by_one(views, &normal, placed.moved_m[lane], albedo[lane], loss);
        }
        assert!(expected[3].jtj[(2, 2)] > 0.0 && expected[1].jtj[(2, 2)] == 0.0);
        for arch in arch_levels() {
            let sums = arch.dispatch(SumOverViews {
                seen: &seen,
                placed: &placed,
                albedo: &albedo,
                loss,
                rows: &ByNormalAndMotion,
            });
            for (lane, expected) in expected.iter().enumerate() {
                assert_eq!(bits(&sums.of(lane)), bits(expected), "lane {lane}");
            }
        }
    }
}
