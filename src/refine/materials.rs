//! Which sites are of one material: labels by Eq. (4), from a mixture on the sites' own albedos or by the paper's clusters.

use super::albedo::{AlbedoMode, Groups, Ratio, log_albedo, of_groups, ratios};
use super::clusters::Clusters;
use super::expansion::Labelling;
use super::label_spread::spread;
use super::median_albedo::{Median, medians};
use super::mixture::Mixture;
use super::neighbourhood::Neighbourhood;
use super::observations::Observations;
use super::sites::Sites;
use crate::robust::median;

/// Sites in groups.
pub struct Materials {
    /// Group of each site.
    pub labels: Vec<u8>,
    /// How many groups there are.
    pub n_groups: usize,
    /// Median of the groups' sites' own albedos, which paint too fine for a group of its own does not move; of a mixture alone.
    pub typical: Option<Vec<f64>>,
}

/// One label may be given to materials of no more contrast, or of which the rarer has no more of the sites: tints take up the rest. By a
/// contrast of 2.9 on 9 % of them and of 2.2 on 14 % a refined surface was worse than its base; both are arbitrary below that.
const MAX_SWALLOWED_CONTRAST: f64 = 1.5;
const MAX_SWALLOWED_SHARE: f64 = 0.05;

/// Two materials that share the only label there is, though images tell them apart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Swallowed {
    /// How many times as bright as the darker one the brighter one is.
    pub contrast: f64,
    /// Share of the sites that the rarer one has.
    pub rarer_share: f64,
}

/// Standard deviation of a site's own log albedo that its noisy normal makes, at least.
const MIN_LOG_SIGMA: f64 = 0.06;
/// Groups whose logarithms of albedo differ by less are one: what differs by less is told as tints. A site keeps its tint
/// while that of its group changes by less.
pub const SAME_GROUP: f64 = 0.1;

impl Materials {
    /// Of sites with their sums over the views that see them; `pairs` are neighbours. `None` where no site is seen.
    pub fn of(
        sites: &Sites,
        pairs: &[[u32; 2]],
        observations: &Observations,
        ratios: &[Ratio],
        groups: Groups,
    ) -> Option<Materials> {
        match groups.mode {
            AlbedoMode::Mixture => of_mixture(sites, pairs, observations, ratios, groups.at_most),
            AlbedoMode::Paper => of_clusters(sites, pairs, ratios, groups.at_most),
        }
    }
}

impl Swallowed {
    /// What would be lost of sites with one label; `None` where images do not tell two materials of them, or hardly.
    pub fn of(sites: &Sites, pairs: &[[u32; 2]], observations: &Observations) -> Option<Swallowed> {
        let ratios = ratios(sites, observations, None);
        let materials = of_mixture(sites, pairs, observations, &ratios, 2)?;
        let &[darker, brighter] = materials.typical.as_deref()? else {
            return None;
        };
        let n_brighter = materials.labels.iter().filter(|&&label| label == 1).count();
        let share = n_brighter as f64 / materials.labels.len() as f64;
        let swallowed = Swallowed {
            contrast: brighter / darker,
            rarer_share: share.min(1.0 - share),
        };
        let counts = swallowed.contrast > MAX_SWALLOWED_CONTRAST
            && swallowed.rarer_share > MAX_SWALLOWED_SHARE;
        counts.then_some(swallowed)
    }
}

