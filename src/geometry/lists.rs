//! Lists of numbers in one piece of memory, such as the neighbours of every vertex.

/// So many lists, each of as many numbers as it was given.
#[derive(Clone, Debug)]
pub struct Lists {
    /// Where each begins; one more than lists.
    starts: Vec<u32>,
    items: Vec<u32>,
}

impl Lists {
    /// `n` lists of given items, each with the number of its list before it; those of a list keep their order.
    ///
    /// # Panics
    /// If an item names a list that does not exist.
    pub fn new(n: usize, items: impl Iterator<Item = [u32; 2]> + Clone) -> Lists {
        let mut starts = vec![0; n + 1];
        for [list, _] in items.clone() {
            starts[list as usize + 1] += 1;
        }
        for list in 0..n {
            starts[list + 1] += starts[list];
        }
        let mut next = starts.clone();
        let mut ordered = vec![0; starts[n] as usize];
        for [list, item] in items {
            let next = &mut next[list as usize];
            ordered[*next as usize] = item;
            *next += 1;
        }
        let items = ordered;
        Lists { starts, items }
    }

    /// The same lists, each in ascending order.
    pub fn sorted(mut self) -> Lists {
        for list in self.starts.windows(2) {
            self.items[list[0] as usize..list[1] as usize].sort_unstable();
        }
        self
    }

    /// How many items the lists before one have.
    #[inline]
    pub fn start(&self, list: usize) -> usize {
        self.starts[list] as usize
    }

    /// The items of a list.
    #[inline]
    pub fn of(&self, list: usize) -> &[u32] {
        &self.items[self.starts[list] as usize..self.starts[list + 1] as usize]
    }

    /// How many lists there are.
    pub fn len(&self) -> usize {
        self.starts.len() - 1
    }
}
