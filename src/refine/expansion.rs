//! Labels of least energy under a Potts model, Eq. (4), by expansion moves (Boykov, Veksler and Zabih 2001): for one label
//! after another, the best of all labellings in which any number of sites change to it, as a smallest cut.

use super::max_flow::{Edge, FlowNetwork};
use std::cmp::Reverse;

/// What labels cost: each at each site, and each neighbour with another one.
pub struct Labelling<'a> {
    /// Cost of every label at every site, site by site.
    pub costs: &'a [f64],
    /// How many labels there are.
    pub n_labels: usize,
    /// Every two sites that are neighbours, once.
    pub neighbours: &'a [[u32; 2]],
    /// Cost of two neighbours with different labels.
    pub pair_cost: f64,
}

/// Whole numbers of a network to a unit of cost.
const RESOLUTION: f64 = 1024.0;
/// No label costs this much more than another: less than what rounding could carry away.
const MAX_DIFFERENCE: f64 = 1e6;
/// Cycles over all labels at most; two or three are the rule.
const MAX_CYCLES: usize = 5;

/// What becomes of a site when a label expands.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Fate {
    /// It keeps its label, whatever its neighbours do.
    Keeps,
    /// It takes the label, or has it already.
    Changes,
    /// The cut decides.
    Open,
}

