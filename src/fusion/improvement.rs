//! What is done to a scan at its end, or while frames are taken back, and who is told how far it is.

use std::sync::atomic::{AtomicUsize, Ordering};

/// How far one kind of work is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Improvement {
    /// Which.
    pub work: Work,
    /// Frames, or whatever the work counts, that are done.
    pub n_done: usize,
    /// Of so many.
    pub n_in_all: usize,
}

/// Kinds of work, those at the end of a scan in the order in which they happen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Work {
    /// Frames are fused again with their depth corrected; for the n-th time, from 1 on.
    CorrectDepth(usize),
    /// Frames are fused into fragments.
    FuseFragments,
    /// The fragments that fragments overlap with are found.
    FindLoops,
    /// Pairs of fragments are aligned.
    AlignFragments,
    /// Frames are fused again with loops closed.
    CloseLoops,
    /// Frames are fused again, every one into all that it sees.
    FuseWhole,
    /// Frames are fused again with a narrow band.
    SeparateThinParts,
    /// Frames before those that are taken back are fused again, in the midst of a scan.
    TakeBack,
}

impl Work {
    /// The work's stable name.
    pub fn code(self) -> &'static str {
        match self {
            Work::CorrectDepth(_) => "correct_depth",
            Work::FuseFragments => "fuse_fragments",
            Work::FindLoops => "find_loops",
            Work::AlignFragments => "align_fragments",
            Work::CloseLoops => "close_loops",
            Work::FuseWhole => "fuse_whole",
            Work::SeparateThinParts => "separate_thin_parts",
            Work::TakeBack => "take_back",
        }
    }

    /// So many of so many are done.
    pub fn at(self, n_done: usize, n_in_all: usize) -> Improvement {
        Improvement {
            work: self,
            n_done,
            n_in_all,
        }
    }
}

/// Is told by long work, once a frame or a pair of fragments, how far it is, and says whether it shall go on.
pub type GoesOn<'a> = dyn Fn(Improvement) -> bool + Sync + 'a;

/// Counts the steps of one work, which several threads may do.
pub(super) struct Counted<'a> {
    work: Work,
    n_done: AtomicUsize,
    n_in_all: usize,
    goes_on: &'a GoesOn<'a>,
}

impl<'a> Counted<'a> {
    pub(super) fn new(work: Work, n_in_all: usize, goes_on: &'a GoesOn<'a>) -> Self {
        Counted {
            work,
            n_done: AtomicUsize::new(0),
            n_in_all,
            goes_on,
        }
    }

    /// Before each step: tells how far the work is, and whether it shall go on.
    pub(super) fn goes_on(&self) -> bool {
        let n_done = self.n_done.fetch_add(1, Ordering::Relaxed);
        (self.goes_on)(self.work.at(n_done, self.n_in_all))
    }
}