fn of_mixture(
    sites: &Sites,
    pairs: &[[u32; 2]],
    observations: &Observations,
    ratios: &[Ratio],
    at_most: usize,
) -> Option<Materials> {
    let neighbourhood = Neighbourhood::of(sites.kind);
    let n_correlated = neighbourhood.n_correlated;
    let neighbours = neighbourhood.within_parts(sites, pairs);
    let own = medians(sites, observations);
    let logs: Vec<f64> = own.iter().map(|median| median.log).collect();
    let mut mixture = Mixture::fit(&logs, n_correlated, at_most, MIN_LOG_SIGMA)?;
    loop {
        let costs = costs(own.len(), mixture.len(), |site, group| match &own[site] {
            median if median.log.is_finite() => median.weight() * mixture.cost(group, median.log),
            _ => 0.0,
        });
        let labelling = Labelling {
            costs: &costs,
            n_labels: mixture.len(),
            neighbours: &neighbours,
            // So many sites in the shade of a leaf tell what one of them does.
            pair_cost: neighbourhood.potts * n_correlated,
        };
        let mut labels = labelling.solve();
        let typical = typical_logs(&labels, mixture.len(), &own);
        if let Some(stray) = mixture.stray(&typical) {
            mixture = mixture.without(stray);
            continue;
        }
        let n_groups = mixture.len();
        if are_twins_among(&of_groups(&labels, n_groups, ratios)) {
            mixture = Mixture::fit(&logs, n_correlated, n_groups - 1, MIN_LOG_SIGMA)?;
            continue;
        }
        spread(&labelling, &mut labels, &sites.points, pairs);
        return Some(Materials {
            labels,
            n_groups,
            typical: Some(typical.into_iter().map(f64::exp).collect()),
        });
    }
}

fn of_clusters(
    sites: &Sites,
    pairs: &[[u32; 2]],
    ratios: &[Ratio],
    at_most: usize,
) -> Option<Materials> {
    let own = ratios.iter().map(|ratio| log_albedo(*ratio).exp());
    let own: Vec<f64> = own.collect();
    let clusters = Clusters::fit(&sites.points, &own, at_most)?;
    let n_groups = clusters.len();
    let labelling = Labelling {
        costs: &costs(own.len(), n_groups, |site, group| {
            clusters.cost(site, group)
        }),
        n_labels: n_groups,
        neighbours: pairs,
        pair_cost: Neighbourhood::of(sites.kind).potts,
    };
    let mut labels = labelling.solve();
    spread(&labelling, &mut labels, &sites.points, pairs);
    Some(Materials {
        labels,
        n_groups,
        typical: None,
    })
}

/// The data term of Eq. (4): the cost of every group for every site, site by site.
fn costs(n_sites: usize, n_groups: usize, cost: impl Fn(usize, usize) -> f64) -> Vec<f64> {
    let of_site = |site| (0..n_groups).map(move |group| (site, group));
    let all = (0..n_sites).flat_map(of_site);
    all.map(|(site, group)| cost(site, group)).collect()
}

/// Median of the own log albedos of each label's sites; NaN of a label that no site has of which views tell.
fn typical_logs(labels: &[u8], n_labels: usize, own: &[Median]) -> Vec<f64> {
    let mut by_label = vec![Vec::new(); n_labels];
    let told = labels
        .iter()
        .zip(own)
        .filter(|(_, own)| own.log.is_finite());
    told.for_each(|(&label, own)| by_label[label as usize].push(own.log));
    let typical = |logs: &mut Vec<f64>| median(logs).unwrap_or(f64::NAN);
    by_label.iter_mut().map(typical).collect()
}

/// Whether two groups are of nearly one albedo: a stain may look like two materials until each is measured.
fn are_twins_among(groups: &[f64]) -> bool {
    let mut logs: Vec<f64> = groups.iter().map(|albedo| albedo.ln()).collect();
    logs.sort_by(f64::total_cmp);
    logs.windows(2).any(|pair| pair[1] - pair[0] < SAME_GROUP)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stain_in_two_halves_is_no_second_material() {
        let are_twins = |albedos: [f64; 2]| {
            let ratios = albedos.map(|albedo| (2.0 * albedo, 2.0));
            are_twins_among(&of_groups(&[0, 1], 2, &ratios))
        };
        assert!(are_twins([0.165, 0.179]) && are_twins([0.179, 0.165]));
        assert!(!are_twins([0.15, 0.21]));
        // A group that no site belongs to has the albedo of all.
        assert!(are_twins_among(&of_groups(&[0, 0], 2, &[(0.3, 2.0); 2])));
    }
}
