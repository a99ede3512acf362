//! An order of elimination that fills little in: nested dissection (George 1973) by the places of the unknowns.
//!
//! Unknowns on a surface are cut in two across their longest extent, or from neighbour to neighbour where that cuts fewer, and those
//! that meet the other half, the *separator*, are eliminated after both halves, which do not know of one another. Each half is cut
//! again, down to leaves that are eliminated whole. The cuts make a tree: what lies in different branches can be eliminated at the same time, and in the same order
//! on any number of threads.

use super::lists::Lists;
use nalgebra::Point3;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// Unknowns of a leaf at most: fewer make more calls, more make more zeros.
const LEAF: usize = 32;
/// Halves of more unknowns than this are cut at the same time.
const PARALLEL: usize = 4000;

/// Which unknowns meet: each one's neighbours.
pub struct Graph(Lists);

impl Graph {
    /// The graph of pairs of `n` unknowns, each named once.
    pub fn new(n: usize, pairs: &[[u32; 2]]) -> Graph {
        let both_ways = pairs.iter().flat_map(|&[a, b]| [[a, b], [b, a]]);
        Graph(Lists::new(n, both_ways))
    }

    /// The unknowns that meet another.
    pub fn neighbours(&self, of: u32) -> &[u32] {
        self.0.of(of as usize)
    }
}

/// Unknowns that are eliminated together, after those below them.
#[derive(Clone, Debug)]
pub struct Node {
    /// The nodes of both halves, if it is a separator.
    pub children: Option<[usize; 2]>,
    /// Its own unknowns, by their place in the order.
    pub pivots: Range<usize>,
    /// The first place of its own and of all below it.
    pub first: usize,
}

/// The order, and the tree of the cuts.
pub struct Dissection {
    /// The unknown at each place of the order.
    pub order: Vec<u32>,
    /// Children before their parents; the root is the last.
    pub nodes: Vec<Node>,
}

impl Dissection {
    /// Dissects a graph whose unknowns have places, metres.
    pub fn new(graph: &Graph, places: &[Point3<f64>]) -> Dissection {
        let labels: Vec<AtomicU64> = places.iter().map(|_| AtomicU64::new(0)).collect();
        let cutter = Cutter {
            graph,
            places,
            labels: &labels,
        };
        let all = (0..places.len() as u32).collect();
        let mut dissection = cutter.dissect(all, 1);
        dissection.nodes.shrink_to_fit();
        dissection
    }

    fn leaf(order: Vec<u32>) -> Dissection {
        let nodes = vec![Node {
            children: None,
            pivots: 0..order.len(),
            first: 0,
        }];
        Dissection { order, nodes }
    }

    /// Two halves, and what is eliminated after both.
    fn joined(mut self, other: Dissection, separator: Vec<u32>) -> Dissection {
        let (n_before, n_nodes) = (self.order.len(), self.nodes.len());
        self.order.extend(other.order);
        self.nodes.extend(other.nodes.into_iter().map(|node| Node {
            children: node.children.map(|pair| pair.map(|child| child + n_nodes)),
            pivots: node.pivots.start + n_before..node.pivots.end + n_before,
            first: node.first + n_before,
        }));
        let start = self.order.len();
        self.order.extend(separator);
        self.nodes.push(Node {
            children: Some([n_nodes - 1, self.nodes.len() - 1]),
            pivots: start..self.order.len(),
            first: 0,
        });
        self
    }
}

/// Parts of more unknowns than this are cut in several ways, of which that of the smallest separator counts.
const TRIED: usize = 2000;
/// Share of a part that its smaller half has at least, before the separator is taken out of it.
const LEAST_HALF: f64 = 0.4;

struct Cutter<'a> {
    graph: &'a Graph,
    places: &'a [Point3<f64>],
    /// Of each unknown the number of its part, and its place in the order by which that is cut; parts that are cut at the same time
    /// share none.
    labels: &'a [AtomicU64],
}