impl Labelling<'_> {
    /// Two labels by one cut, which is the least energy of all (Greig, Porteous and Seheult 1989); of more the commonest for all
    /// sites, then expanded, the commoner first, until no label lowers the energy. A label that lies between two others, and fits
    /// the sites of both badly, would keep those of both if it came before them: each of them gains less by itself than its border
    /// costs.
    ///
    /// Silent sites take part in no cut, and what they are given here means nothing.
    pub fn solve(&self) -> Vec<u8> {
        let is_silent: Vec<bool> = (0..self.n_sites())
            .map(|site| self.is_silent(site))
            .collect();
        let speak = |pair: &&[u32; 2]| pair.iter().all(|&site| !is_silent[site as usize]);
        let neighbours: Vec<[u32; 2]> = self.neighbours.iter().filter(speak).copied().collect();
        let among_themselves = Labelling {
            neighbours: &neighbours,
            ..*self
        };
        among_themselves.cut()
    }

    /// Whether all labels cost a site the same.
    pub fn is_silent(&self, site: usize) -> bool {
        self.costs_of(site)
            .windows(2)
            .all(|pair| pair[0] == pair[1])
    }

    /// By how much a label costs a site less than any other; nothing if it does not.
    pub fn lead(&self, site: usize, label: u8) -> f64 {
        let costs = self.costs_of(site).iter().enumerate();
        let others = costs.filter(|&(other, _)| other != label as usize);
        let cheapest = others.map(|(_, &cost)| cost).fold(f64::INFINITY, f64::min);
        (cheapest - self.cost(site, label)).max(0.0)
    }

    fn n_sites(&self) -> usize {
        self.costs.len() / self.n_labels.max(1)
    }

    fn costs_of(&self, site: usize) -> &[f64] {
        &self.costs[site * self.n_labels..][..self.n_labels]
    }

    fn cut(&self) -> Vec<u8> {
        match self.n_labels {
            0 | 1 => vec![0; self.n_sites()],
            2 => self.expanded(&vec![0; self.n_sites()], 1),
            _ => self.expanded_by_all(&self.commonest_first()),
        }
    }

    /// All labels, those first that cost the most sites the least.
    fn commonest_first(&self) -> Vec<u8> {
        let mut counts = vec![0usize; self.n_labels];
        let speaking = (0..self.n_sites()).filter(|&site| !self.is_silent(site));
        for site in speaking {
            let costs = self.costs_of(site);
            let cheapest = (0..costs.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b]));
            counts[cheapest.unwrap_or(0)] += 1;
        }
        let mut labels: Vec<u8> = (0..self.n_labels as u8).collect();
        labels.sort_by_key(|&label| Reverse(counts[label as usize]));
        labels
    }

    /// The first label for all sites, expanded by each in the order that is given until none lowers the energy.
    fn expanded_by_all(&self, order: &[u8]) -> Vec<u8> {
        let mut labels = vec![order[0]; self.n_sites()];
        let mut energy = self.energy(&labels);
        let mut n_in_vain = 1;
        let following = order.iter().cycle().skip(1);
        for &label in following.take(MAX_CYCLES * self.n_labels) {
            let expanded = self.expanded(&labels, label);
            let lower = self.energy(&expanded);
            if lower < energy {
                (labels, energy) = (expanded, lower);
                n_in_vain = 0;
            } else {
                n_in_vain += 1;
            }
            if n_in_vain == self.n_labels {
                break;
            }
        }
        labels
    }

    /// Energy of a labelling.
    pub fn energy(&self, labels: &[u8]) -> f64 {
        let own = labels.iter().enumerate();
        let own: f64 = own.map(|(site, &label)| self.cost(site, label)).sum();
        let n_unlike = self
            .pairs()
            .filter(|&(site, other)| labels[site] != labels[other])
            .count();
        own + self.pair_cost * n_unlike as f64
    }

    fn cost(&self, site: usize, label: u8) -> f64 {
        self.costs[site * self.n_labels + label as usize]
    }

    /// Every two neighbours once.
    fn pairs(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let pair = |&[p, q]: &[u32; 2]| (p as usize, q as usize);
        self.neighbours.iter().map(pair)
    }

    /// The best labelling in which sites keep their labels or take `label`: those beyond the cut, on the sink's side.
    fn expanded(&self, labels: &[u8], label: u8) -> Vec<u8> {
        let whole =
            |cost: f64| (cost.clamp(-MAX_DIFFERENCE, MAX_DIFFERENCE) * RESOLUTION).round() as i64;
        let pair = whole(self.pair_cost);
        // What changing costs more than keeping: from the source where positive, which a site beyond the cut pays.
        let mut terminals: Vec<i64> = (0..labels.len())
            .map(|site| whole(self.cost(site, label) - self.cost(site, labels[site])))
            .collect();
        let mut all_pairs = vec![0; labels.len()];
        for (p, q) in self.pairs() {
            all_pairs[p] += pair;
            all_pairs[q] += pair;
        }
        // All its neighbours cannot outweigh a larger difference: what such a site does needs no cut.
        let fates: Vec<Fate> = (0..labels.len())
            .map(|site| match terminals[site] {
                _ if labels[site] == label => Fate::Changes,
                difference if difference > all_pairs[site] => Fate::Keeps,
                difference if difference < -all_pairs[site] => Fate::Changes,
                _ => Fate::Open,
            })
            .collect();
        let mut edges = Vec::new();
        for (p, q) in self.pairs() {
            // Both keep: `both`; one changes: `pair`; both change: nothing.
            let both = if labels[p] == labels[q] { 0 } else { pair };
            match (fates[p], fates[q]) {
                (Fate::Changes, Fate::Open) => terminals[q] -= pair,
                (Fate::Open, Fate::Changes) => terminals[p] -= pair,
                (Fate::Keeps, Fate::Open) => terminals[q] += pair - both,
                (Fate::Open, Fate::Keeps) => terminals[p] += pair - both,
                (Fate::Open, Fate::Open) => {
                    terminals[p] += pair - both;
                    terminals[q] -= pair;
                    edges.push(Edge {
                        ends: [p as u32, q as u32],
                        capacities: [2 * pair - both, 0],
                    });
                }
                _ => {}
            }
        }
        let keeps = FlowNetwork::new(terminals, &edges).source_side();
        let changed = |(&old, keeps): (&u8, bool)| if keeps { old } else { label };
        labels.iter().zip(keeps).map(changed).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ring of an even number of sites, each joined to the one across.
    fn ring(n: u32) -> Vec<[u32; 2]> {
        let beside = (0..n).map(|site| [site, (site + 1) % n]);
        beside
            .chain((0..n / 2).map(|site| [site, site + n / 2]))
            .collect()
    }

    /// Sites in a row.
    fn strip(n: u32) -> Vec<[u32; 2]> {
        (1..n).map(|site| [site - 1, site]).collect()
    }

    fn costs(n: usize, n_labels: usize, turn: usize) -> Vec<f64> {
        let golden = |k: usize| ((k + 31 * turn) as f64 * 0.618_034).fract();
        (0..n * n_labels)
            .map(|k| 4.0 * golden(k) * golden(3 * k))
            .collect()
    }

    #[test]
    fn labels_of_a_small_ring_cost_hardly_more_than_the_best() {
        let neighbours = ring(8);
        let (mut found, mut best) = (0.0, 0.0);
        for turn in 0..20 {
            for n_labels in [2usize, 3] {
                let costs = costs(8, n_labels, turn);
                let labelling = Labelling {
                    costs: &costs,
                    n_labels,
                    neighbours: &neighbours,
                    pair_cost: 0.7,
                };
                let digit = |k: usize, site: u32| (k / n_labels.pow(site) % n_labels) as u8;
                let least = (0..n_labels.pow(8))
                    .map(|k| {
                        labelling.energy(&(0..8).map(|site| digit(k, site)).collect::<Vec<_>>())
                    })
                    .fold(f64::INFINITY, f64::min);
                let energy = labelling.energy(&labelling.solve());
                // Boykov et al. show at most twice the least; rounding is below 0.01.
                assert!(energy >= least - 1e-9 && energy <= 2.0 * least + 0.01);
                assert!(
                    n_labels > 2 || energy < least + 0.01,
                    "two labels take the least"
                );
                (found, best) = (found + energy, best + least);
            }
        }
        assert!(found < 1.01 * best, "{found} for {best}");
    }

    #[test]
    fn sites_that_all_labels_cost_the_same_hold_nobody() {
        // Two at the left end prefer the first label, two at the right end the second; nothing is known of those between.
        let neighbours = strip(10);
        let mut costs = vec![0.3; 20];
        costs[..4].copy_from_slice(&[0.0, 1.0, 0.0, 1.0]);
        costs[16..].copy_from_slice(&[1.0, 0.0, 1.0, 0.0]);
        let labelling = Labelling {
            costs: &costs,
            n_labels: 2,
            neighbours: &neighbours,
            // Were those between joined to both ends, one border would cost more than all that is known.
            pair_cost: 5.0,
        };
        let labels = labelling.solve();
        assert_eq!((&labels[..2], &labels[8..]), (&[0, 0][..], &[1, 1][..]));
        let is_silent: Vec<bool> = (0..10).map(|site| labelling.is_silent(site)).collect();
        assert_eq!(
            is_silent,
            (0..10)
                .map(|site| (2..8).contains(&site))
                .collect::<Vec<_>>()
        );
        assert_eq!((labelling.lead(0, 0), labelling.lead(0, 1)), (1.0, 0.0));
    }

    #[test]
    fn a_label_between_two_others_does_not_keep_the_sites_of_both() {
        // Two halves of a strip, and between their labels, by number too, one that fits both a little worse.
        let n = 40u32;
        let neighbours = strip(n);
        let (left, right, stray) = ([0.0, 3.9, 9.0], [9.0, 1.5, 0.0], [1.0, 0.0, 1.0]);
        let costs: Vec<f64> = (0..n)
            .flat_map(|site| match site {
                7 | 31 => stray,
                0..12 => left,
                _ => right,
            })
            .collect();
        let labelling = Labelling {
            costs: &costs,
            n_labels: 3,
            neighbours: &neighbours,
            pair_cost: 60.0,
        };
        let halves: Vec<u8> = (0..n).map(|site| if site < 12 { 0 } else { 2 }).collect();
        assert_eq!(labelling.solve(), halves);
        assert!(labelling.energy(&halves) < labelling.energy(&vec![1; n as usize]));
    }

    #[test]
    fn a_lone_site_follows_its_neighbours_and_a_block_does_not() {
        // A strip of sites in which one in the middle, and a block of ten at the end, prefer the second label a little.
        let n = 40u32;
        let neighbours = strip(n);
        let prefers = |site: u32| site == 12 || site >= 30;
        let costs: Vec<f64> = (0..n)
            .flat_map(|site| {
                if prefers(site) {
                    [1.0, 0.0]
                } else {
                    [0.0, 1.0]
                }
            })
            .collect();
        let labelling = Labelling {
            costs: &costs,
            n_labels: 2,
            neighbours: &neighbours,
            pair_cost: 1.5,
        };
        let expected: Vec<u8> = (0..n).map(|site| u8::from(site >= 30)).collect();
        assert_eq!(labelling.solve(), expected);
    }
}
