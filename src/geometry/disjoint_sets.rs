//! Sets that are joined two at a time: union–find (Galler, Fisher 1964).

/// The numbers from 0 on, in sets of which none have a number in common.
pub(super) struct DisjointSets {
    /// A number of the same set that is not larger; itself at the root.
    parent: Vec<u32>,
}

impl DisjointSets {
    /// Each of `n` numbers alone.
    pub fn new(n: usize) -> Self {
        DisjointSets {
            parent: (0..n as u32).collect(),
        }
    }

    /// The least number of the set that a number belongs to.
    pub fn root(&mut self, mut number: u32) -> u32 {
        let parent = &mut self.parent;
        while parent[number as usize] != number {
            parent[number as usize] = parent[parent[number as usize] as usize];
            number = parent[number as usize];
        }
        number
    }

    /// Makes one set of those of two numbers.
    pub fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.parent[a.max(b) as usize] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joined_sets_have_their_least_number_for_a_root() {
        let mut sets = DisjointSets::new(7);
        for (a, b) in [(5, 3), (6, 2), (3, 6), (0, 1), (6, 5)] {
            sets.join(a, b);
        }
        let roots: Vec<u32> = (0..7).map(|number| sets.root(number)).collect();
        assert_eq!(roots, [0, 0, 2, 2, 4, 2, 2]);
    }
}
