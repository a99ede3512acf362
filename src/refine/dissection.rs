//! An order of elimination that fills little in: nested dissection (George 1973) by the places of the unknowns.
//!
//! Unknowns on a surface are cut in two across their longest extent, or from neighbour to neighbour where that cuts fewer, and those
//! that meet the other half, the *separator*, are eliminated after both halves, which do not know of one another. Each half is cut
//! again, down to leaves that are eliminated whole. The cuts make a tree: what lies in different branches can be eliminated at the same
//! time, and in the same order on any number of threads.
//!
//! Where the unknowns halve the pairs of a coarser graph, its cuts are theirs, and only its leaves are cut anew.

use crate::geometry::Lists;
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
        let all: Vec<u32> = (0..places.len() as u32).collect();
        let themselves: Vec<[u32; 2]> = all.iter().map(|&unknown| [unknown; 2]).collect();
        let cut = with_cutter(graph, places, |cutter| cutter.dissect(all, 1));
        cut.finer(&themselves, graph, places)
    }

    /// Dissects a graph of which each unknown lies between two that meet in this one's, its parents, or is one of this one's. The cuts
    /// are this one's as far as they part what meets.
    pub fn finer(&self, parents: &[[u32; 2]], graph: &Graph, places: &[Point3<f64>]) -> Dissection {
        let node_of = self.node_of_unknowns();
        // Of two that meet one's node is above the other's, and has the larger number.
        let between = |ends: &[u32; 2]| {
            let [p, q] = ends.map(|end| node_of[end as usize]);
            p.min(q)
        };
        let mut members = Members {
            tree: Tree::new(&self.nodes),
            graph,
            node_of: parents.iter().map(between).collect(),
        };
        members.raise();
        let members = members.thinned();
        let root = self.nodes.len() - 1;
        with_cutter(graph, places, |cutter| {
            cutter.dissect_below(root, &self.nodes, &members, 1)
        })
    }

    /// The node of each unknown.
    pub fn node_of_unknowns(&self) -> Vec<u32> {
        let mut node_of = vec![0; self.order.len()];
        for (index, node) in (0..).zip(&self.nodes) {
            for &unknown in &self.order[node.pivots.clone()] {
                node_of[unknown as usize] = index;
            }
        }
        node_of
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

/// The nodes from below.
struct Tree<'a> {
    nodes: &'a [Node],
    /// The node above each; the root's own is itself.
    parents: Vec<u32>,
}

impl Tree<'_> {
    fn new(nodes: &[Node]) -> Tree<'_> {
        let mut parents: Vec<u32> = (0..nodes.len() as u32).collect();
        for (index, node) in (0..).zip(nodes) {
            for child in node.children.into_iter().flatten() {
                parents[child] = index;
            }
        }
        Tree { nodes, parents }
    }

    /// The first node from one upwards that is above another or below it, or is it.
    fn above(&self, mut node: u32, other: u32) -> u32 {
        while !self.is_within(node, other) && !self.is_within(other, node) {
            node = self.parents[node as usize];
        }
        node
    }

    /// Whether a node is below another or is it.
    fn is_within(&self, node: u32, other: u32) -> bool {
        let (node, other) = (&self.nodes[node as usize], &self.nodes[other as usize]);
        other.first <= node.first && node.pivots.end <= other.pivots.end
    }
}

/// The unknowns of a graph at the nodes of a tree that was cut through another.
struct Members<'a> {
    tree: Tree<'a>,
    graph: &'a Graph,
    /// Of each unknown.
    node_of: Vec<u32>,
}

/// How often each separator is made smaller at most, to one side and to the other in turn; arbitrary.
const THINNINGS: usize = 8;
/// In place of an unknown.
const NONE: u32 = u32::MAX;

