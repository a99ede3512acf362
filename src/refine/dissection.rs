//! An order of elimination that fills little in: nested dissection (George 1973) by the places of the unknowns.
//!
//! Unknowns on a surface are cut in half across their longest extent, and those on the cut that meet the other half, the
//! *separator*, are eliminated after both halves, which do not know of one another. Each half is cut again, down to leaves that are
//! eliminated whole. The cuts make a tree: what lies in different branches can be eliminated at the same time, and in the same order
//! on any number of threads.

use nalgebra::Point3;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// Unknowns of a leaf at most: fewer make more calls, more make more zeros.
const LEAF: usize = 32;
/// Halves of more unknowns than this are cut at the same time.
const PARALLEL: usize = 4000;

/// Which unknowns meet: each one's neighbours.
pub struct Graph {
    starts: Vec<u32>,
    neighbours: Vec<u32>,
}

impl Graph {
    /// The graph of pairs of `n` unknowns, each named once.
    pub fn new(n: usize, pairs: &[[u32; 2]]) -> Graph {
        let mut starts = vec![0; n + 1];
        for end in pairs.iter().flatten() {
            starts[*end as usize + 1] += 1;
        }
        for k in 0..n {
            starts[k + 1] += starts[k];
        }
        let mut next = starts.clone();
        let mut neighbours = vec![0; 2 * pairs.len()];
        for &[a, b] in pairs {
            for (from, to) in [(a, b), (b, a)] {
                neighbours[next[from as usize] as usize] = to;
                next[from as usize] += 1;
            }
        }
        Graph { starts, neighbours }
    }

    /// The unknowns that meet another.
    pub fn neighbours(&self, of: u32) -> &[u32] {
        let of = of as usize;
        &self.neighbours[self.starts[of] as usize..self.starts[of + 1] as usize]
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
        let halves: Vec<AtomicU64> = places.iter().map(|_| AtomicU64::new(0)).collect();
        let cutter = Cutter {
            graph,
            places,
            halves: &halves,
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

/// Parts of more unknowns than this are cut across either of their two longer extents, where the separator is smaller.
const TRIED: usize = 300;

struct Cutter<'a> {
    graph: &'a Graph,
    places: &'a [Point3<f64>],
    /// The number of the part to which each unknown belongs; parts that are cut at the same time share none.
    halves: &'a [AtomicU64],
}

impl Cutter<'_> {
    fn dissect(&self, mut part: Vec<u32>, number: u64) -> Dissection {
        if part.len() <= LEAF {
            return Dissection::leaf(part);
        }
        let axes = self.axes(&part);
        let n_tried = if part.len() > TRIED { 2 } else { 1 };
        let mut best = self.cut(&mut part, axes[0], number);
        for &axis in &axes[1..n_tried] {
            let other = self.cut(&mut part, axis, number);
            if other.separator.len() < best.separator.len() {
                best = other;
            }
        }
        let Cut { separator, halves } = best;
        if halves.iter().any(Vec::is_empty) {
            return Dissection::leaf(part);
        }
        let numbers = [2 * number, 2 * number + 1];
        let [near, far] = halves;
        let is_large = near.len().min(far.len()) > PARALLEL;
        let below = (
            || self.dissect(near, numbers[0]),
            || self.dissect(far, numbers[1]),
        );
        let (near, far) = match is_large {
            true => rayon::join(below.0, below.1),
            false => (below.0(), below.1()),
        };
        near.joined(far, separator)
    }

    /// Cuts a part in the middle across an axis.
    fn cut(&self, part: &mut [u32], axis: usize, number: u64) -> Cut {
        let place = |unknown: &u32| self.places[*unknown as usize][axis];
        let middle = part.len() / 2;
        part.select_nth_unstable_by(middle, |a, b| place(a).total_cmp(&place(b)).then(a.cmp(b)));
        let (near, far) = part.split_at(middle);
        let numbers = [2 * number, 2 * number + 1];
        for (half, number) in [near, far].into_iter().zip(numbers) {
            for &unknown in half {
                self.halves[unknown as usize].store(number, Ordering::Relaxed);
            }
        }
        let meets = |unknown: u32, number: u64| {
            let mut neighbours = self.graph.neighbours(unknown).iter();
            neighbours.any(|&other| self.halves[other as usize].load(Ordering::Relaxed) == number)
        };
        let parted = |half: &[u32], other: u64| -> (Vec<u32>, Vec<u32>) {
            half.iter().partition(|&&unknown| meets(unknown, other))
        };
        let (on_near, near_alone) = parted(near, numbers[1]);
        let (on_far, far_alone) = parted(far, numbers[0]);
        match on_near.len() <= on_far.len() {
            true => Cut {
                separator: on_near,
                halves: [near_alone, far.to_vec()],
            },
            false => Cut {
                separator: on_far,
                halves: [near.to_vec(), far_alone],
            },
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
            for place in near.first..near.pivots.end {
                let meets = graph.neighbours(order[place]).iter();
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
