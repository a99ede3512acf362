//! What holds the displacements without images: smoothness Eq. (7) and anchor Eq. (8) on the total displacement.

use super::couplings::Couplings;
use super::energy::{NormalMatrix, Problem};
use super::params::RefineParams;
use super::patches::Patch;

/// Weights of the priors, in units of the surface.
#[derive(Clone, Copy, Debug)]
pub struct PriorWeights {
    /// Of a patch's squared mean displacement, per m²: Eq. (8).
    pub anchor: f64,
    /// Of a vertex's squared displacement, per m²; holds what neither shading nor a patch does.
    pub rest: f64,
    /// Of a squared difference of displacements along an edge, per m²: Eq. (7).
    pub smoothness: f64,
}

impl PriorWeights {
    /// The priors in the solver's units, for a mesh of equilateral faces: a vertex has the area √3/2 h², cotangent weights are
    /// 1/√3.
    pub fn new(params: &RefineParams, edge_length_m: f64) -> Self {
        /// Distance over which the detail of the fused surface goes together, metres: a pixel's footprint or two.
        const DETAIL_M: f64 = 0.003;
        /// Standard deviation of a vertex that nothing else holds, metres.
        const REST_SIGMA_M: f64 = 0.001;
        let inv_detail2 = 1.0 / (DETAIL_M * DETAIL_M);
        let area = 0.866 * edge_length_m * edge_length_m;
        PriorWeights {
            anchor: 1.0 / (params.patch_sigma_m * params.patch_sigma_m),
            rest: area * inv_detail2 / (REST_SIGMA_M * REST_SIGMA_M),
            smoothness: 0.577 * inv_detail2 / (params.slope_sigma_rad * params.slope_sigma_rad),
        }
    }
}

impl Problem<'_> {
    /// Half the product of total displacements, metres, with their share of [`Self::prior_times`].
    pub fn prior_energy(&self, total_m: &[f64]) -> f64 {
        let slopes = self.prior_times(total_m);
        let pairs = total_m.iter().zip(&slopes);
        0.5 * pairs.map(|(total, slope)| total * slope).sum::<f64>()
    }

    /// The normal equations of the priors, which are all that is known without images.
    pub fn prior_matrix(&self, total_m: &[f64], couplings: &Couplings) -> NormalMatrix {
        let PriorWeights {
            anchor,
            rest,
            smoothness,
        } = self.priors;
        let mut matrix = NormalMatrix {
            diagonal: vec![rest; total_m.len()],
            off_diagonal: vec![0.0; couplings.pairs.len()],
            gradient: self.prior_times(total_m),
            groups: Vec::new(),
            at_vertices: None,
        };
        for (&[i, j], &entry) in self.edges.edges.iter().zip(&couplings.of_edges) {
            matrix.diagonal[i as usize] += smoothness;
            matrix.diagonal[j as usize] += smoothness;
            matrix.off_diagonal[entry as usize] -= smoothness;
        }
        for (patch, entries) in self.patches.iter().zip(&couplings.of_patches) {
            let share = 1.0 / patch.len() as f64;
            let stiffness = anchor * share * share;
            for &vertex in patch {
                matrix.diagonal[vertex as usize] += stiffness;
            }
            for &entry in entries {
                matrix.off_diagonal[entry as usize] += stiffness;
            }
        }
        matrix
    }

    /// The product of the priors' matrix with displacements.
    pub fn prior_times(&self, x: &[f64]) -> Vec<f64> {
        let PriorWeights {
            anchor,
            rest,
            smoothness,
        } = self.priors;
        let mut product: Vec<f64> = x.iter().map(|x| rest * x).collect();
        for &[i, j] in &self.edges.edges {
            let (i, j) = (i as usize, j as usize);
            let slope = smoothness * (x[i] - x[j]);
            product[i] += slope;
            product[j] -= slope;
        }
        for patch in self.patches {
            let share = 1.0 / patch.len() as f64;
            let pull = anchor * share * mean_of(patch, x);
            for &vertex in patch {
                product[vertex as usize] += pull;
            }
        }
        product
    }
}

/// Mean displacement of a patch, metres.
fn mean_of(patch: &Patch, total_m: &[f64]) -> f64 {
    patch
        .iter()
        .map(|&vertex| total_m[vertex as usize])
        .sum::<f64>()
        / patch.len() as f64
}