impl Cutter<'_> {
    fn dissect(&self, part: Vec<u32>, number: u64) -> Dissection {
        if part.len() <= LEAF {
            return Dissection::leaf(part);
        }
        let axes = self.axes(&part);
        let along = |axis| self.cut(self.sorted(&part, axis), number);
        let mut best = along(axes[0]);
        if part.len() > TRIED {
            for other in [along(axes[1]), self.cut(self.spread(&part, number), number)] {
                if other.separator.len() < best.separator.len() {
                    best = other;
                }
            }
        }
        let Cut { separator, halves } = best;
        if halves.iter().any(Vec::is_empty) {
            return Dissection::leaf(part);
        }
        let [near, far] = halves;
        let is_large = near.len().min(far.len()) > PARALLEL;
        let below = (
            || self.dissect(near, 2 * number),
            || self.dissect(far, 2 * number + 1),
        );
        let (near, far) = match is_large {
            true => rayon::join(below.0, below.1),
            false => (below.0(), below.1()),
        };
        near.joined(far, separator)
    }

    /// A part in the order along an axis.
    fn sorted(&self, part: &[u32], axis: usize) -> Vec<u32> {
        let keys = part
            .iter()
            .map(|&unknown| (self.places[unknown as usize][axis], unknown));
        let mut keys: Vec<(f64, u32)> = keys.collect();
        keys.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        keys.into_iter().map(|(_, unknown)| unknown).collect()
    }

    /// A part in the order in which neighbours of neighbours are met from one of its ends.
    fn spread(&self, part: &[u32], number: u64) -> Vec<u32> {
        let met = self.met_from(part, number);
        let from_end: Vec<u32> = met.into_iter().rev().collect();
        self.met_from(&from_end, number)
    }

    /// A part in the order in which neighbours of neighbours are met from its first unknown, then from the first that was not met.
    fn met_from(&self, part: &[u32], number: u64) -> Vec<u32> {
        self.label(part, number);
        let mut is_met = vec![false; part.len()];
        let mut met: Vec<u32> = Vec::with_capacity(part.len());
        let mut n_seen = 0;
        for (place, &start) in part.iter().enumerate() {
            if std::mem::replace(&mut is_met[place], true) {
                continue;
            }
            met.push(start);
            while let Some(&unknown) = met.get(n_seen) {
                n_seen += 1;
                for &other in self.graph.neighbours(unknown) {
                    if let Some(place) = self.place_in(other, number)
                        && !std::mem::replace(&mut is_met[place], true)
                    {
                        met.push(other);
                    }
                }
            }
        }
        met
    }

    fn label(&self, part: &[u32], number: u64) {
        for (place, &unknown) in (0..).zip(part) {
            self.labels[unknown as usize].store(number << 32 | place, Ordering::Relaxed);
        }
    }

    /// The place of an unknown in a part, if it is in it.
    fn place_in(&self, unknown: u32, number: u64) -> Option<usize> {
        let label = self.labels[unknown as usize].load(Ordering::Relaxed);
        (label >> 32 == number).then_some((label & u64::from(u32::MAX)) as usize)
    }

    /// Cuts a part that is in some order near its middle, where fewest unknowns meet others beyond.
    fn cut(&self, part: Vec<u32>, number: u64) -> Cut {
        self.label(&part, number);
        let n = part.len();
        // The least and the last place that each unknown, itself among them, meets.
        let reach = part.iter().enumerate().map(|(place, &unknown)| {
            let others = self.graph.neighbours(unknown).iter();
            let others = others.filter_map(|&other| self.place_in(other, number));
            others.fold([place; 2], |[low, high], other| {
                [low.min(other), high.max(other)]
            })
        });
        let reach: Vec<[usize; 2]> = reach.collect();
        // How many before each place meet some from there on, and the other way round.
        let mut before = vec![0i32; n + 2];
        let mut behind = vec![0i32; n + 2];
        for (place, &[low, high]) in reach.iter().enumerate() {
            before[place + 1] += 1;
            before[high + 1] -= 1;
            behind[low + 1] += 1;
            behind[place + 1] -= 1;
        }
        let (mut n_before, mut n_behind) = (0, 0);
        let first = ((LEAST_HALF * n as f64) as usize).max(1);
        let mut best = (i32::MAX, n / 2, true);
        for at in 0..=n - first {
            n_before += before[at];
            n_behind += behind[at];
            if at < first {
                continue;
            }
            for (n_met, is_before) in [(n_before, true), (n_behind, false)] {
                if n_met < best.0 {
                    best = (n_met, at, is_before);
                }
            }
        }
        let (_, at, is_before) = best;
        let (near, far) = part.split_at(at);
        let parted = |half: &[u32], from: usize, meets: &dyn Fn([usize; 2]) -> bool| {
            let mut parts = [Vec::new(), Vec::new()];
            for (&unknown, &reach) in half.iter().zip(&reach[from..]) {
                parts[usize::from(meets(reach))].push(unknown);
            }
            parts
        };
        match is_before {
            true => {
                let [alone, separator] = parted(near, 0, &|[_, high]| high >= at);
                let halves = [alone, far.to_vec()];
                Cut { separator, halves }
            }
            false => {
                let [alone, separator] = parted(far, at, &|[low, _]| low < at);
                let halves = [near.to_vec(), alone];
                Cut { separator, halves }
            }
        }
    }

    /// The axes, that along which a part extends farthest first.
    fn axes(&self, part: &[u32]) -> [usize; 3] {
        let places = part.iter().map(|&unknown| &self.places[unknown as usize]);
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for place in places {
            for axis in 0..3 {
                low[axis] = low[axis].min(place[axis]);
                high[axis] = high[axis].max(place[axis]);
            }
        }
        let mut axes = [0, 1, 2];
        let extent = |axis: usize| high[axis] - low[axis];
        axes.sort_by(|a, b| extent(*b).total_cmp(&extent(*a)));
        axes
    }
}

