//! Loops that are closed while the scan goes on, as soon as the camera has come back: beside a live camera, on threads that yield to
//! tracking, or between two frames of a recording, so that its replay is the same every time.

use super::FusionStage;
use crate::{
    capture::EventKind,
    fusion::{Fusion, LoopClosure, LoopsAside},
    geometry::motion_between,
    pipeline::{status::StopToken, threads},
};
use rayon::{ThreadPool, ThreadPoolBuildError};
use std::{
    num::NonZeroUsize,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
};

/// When loops are closed while the scan goes on.
pub enum LoopTiming {
    /// At the end of the scan alone.
    AtEnd,
    /// Between two frames, which wait meanwhile.
    BetweenFrames,
    /// Beside the scan, on threads of its own.
    Aside(Arc<ThreadPool>),
}

/// Frames that came while others were fused are fused in turn, so often at most: a machine that never catches up lets the camera
/// wait once.
const MAX_TURNS: usize = 5;

impl LoopTiming {
    /// Beside the scan, on so many threads of the system's idle class.
    pub fn aside(n_threads: NonZeroUsize) -> Result<Self, ThreadPoolBuildError> {
        let pool = threads::idle_pool("loops", n_threads)?;
        Ok(LoopTiming::Aside(Arc::new(pool)))
    }
}

/// What is being done about loops.
pub(super) struct LoopsUnderWay {
    timing: LoopTiming,
    work: Option<Work>,
}

/// What goes on beside the scan.
struct Work {
    thread: JoinHandle<Option<LoopsAside>>,
    is_over: Arc<AtomicBool>,
    n_turns: usize,
}

impl LoopsUnderWay {
    pub(super) fn new(timing: LoopTiming) -> Self {
        LoopsUnderWay { timing, work: None }
    }

    /// Whether something goes on beside the scan.
    #[cfg(test)]
    pub(super) fn is_under_way(&self) -> bool {
        self.work.is_some()
    }

    /// Ends what goes on beside the scan, without a result.
    pub(super) fn give_up(&mut self) {
        if let Some(work) = self.work.take() {
            work.is_over.store(true, Ordering::Relaxed);
            joined(work.thread);
        }
    }

    /// Whether there is something to be done about loops.
    fn are_due(&self, fusion: &Fusion) -> bool {
        match (&self.timing, &self.work) {
            (LoopTiming::AtEnd, _) => false,
            (_, None) => fusion.has_come_back(),
            (_, Some(work)) => work.thread.is_finished(),
        }
    }

    /// Does it; loops that can be closed now, if some were found. What holds up the frames of a recording ends when the scan is to
    /// stop.
    fn go_on(
        &mut self,
        fusion: &mut Fusion,
        pool: &ThreadPool,
        stop: &StopToken,
    ) -> Option<LoopsAside> {
        let LoopTiming::Aside(aside) = &self.timing else {
            let search = fusion.search_loops();
            return pool.install(|| search.run(&|_| !stop.is_stopped()));
        };
        let Some(work) = self.work.take() else {
            self.work = begin_search(aside, fusion);
            return None;
        };
        let n_turns = work.n_turns + 1;
        let mut loops = joined(work.thread)?;
        if fusion.has_jumped_since(&loops) {
            self.work = begin_search(aside, fusion);
            return None;
        }
        if fusion.hand_later(&mut loops) && n_turns < MAX_TURNS {
            self.work = begin(aside, n_turns, |goes_on| loops.catch_up(goes_on));
            return None;
        }
        Some(loops)
    }
}

/// Looks for loops beside the scan; `None` if the system gives no thread.
fn begin_search(pool: &Arc<ThreadPool>, fusion: &mut Fusion) -> Option<Work> {
    let search = fusion.search_loops();
    begin(pool, 0, |goes_on| search.run(&|_| goes_on()))
}

/// Does some work beside the scan; `None` if the system gives no thread.
fn begin(
    pool: &Arc<ThreadPool>,
    n_turns: usize,
    work: impl FnOnce(&(dyn Fn() -> bool + Sync)) -> Option<LoopsAside> + Send + 'static,
) -> Option<Work> {
    let is_over = Arc::new(AtomicBool::new(false));
    let (pool, told) = (pool.clone(), is_over.clone());
    let body = move || pool.install(|| work(&|| !told.load(Ordering::Relaxed)));
    let thread = thread::Builder::new().name("loops".to_owned()).spawn(body);
    let thread = thread
        .inspect_err(|error| tracing::warn!(%error, "loops are not looked for"))
        .ok()?;
    Some(Work {
        thread,
        is_over,
        n_turns,
    })
}

fn joined(thread: JoinHandle<Option<LoopsAside>>) -> Option<LoopsAside> {
    thread.join().unwrap_or_else(|_| {
        tracing::error!("looking for loops ended by a fault of the program");
        None
    })
}

impl FusionStage {
    /// Closes loops that were found; poses, shading images and what is shown move with the model.
    pub(super) fn close_loops_on_the_way(&mut self) {
        let (fusion, pool, loops) = (&mut self.fusion, &self.pool, &mut self.loops);
        if !loops.are_due(fusion) {
            return;
        }
        let stop = &self.stop;
        let closure = self.closing_clock.time(|| {
            let found = loops.go_on(fusion, pool, stop)?;
            pool.install(|| fusion.take_over(found))
        });
        let Some(closure) = closure else { return };
        tell_of(&closure);
        self.moved_on_the_way(&closure);
    }

    fn moved_on_the_way(&mut self, closure: &LoopClosure) {
        let newest = self.trajectory.last().map(|(_, pose)| *pose);
        self.move_path(&closure.correction);
        if let Some(selector) = &mut self.selector {
            selector.correct(&closure.correction);
        }
        self.showing.move_with_model();
        if let (Some(before), Some((_, after))) = (newest, self.trajectory.last()) {
            let moved_m = motion_between(&before, after).translation_m;
            self.tell_at(None, EventKind::LoopsClosed { moved_m });
        }
    }
}

/// Tells of loops that were closed.
pub(super) fn tell_of(closure: &LoopClosure) {
    tracing::info!(
        n_fragments = closure.n_fragments,
        n_loops = closure.n_loops,
        misfit_before_m = closure.misfit_before_m,
        misfit_after_m = closure.misfit_after_m,
        "loops closed"
    );
}
