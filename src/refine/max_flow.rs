//! The largest flow through a network and the smallest cut, by two trees that grow towards each other (Boykov and Kolmogorov, *An
//! Experimental Comparison of Min-Cut/Max-Flow Algorithms*, PAMI 2004).
//!
//! Source and sink are not nodes: each node has a capacity from the source or one to the sink. Capacities are whole numbers,
//! so that it ends and gives the same cut everywhere.

use std::collections::VecDeque;

/// An edge between two nodes with a capacity in either direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Edge {
    /// Its nodes.
    pub ends: [u32; 2],
    /// From the first to the second, and back; not negative.
    pub capacities: [i64; 2],
}

/// A network with the flow so far, as what is left of every capacity.
pub struct FlowNetwork {
    /// What is left from the source where positive, to the sink where negative.
    terminals: Vec<i64>,
    /// Where the arcs of each node begin; one more than nodes.
    starts: Vec<u32>,
    heads: Vec<u32>,
    /// The arc in the other direction.
    twins: Vec<u32>,
    left: Vec<i64>,
}

impl FlowNetwork {
    /// A network of nodes with capacities from the source (positive) or to the sink (negative).
    ///
    /// # Panics
    /// If an edge names a node that does not exist.
    pub fn new(terminals: Vec<i64>, edges: &[Edge]) -> FlowNetwork {
        let mut starts = vec![0u32; terminals.len() + 1];
        for end in edges.iter().flat_map(|edge| edge.ends) {
            starts[end as usize + 1] += 1;
        }
        for node in 0..terminals.len() {
            starts[node + 1] += starts[node];
        }
        let mut free = starts.clone();
        let n_arcs = 2 * edges.len();
        let mut network = FlowNetwork {
            terminals,
            starts,
            heads: vec![0; n_arcs],
            twins: vec![0; n_arcs],
            left: vec![0; n_arcs],
        };
        for Edge { ends, capacities } in edges {
            let arcs = ends.map(|end| {
                let arc = free[end as usize];
                free[end as usize] += 1;
                arc
            });
            for side in 0..2 {
                let arc = arcs[side] as usize;
                network.heads[arc] = ends[1 - side];
                network.twins[arc] = arcs[1 - side];
                network.left[arc] = capacities[side];
            }
        }
        network
    }

    /// Which nodes are on the source's side of a smallest cut: of all of them the one that leaves fewest there.
    pub fn source_side(self) -> Vec<bool> {
        let forest = Forest::grown(self);
        let trees = forest.trees.iter();
        trees.map(|&tree| tree == Tree::Source).collect()
    }

    fn arcs(&self, node: u32) -> std::ops::Range<u32> {
        self.starts[node as usize]..self.starts[node as usize + 1]
    }

    fn head(&self, arc: u32) -> u32 {
        self.heads[arc as usize]
    }

    fn twin(&self, arc: u32) -> u32 {
        self.twins[arc as usize]
    }

    /// What is left of an arc in the direction in which a tree grows along it: from the source, or towards the sink.
    fn left_outwards(&self, arc: u32, tree: Tree) -> i64 {
        match tree {
            Tree::Sink => self.left[self.twin(arc) as usize],
            _ => self.left[arc as usize],
        }
    }

    fn send(&mut self, arc: u32, amount: i64) -> i64 {
        let twin = self.twin(arc);
        self.left[twin as usize] += amount;
        let left = &mut self.left[arc as usize];
        *left -= amount;
        *left
    }
}

/// Whose tree a node belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Tree {
    /// Nobody's.
    Free,
    /// Reached from the source over what is left.
    Source,
    /// Reaches the sink.
    Sink,
}

/// In place of the arc to a parent: the source or sink itself, and none yet.
const TERMINAL: u32 = u32::MAX;
const ORPHAN: u32 = u32::MAX - 1;

/// A tree from the source and one from the sink, over what is left of the capacities. Where they touch flow is sent, and what that
/// cuts off is grown on again elsewhere.
struct Forest {
    network: FlowNetwork,
    trees: Vec<Tree>,
    /// Arc from each node to its parent.
    parents: Vec<u32>,
    /// Arcs to the terminal, and in which turn that was so.
    depths: Vec<u32>,
    stamps: Vec<u32>,
    turn: u32,
    /// Nodes beside which their tree may grow.
    active: VecDeque<u32>,
    is_active: Vec<bool>,
    orphans: VecDeque<u32>,
}

impl Forest {
    fn grown(network: FlowNetwork) -> Forest {
        let n = network.terminals.len();
        let mut forest = Forest {
            trees: vec![Tree::Free; n],
            parents: vec![ORPHAN; n],
            depths: vec![0; n],
            stamps: vec![0; n],
            turn: 1,
            active: VecDeque::new(),
            is_active: vec![false; n],
            orphans: VecDeque::new(),
            network,
        };
        for node in 0..n as u32 {
            let terminal = forest.network.terminals[node as usize];
            if terminal != 0 {
                let tree = if terminal > 0 {
                    Tree::Source
                } else {
                    Tree::Sink
                };
                forest.trees[node as usize] = tree;
                forest.parents[node as usize] = TERMINAL;
                forest.depths[node as usize] = 1;
                forest.activate(node);
            }
        }
        while let Some(&node) = forest.active.front() {
            match forest.bridge(node) {
                // The node may have more.
                Some(bridge) => {
                    forest.turn += 1;
                    forest.send(bridge);
                    while let Some(orphan) = forest.orphans.pop_front() {
                        forest.adopt(orphan);
                    }
                }
                None => {
                    forest.active.pop_front();
                    forest.is_active[node as usize] = false;
                }
            }
        }
        forest
    }

