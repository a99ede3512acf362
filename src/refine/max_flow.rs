//! The largest flow through a network and the smallest cut, by blocking flows on layered networks (Dinic 1970).
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

/// Level of a node that the source does not reach.
const UNREACHED: u32 = u32::MAX;

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
    pub fn source_side(mut self) -> Vec<bool> {
        loop {
            let levels = self.levels();
            if !self.block(&levels) {
                return levels.iter().map(|&level| level != UNREACHED).collect();
            }
        }
    }

    fn arcs(&self, node: u32) -> std::ops::Range<u32> {
        self.starts[node as usize]..self.starts[node as usize + 1]
    }

    /// Arcs from the source to each node, over what is left.
    fn levels(&self) -> Vec<u32> {
        let mut levels = vec![UNREACHED; self.terminals.len()];
        let mut queue = VecDeque::new();
        for (node, &terminal) in self.terminals.iter().enumerate() {
            if terminal > 0 {
                levels[node] = 0;
                queue.push_back(node as u32);
            }
        }
        while let Some(node) = queue.pop_front() {
            for arc in self.arcs(node) {
                let head = self.heads[arc as usize] as usize;
                if self.left[arc as usize] > 0 && levels[head] == UNREACHED {
                    levels[head] = levels[node as usize] + 1;
                    queue.push_back(head as u32);
                }
            }
        }
        levels
    }

    /// Pushes flow from level to level until no path to the sink is left; whether there was any.
    fn block(&mut self, levels: &[u32]) -> bool {
        let mut next = self.starts.clone();
        let mut path = Vec::new();
        let mut any = false;
        for source in 0..self.terminals.len() as u32 {
            let mut node = source;
            while self.terminals[source as usize] > 0 {
                if self.terminals[node as usize] < 0 {
                    node = self.push(source, node, &mut path);
                    any = true;
                } else if let Some(arc) = self.forward(node, &mut next, levels) {
                    path.push(arc);
                    node = self.heads[arc as usize];
                } else if let Some(arc) = path.pop() {
                    node = self.heads[self.twins[arc as usize] as usize];
                    next[node as usize] += 1;
                } else {
                    break;
                }
            }
            path.clear();
        }
        any
    }

    /// The next arc of a node that leads a level on.
    fn forward(&self, node: u32, next: &mut [u32], levels: &[u32]) -> Option<u32> {
        let end = self.arcs(node).end;
        let at = &mut next[node as usize];
        while *at < end {
            let arc = *at as usize;
            let head = self.heads[arc] as usize;
            let leads_on = levels[head] != UNREACHED && levels[head] == levels[node as usize] + 1;
            if self.left[arc] > 0 && leads_on {
                return Some(*at);
            }
            *at += 1;
        }
        None
    }

    /// Pushes as much as a path from a source to a node at the sink takes, and cuts the path at its first full arc; returns
    /// where it then ends.
    fn push(&mut self, source: u32, sink: u32, path: &mut Vec<u32>) -> u32 {
        let ends = self.terminals[source as usize].min(-self.terminals[sink as usize]);
        let arcs = path.iter().map(|&arc| self.left[arc as usize]);
        let amount = arcs.fold(ends, i64::min);
        self.terminals[source as usize] -= amount;
        self.terminals[sink as usize] += amount;
        let mut first_full = None;
        for (place, &arc) in path.iter().enumerate() {
            self.left[arc as usize] -= amount;
            self.left[self.twins[arc as usize] as usize] += amount;
            if self.left[arc as usize] == 0 {
                first_full.get_or_insert(place);
            }
        }
        let Some(place) = first_full else {
            return sink;
        };
        let tail = self.heads[self.twins[path[place] as usize] as usize];
        path.truncate(place);
        tail
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