impl Members<'_> {
    /// Raises unknowns that meet others in other branches until they are above these.
    fn raise(&mut self) {
        for unknown in 0..self.node_of.len() {
            for &other in self.graph.neighbours(unknown as u32) {
                let (node, other) = (self.node_of[unknown], self.node_of[other as usize]);
                self.node_of[unknown] = self.tree.above(node, other);
            }
        }
    }

    /// The unknowns of each node, from the root downwards after its separator has been made smaller.
    fn thinned(&mut self) -> Vec<Vec<u32>> {
        let mut members = vec![Vec::new(); self.tree.nodes.len()];
        for (unknown, &node) in (0..).zip(&self.node_of) {
            members[node as usize].push(unknown);
        }
        for node in (0..members.len()).rev() {
            let mut own = std::mem::take(&mut members[node]);
            // Some have gone to a node above since, and some of these have come back.
            own.retain(|&unknown| self.node_of[unknown as usize] == node as u32);
            own.sort_unstable();
            own.dedup();
            if let Some(halves) = self.tree.nodes[node].children {
                for thinning in 0..THINNINGS {
                    let half = halves[thinning % 2];
                    let lowered = self.thin(node, &mut own, half, halves[1 - thinning % 2]);
                    if lowered.is_empty() && thinning > 0 {
                        break;
                    }
                    members[half].extend(lowered);
                }
            }
            members[node] = own;
        }
        members
    }

    /// Lowers to one half those of a separator that meet nobody in the other, and where several meet but one and the same, which takes
    /// their place. Returns them.
    fn thin(&mut self, node: usize, own: &mut Vec<u32>, half: usize, other: usize) -> Vec<u32> {
        // Those that meet at most one there, after that one.
        let mut few: Vec<[u32; 2]> = Vec::new();
        for &unknown in own.iter() {
            let neighbours = self.graph.neighbours(unknown).iter().copied();
            let mut met = neighbours.filter(|&met| {
                let node = self.node_of[met as usize];
                self.tree.is_within(node, other as u32)
            });
            match (met.next(), met.next()) {
                (None, _) => few.push([NONE, unknown]),
                (Some(only), None) => few.push([only, unknown]),
                _ => {}
            }
        }
        few.sort_unstable();
        let mut lowered = Vec::new();
        for group in few.chunk_by(|a, b| a[0] == b[0]) {
            let [only, _] = group[0];
            if only != NONE {
                if group.len() == 1 {
                    continue;
                }
                self.node_of[only as usize] = node as u32;
                own.push(only);
            }
            for &[_, unknown] in group {
                self.node_of[unknown as usize] = half as u32;
                lowered.push(unknown);
            }
        }
        own.retain(|&unknown| self.node_of[unknown as usize] == node as u32);
        lowered
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
        let (near, far) = both(
            near.len().min(far.len()) > PARALLEL,
            || self.dissect(near, 2 * number),
            || self.dissect(far, 2 * number + 1),
        );
        near.joined(far, separator)
    }

    /// Dissects the members of a coarser dissection's node and of all below it.
    fn dissect_below(
        &self,
        node: usize,
        nodes: &[Node],
        members: &[Vec<u32>],
        number: u64,
    ) -> Dissection {
        let own = members[node].clone();
        let Some([near, far]) = nodes[node].children else {
            return self.dissect(own, number);
        };
        let n_below = |node: usize| nodes[node].pivots.end - nodes[node].first;
        let (near, far) = both(
            n_below(near).min(n_below(far)) > PARALLEL,
            || self.dissect_below(near, nodes, members, 2 * number),
            || self.dissect_below(far, nodes, members, 2 * number + 1),
        );
        near.joined(far, own)
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

/// Does what is to be done for both halves, at the same time if that is worth a thread.
pub fn both<A: Send, B: Send>(
    at_once: bool,
    near: impl FnOnce() -> A + Send,
    far: impl FnOnce() -> B + Send,
) -> (A, B) {
    match at_once {
        true => rayon::join(near, far),
        false => (near(), far()),
    }
}

fn with_cutter<T>(graph: &Graph, places: &[Point3<f64>], run: impl FnOnce(&Cutter) -> T) -> T {
    let labels: Vec<AtomicU64> = places.iter().map(|_| AtomicU64::new(0)).collect();
    run(&Cutter {
        graph,
        places,
        labels: &labels,
    })
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

    /// A square of `side`² unknowns at steps of `step`, in triangles, and a few that meet others far off.
    fn triangles(side: usize, step: f64) -> (Vec<Point3<f64>>, Vec<[u32; 2]>) {
        let at = |row: usize, column: usize| (row * side + column) as u32;
        let mut places = Vec::new();
        let mut pairs = Vec::new();
        for row in 0..side {
            for column in 0..side {
                places.push(Point3::new(column as f64 * step, row as f64 * step, 0.0));
                for (down, right) in [(0, 1), (1, 0), (1, 1)] {
                    if row + down < side && column + right < side {
                        pairs.push([at(row, column), at(row + down, column + right)]);
                    }
                }
                let far = [row + side / 9, column + side / 7];
                if (row * side + column).is_multiple_of(101) && far.iter().all(|&k| k < side) {
                    pairs.push([at(row, column), at(far[0], far[1])]);
                }
            }
        }
        (places, pairs)
    }

    /// Checks that halves do not meet and that everything is in the order once; returns how many are in the root.
    fn check(dissection: &Dissection, graph: &Graph, n: usize) -> usize {
        let Dissection { order, nodes } = dissection;
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert!(sorted.iter().copied().eq(0..n as u32));
        let mut place_of = vec![0; n];
        for (place, &unknown) in order.iter().enumerate() {
            place_of[unknown as usize] = place;
        }
        let root = nodes.last().expect("a root");
        assert_eq!((root.first, root.pivots.end), (0, n));
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
        root.pivots.len()
    }

    #[test]
    fn halves_do_not_meet_and_everything_is_in_the_order_once() {
        let (places, pairs) = square(120);
        let graph = Graph::new(places.len(), &pairs);
        let n_root = check(&Dissection::new(&graph, &places), &graph, places.len());
        assert!(n_root < 200, "{n_root}");
    }

    #[test]
    fn cuts_of_a_coarser_graph_part_a_finer_one() {
        let side = 50;
        let (places, pairs) = triangles(side, 2.0);
        let coarse = Dissection::new(&Graph::new(places.len(), &pairs), &places);
        let fine = 2 * side - 1;
        let (places, pairs) = triangles(fine, 1.0);
        let graph = Graph::new(places.len(), &pairs);
        let parents = (0..fine * fine).map(|k| {
            let (row, column) = (k / fine, k % fine);
            let above = row / 2 * side + column / 2;
            let below = row.div_ceil(2) * side + column.div_ceil(2);
            [above as u32, below as u32]
        });
        let parents: Vec<[u32; 2]> = parents.collect();
        let finer = coarse.finer(&parents, &graph, &places);
        let n_root = check(&finer, &graph, places.len());
        let anew = Dissection::new(&graph, &places);
        let n_anew = check(&anew, &graph, places.len());
        assert!(4 * n_root < 5 * n_anew, "{n_root} for {n_anew}");
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