    fn activate(&mut self, node: u32) {
        if !std::mem::replace(&mut self.is_active[node as usize], true) {
            self.active.push_back(node);
        }
    }

    /// Grows a tree by the free neighbours of a node; an arc from the source's tree to the sink's, if there is one.
    fn bridge(&mut self, node: u32) -> Option<u32> {
        let tree = self.trees[node as usize];
        if tree == Tree::Free {
            return None;
        }
        for arc in self.network.arcs(node) {
            if self.network.left_outwards(arc, tree) == 0 {
                continue;
            }
            let other = self.network.head(arc);
            let (from, to) = (node as usize, other as usize);
            if self.trees[to] == Tree::Free {
                self.trees[to] = tree;
                self.hang(other, self.network.twin(arc), node);
                self.activate(other);
            } else if self.trees[to] != tree {
                return Some(match tree {
                    Tree::Sink => self.network.twin(arc),
                    _ => arc,
                });
            } else if self.stamps[to] <= self.stamps[from]
                && self.depths[to] > self.depths[from] + 1
            {
                // A shorter way.
                self.hang(other, self.network.twin(arc), node);
            }
        }
        None
    }

    fn hang(&mut self, node: u32, arc: u32, parent: u32) {
        self.parents[node as usize] = arc;
        self.stamps[node as usize] = self.stamps[parent as usize];
        self.depths[node as usize] = self.depths[parent as usize] + 1;
    }

    /// The arcs from a node of a tree to its terminal, in the direction of flow, and the node at the terminal.
    fn way(&self, mut node: u32) -> (Vec<u32>, u32) {
        let mut arcs = Vec::new();
        loop {
            let arc = self.parents[node as usize];
            if arc == TERMINAL {
                return (arcs, node);
            }
            arcs.push(match self.trees[node as usize] {
                Tree::Source => self.network.twin(arc),
                _ => arc,
            });
            node = self.network.head(arc);
        }
    }

    /// Sends as much as the way over a bridge takes; nodes whose arc to the parent that fills are orphans.
    fn send(&mut self, bridge: u32) {
        let tail = self.network.head(self.network.twin(bridge));
        let ((before, source), (after, sink)) =
            (self.way(tail), self.way(self.network.head(bridge)));
        let ends =
            self.network.terminals[source as usize].min(-self.network.terminals[sink as usize]);
        let arcs = before.iter().chain(&after).chain([&bridge]);
        let amount = arcs.fold(ends, |least, &arc| {
            least.min(self.network.left[arc as usize])
        });
        self.network.send(bridge, amount);
        for &arc in &before {
            if self.network.send(arc, amount) == 0 {
                self.cut_off(self.network.head(arc));
            }
        }
        for &arc in &after {
            if self.network.send(arc, amount) == 0 {
                self.cut_off(self.network.head(self.network.twin(arc)));
            }
        }
        for (node, sent) in [(source, -amount), (sink, amount)] {
            let left = &mut self.network.terminals[node as usize];
            *left += sent;
            if *left == 0 {
                self.cut_off(node);
            }
        }
    }

    fn cut_off(&mut self, node: u32) {
        self.parents[node as usize] = ORPHAN;
        self.orphans.push_back(node);
    }

    /// Arcs from a node to its terminal, if it still hangs on it; the nodes on the way are stamped with what was found.
    fn depth(&mut self, node: u32) -> Option<u32> {
        let (mut at, mut steps) = (node, 0);
        let depth = loop {
            if self.stamps[at as usize] == self.turn {
                break steps + self.depths[at as usize];
            }
            match self.parents[at as usize] {
                ORPHAN => return None,
                TERMINAL => {
                    self.stamps[at as usize] = self.turn;
                    self.depths[at as usize] = 1;
                    break steps + 1;
                }
                arc => at = self.network.head(arc),
            }
            steps += 1;
        };
        let (mut at, mut left) = (node, depth);
        while self.stamps[at as usize] != self.turn {
            self.stamps[at as usize] = self.turn;
            self.depths[at as usize] = left;
            left -= 1;
            at = self.network.head(self.parents[at as usize]);
        }
        Some(depth)
    }