/// A part in two, and those between.
struct Cut {
    separator: Vec<u32>,
    halves: [Vec<u32>; 2],
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A square of `side`² unknowns that meet their neighbours, and a few others far off.
    pub(in super::super) fn square(side: usize) -> (Vec<Point3<f64>>, Vec<[u32; 2]>) {
        let places = (0..side * side).map(|k| {
            let (row, column) = (k / side, k % side);
            Point3::new(column as f64, row as f64, (0.3 * column as f64).sin())
        });
        let mut pairs = Vec::new();
        for k in 0..side * side {
            if k % side + 1 < side {
                pairs.push([k as u32, k as u32 + 1]);
            }
            if k + side < side * side {
                pairs.push([k as u32, (k + side) as u32]);
            }
            let other = (k * 31 + 5) % (side * side);
            if k % 97 == 0 && other > k + side {
                pairs.push([k as u32, other as u32]);
            }
        }
        (places.collect(), pairs)
    }

    #[test]
    fn halves_do_not_meet_and_everything_is_in_the_order_once() {
        let (places, pairs) = square(120);
        let graph = Graph::new(places.len(), &pairs);
        let Dissection { order, nodes } = Dissection::new(&graph, &places);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert!(sorted.iter().copied().eq(0..places.len() as u32));
        let mut place_of = vec![0; order.len()];
        for (place, &unknown) in order.iter().enumerate() {
            place_of[unknown as usize] = place;
        }
        let root = nodes.last().expect("a root");
        assert_eq!((root.first, root.pivots.end), (0, order.len()));
        assert!(root.pivots.len() < 200, "{:?}", root.pivots);
        for (index, node) in nodes.iter().enumerate() {
            let Some([near, far]) = node.children else {
                assert!(node.pivots.len() <= LEAF && node.first == node.pivots.start);
                continue;
            };
            assert!(near < index && far < index);
            let (near, far) = (&nodes[near], &nodes[far]);
            assert_eq!(node.first, near.first);
            assert_eq!(near.pivots.end, far.first);
            assert_eq!(far.pivots.end, node.pivots.start);
            let in_far = far.first..far.pivots.end;
            for &unknown in &order[near.first..near.pivots.end] {
                let meets = graph.neighbours(unknown).iter();
                assert!(
                    meets
                        .into_iter()
                        .all(|&other| !in_far.contains(&place_of[other as usize]))
                );
            }
        }
    }

    #[test]
    fn what_cannot_be_cut_is_a_leaf() {
        let n = 60u32;
        let pairs: Vec<[u32; 2]> = (0..n).flat_map(|b| (0..b).map(move |a| [a, b])).collect();
        let graph = Graph::new(n as usize, &pairs);
        let places = vec![Point3::origin(); n as usize];
        assert_eq!(Dissection::new(&graph, &places).nodes.len(), 1);
        let nothing = Dissection::new(&Graph::new(0, &[]), &[]);
        assert_eq!((nothing.nodes.len(), nothing.order.len()), (1, 0));
    }
}
