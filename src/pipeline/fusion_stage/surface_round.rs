//! The live mesh is brought up to the model in rounds, a part of one between two frames: a whole round may take longer than
//! there is between two frames, and frames would be dropped.

use crate::{
    fusion::{Fusion, LiveMesh, SurfacePatch},
    pipeline::live::surface::SurfaceUpdate,
    snapshot::Coverage,
};
use rayon::ThreadPool;
use std::time::{Duration, Instant};

/// Rounds are this far apart at least.
const BETWEEN_ROUNDS: Duration = Duration::from_millis(500);
/// Rounds may take one part in so many of the fusion thread's time: 50 ms for a relief at 2 mm are spent every 750 ms.
const ROUNDS_SHARE: u32 = 15;
/// A part shall take about so long, an eighth of the time between two frames.
const PART: Duration = Duration::from_millis(4);
/// Patches of the first part, about as many as one core extracts in that time.
const FIRST_PART: usize = 1500;
/// Fewer are not worth the threads: as many as one task extracts.
const SMALLEST_PART: usize = 256;

/// The mesh, and what of a round is done.
pub(super) struct SurfaceRound {
    mesh: LiveMesh,
    /// Patches of the next part at most.
    max_patches: usize,
    /// What the round has taken so far, and what has changed by it.
    spent: Duration,
    changed: Vec<(u32, SurfacePatch)>,
    /// How far apart rounds are at present.
    between: Duration,
    /// Whether the model is another one since the surface was handed over last.
    is_anew: bool,
}

impl Default for SurfaceRound {
    fn default() -> Self {
        SurfaceRound {
            mesh: LiveMesh::default(),
            max_patches: FIRST_PART,
            spent: Duration::ZERO,
            changed: Vec::new(),
            between: BETWEEN_ROUNDS,
            is_anew: false,
        }
    }
}

impl SurfaceRound {
    /// Forgets what is done of a round: the model is another one.
    pub(super) fn begin_anew(&mut self) {
        self.changed.clear();
        self.is_anew = true;
    }

    /// Whether a round has begun and not ended.
    pub(super) fn is_under_way(&self) -> bool {
        self.mesh.is_under_way()
    }

    /// How old a surface is at least when it is time for another round.
    pub(super) fn between(&self) -> Duration {
        self.between
    }

    /// Does the next part of a round.
    pub(super) fn go_on(&mut self, fusion: &Fusion, pool: &ThreadPool) {
        let start = Instant::now();
        let (mesh, max_patches) = (&mut self.mesh, self.max_patches);
        let part = pool.install(|| fusion.refresh_part(mesh, max_patches));
        let patches = self.mesh.patches();
        let changed = part.iter().map(|&number| {
            let patch = patches[number as usize].clone();
            (number, patch)
        });
        self.changed.extend(changed);
        let elapsed = start.elapsed();
        if part.len() == max_patches {
            self.max_patches = next_part(max_patches, elapsed);
        }
        self.spent += elapsed;
    }

    /// What a round that has ended has changed.
    pub(super) fn end(&mut self, coverage: Coverage) -> SurfaceUpdate {
        self.between = BETWEEN_ROUNDS.max(std::mem::take(&mut self.spent) * ROUNDS_SHARE);
        SurfaceUpdate {
            is_anew: std::mem::take(&mut self.is_anew),
            n_patches: self.mesh.patches().len(),
            changed: std::mem::take(&mut self.changed),
            coverage,
        }
    }
}

/// How many patches to extract next where so many took so long. One part that had to wait for other programs does not make
/// the parts after it small.
fn next_part(n_patches: usize, elapsed: Duration) -> usize {
    let wanted = n_patches as f64 * PART.as_secs_f64() / elapsed.as_secs_f64().max(1e-6);
    (wanted as usize)
        .clamp(n_patches / 2, n_patches * 2)
        .max(SMALLEST_PART)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_follow_the_time_that_they_take_within_bounds() {
        assert_eq!(next_part(1000, PART), 1000);
        assert_eq!(next_part(1000, PART * 5 / 4), 800);
        assert_eq!(next_part(1000, PART * 20), 500, "half at most");
        assert_eq!(next_part(1000, Duration::ZERO), 2000, "twice at most");
        assert_eq!(next_part(300, PART * 20), SMALLEST_PART);
    }
}