    /// Finds an orphan the nearest parent in its tree, or sets it free with those that hang on it.
    fn adopt(&mut self, orphan: u32) {
        let tree = self.trees[orphan as usize];
        let mut nearest: Option<(u32, u32)> = None;
        for arc in self.network.arcs(orphan) {
            let (other, back) = (self.network.head(arc), self.network.twin(arc));
            if self.trees[other as usize] != tree || self.network.left_outwards(back, tree) == 0 {
                continue;
            }
            if let Some(depth) = self.depth(other)
                && nearest.is_none_or(|(least, _)| depth < least)
            {
                nearest = Some((depth, arc));
            }
        }
        if let Some((_, arc)) = nearest {
            self.hang(orphan, arc, self.network.head(arc));
            return;
        }
        for arc in self.network.arcs(orphan) {
            let (other, back) = (self.network.head(arc), self.network.twin(arc));
            if self.trees[other as usize] != tree {
                continue;
            }
            if self.network.left_outwards(back, tree) > 0 {
                self.activate(other);
            }
            if self.parents[other as usize] == back {
                self.cut_off(other);
            }
        }
        self.trees[orphan as usize] = Tree::Free;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A number that looks random, 0 to `below`.
    fn pick(seed: &mut u64, below: i64) -> i64 {
        *seed = seed
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        ((*seed >> 33) % below as u64) as i64
    }

    /// What a cut costs.
    fn cost(terminals: &[i64], edges: &[Edge], source_side: &[bool]) -> i64 {
        let ends = terminals.iter().zip(source_side);
        let ends: i64 = ends
            .map(|(&t, &source)| if source { (-t).max(0) } else { t.max(0) })
            .sum();
        let between = |edge: &Edge| {
            let [a, b] = edge.ends.map(|end| source_side[end as usize]);
            i64::from(a && !b) * edge.capacities[0] + i64::from(b && !a) * edge.capacities[1]
        };
        ends + edges.iter().map(between).sum::<i64>()
    }

    /// The largest flow, by one path of a matrix of capacities after the other.
    fn largest_flow(terminals: &[i64], edges: &[Edge]) -> i64 {
        let (n, source, sink) = (terminals.len() + 2, terminals.len(), terminals.len() + 1);
        let mut left = vec![vec![0; n]; n];
        for (node, &terminal) in terminals.iter().enumerate() {
            left[source][node] = terminal.max(0);
            left[node][sink] = (-terminal).max(0);
        }
        for Edge { ends, capacities } in edges {
            let [a, b] = ends.map(|end| end as usize);
            left[a][b] += capacities[0];
            left[b][a] += capacities[1];
        }
        let mut flow = 0;
        loop {
            let mut from = vec![usize::MAX; n];
            let mut queue = VecDeque::from([source]);
            while let Some(node) = queue.pop_front() {
                for next in 0..n {
                    if from[next] == usize::MAX && next != source && left[node][next] > 0 {
                        from[next] = node;
                        queue.push_back(next);
                    }
                }
            }
            if from[sink] == usize::MAX {
                return flow;
            }
            let way: Vec<[usize; 2]> = std::iter::successors(Some(sink), |&node| {
                Some(from[node]).filter(|&before| before != source)
            })
            .map(|node| [from[node], node])
            .collect();
            let amount = way.iter().map(|&[a, b]| left[a][b]).min().unwrap_or(0);
            for [a, b] in way {
                left[a][b] -= amount;
                left[b][a] += amount;
            }
            flow += amount;
        }
    }

    #[test]
    fn the_cut_of_a_grid_costs_what_flows_through_it() {
        let (width, mut seed) = (12u32, 11);
        for _ in 0..8 {
            let n = width * width;
            let terminals: Vec<i64> = (0..n).map(|_| pick(&mut seed, 61) - 30).collect();
            let beside = |node: u32| {
                let right = (node % width + 1 < width).then_some(node + 1);
                let below = (node + width < n).then_some(node + width);
                [right, below].into_iter().flatten()
            };
            let pairs = (0..n).flat_map(|node| beside(node).map(move |other| [node, other]));
            let edges: Vec<Edge> = pairs
                .map(|ends| Edge {
                    ends,
                    capacities: [pick(&mut seed, 25), pick(&mut seed, 25)],
                })
                .collect();
            let cut = FlowNetwork::new(terminals.clone(), &edges).source_side();
            let flow = largest_flow(&terminals, &edges);
            assert_eq!(cost(&terminals, &edges, &cut), flow);
        }
    }

    #[test]
    fn no_cut_of_a_small_network_costs_less() {
        let mut seed = 7;
        for n in 1..=11usize {
            for _ in 0..12 {
                let terminals: Vec<i64> = (0..n).map(|_| pick(&mut seed, 41) - 20).collect();
                let mut edges = Vec::new();
                for a in 0..n as u32 {
                    for b in 0..a {
                        if pick(&mut seed, 3) == 0 {
                            let capacities = [pick(&mut seed, 15), pick(&mut seed, 15)];
                            edges.push(Edge {
                                ends: [a, b],
                                capacities,
                            });
                        }
                    }
                }
                let cut = FlowNetwork::new(terminals.clone(), &edges).source_side();
                let least = (0..1u32 << n)
                    .map(|set| {
                        let side: Vec<bool> = (0..n).map(|node| set >> node & 1 == 1).collect();
                        cost(&terminals, &edges, &side)
                    })
                    .min();
                assert_eq!(Some(cost(&terminals, &edges, &cut)), least);
            }
        }
    }
}
