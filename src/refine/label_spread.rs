//! Labels of sites that no view tells of: those of the sites round them, as far as these are told of.
//!
//! Where views end, they look past rims and into shade: the last sites that they see are the worst to follow. What spreads is
//! therefore a share of each label. Shares are harmonic where nothing is known (Grady, *Random Walks for Image Segmentation*, 2006);
//! a site that views tell of pulls them towards its own label, by as much as that costs less than any other. A pair of neighbours
//! pulls by what Eq. (4) has it cost if they differ.

use super::albedo::first_of_most;
use super::cholesky::Analysis;
use super::dissection::Graph;
use super::expansion::Labelling;
use nalgebra::Point3;

/// Sites farther than so many steps from those that no view tells of simply have their label: 10 and 16 label `pot-k1` no better.
const STEPS: u32 = 6;
/// How much sites that no view tells of are pulled towards the commonest label, in units of a neighbour's pull: it decides only
/// where no path leads to others.
const TOWARDS_COMMONEST: f64 = 1e-6;
/// Of a site that takes no part.
const NONE: u32 = u32::MAX;

/// Gives the silent sites of a labelling labels; sites have places in space and `pairs` of neighbours, each named once, across
/// the folds too that part them for Eq. (4). If memory does not suffice, all of them get the commonest label.
pub fn spread(
    labelling: &Labelling,
    labels: &mut [u8],
    places: &[Point3<f64>],
    pairs: &[[u32; 2]],
) {
    let is_silent = |site: u32| labelling.is_silent(site as usize);
    let silent: Vec<u32> = (0..labels.len() as u32).filter(|&s| is_silent(s)).collect();
    let n_silent = silent.len();
    if labelling.n_labels < 2 || n_silent == 0 {
        return;
    }
    let graph = Graph::new(labels.len(), pairs);
    let near = within_steps(silent, &graph, labels.len());
    let mut index_of = vec![NONE; labels.len()];
    for (index, &site) in (0..).zip(&near) {
        index_of[site as usize] = index;
    }
    let commonest = commonest(labelling, labels);
    for &site in &near[..n_silent] {
        labels[site as usize] = commonest;
    }
    let mut diagonal = Vec::with_capacity(near.len());
    let mut pulls = vec![0.0; labelling.n_labels * near.len()];
    let mut among_them = Vec::new();
    for (index, &site) in near.iter().enumerate() {
        let (towards, pull) = if is_silent(site) {
            (commonest, TOWARDS_COMMONEST)
        } else {
            let label = labels[site as usize];
            let lead = labelling.lead(site as usize, label);
            (label, lead / labelling.pair_cost)
        };
        pulls[towards as usize * near.len() + index] += pull;
        let around = graph.neighbours(site);
        for &other in around {
            match index_of[other as usize] {
                NONE => pulls[labels[other as usize] as usize * near.len() + index] += 1.0,
                beside if beside > index as u32 => among_them.push([index as u32, beside]),
                _ => {}
            }
        }
        diagonal.push(pull + around.len() as f64);
    }
    let places: Vec<Point3<f64>> = near.iter().map(|&site| places[site as usize]).collect();
    let analysis = Analysis::new(&places, &among_them);
    let Some(factor) = analysis.factorise(&diagonal, &vec![-1.0; among_them.len()]) else {
        return;
    };
    let shares = factor.solve(pulls);
    for (index, &site) in near[..n_silent].iter().enumerate() {
        let share = |label: u8| shares[label as usize * near.len() + index];
        let all = 0..labelling.n_labels as u8;
        let largest = all.max_by(|&a, &b| share(a).total_cmp(&share(b)));
        labels[site as usize] = largest.unwrap_or(commonest);
    }
}

/// The given sites, then those at most `STEPS` from them.
fn within_steps(mut sites: Vec<u32>, graph: &Graph, n_sites: usize) -> Vec<u32> {
    let mut is_in = vec![false; n_sites];
    sites.iter().for_each(|&site| is_in[site as usize] = true);
    let mut first = 0;
    for _ in 0..STEPS {
        let last = sites.len();
        for at in first..last {
            for &other in graph.neighbours(sites[at]) {
                if !std::mem::replace(&mut is_in[other as usize], true) {
                    sites.push(other);
                }
            }
        }
        first = last;
    }
    sites
}

/// The label that most sites have of which views tell, the first of several.
fn commonest(labelling: &Labelling, labels: &[u8]) -> u8 {
    let mut counts = vec![0usize; labelling.n_labels];
    for (site, &label) in labels.iter().enumerate() {
        counts[label as usize] += usize::from(!labelling.is_silent(site));
    }
    first_of_most(&counts) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What each site's two labels cost, in a row of sites of which each is joined to the next, but for one gap.
    fn spread_in_a_row(costs: &[[f64; 2]], gap: usize) -> Vec<u8> {
        let labelling = Labelling {
            costs: costs.as_flattened(),
            n_labels: 2,
            neighbours: &[],
            pair_cost: 5.0,
        };
        let mut labels: Vec<u8> = costs
            .iter()
            .map(|cost| u8::from(cost[1] < cost[0]))
            .collect();
        let places: Vec<Point3<f64>> = (0..costs.len())
            .map(|site| Point3::new(0.001 * site as f64, 0.0, 0.0))
            .collect();
        let pairs: Vec<[u32; 2]> = (1..costs.len() as u32)
            .filter(|&site| site as usize != gap)
            .map(|site| [site - 1, site])
            .collect();
        spread(&labelling, &mut labels, &places, &pairs);
        labels
    }

    const FIRST: [f64; 2] = [0.0, 5.0];
    const SECOND: [f64; 2] = [5.0, 0.0];
    const SILENT: [f64; 2] = [0.3, 0.3];

    #[test]
    fn silent_sites_follow_the_nearer_of_two_sides() {
        let mut costs = [SILENT; 12];
        costs[..3].fill(FIRST);
        costs[9..].fill(SECOND);
        assert_eq!(
            spread_in_a_row(&costs, 0),
            [0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1]
        );
    }

    #[test]
    fn silent_sites_do_not_follow_a_doubtful_rim() {
        let mut costs = [SILENT; 12];
        costs[..5].fill(FIRST);
        costs[5] = [0.1, 0.0];
        let labels = spread_in_a_row(&costs, 0);
        assert_eq!(
            labels,
            [0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0],
            "the rim keeps its own"
        );
        costs[5] = SECOND;
        let labels = spread_in_a_row(&costs, 0);
        assert_eq!(labels[5..], [1; 7], "a rim without doubt is followed");
    }

    #[test]
    fn silent_sites_apart_from_all_others_take_the_commonest_label() {
        let mut costs = [SILENT; 12];
        costs[..2].fill(FIRST);
        costs[2..6].fill(SECOND);
        assert_eq!(spread_in_a_row(&costs, 8)[6..], [1; 6]);
        costs[4..6].fill(SILENT);
        let labels = spread_in_a_row(&costs, 8);
        assert_eq!(labels[8..], [0; 4], "the first of two that are as common");
    }
}
