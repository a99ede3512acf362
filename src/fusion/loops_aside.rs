//! Loops that are closed while the scan goes on: what it holds so far is looked through and fused anew beside it, and takes the
//! model's place as soon as it has caught up with the frames that came meanwhile.

use super::eye::Eye;
use super::improvement::GoesOn;
use super::keyframes::Keyframe;
use super::loop_closing::{self, FoundLoops};
use super::{Fusion, FusionParams, LoopClosure};

/// So many frames may be fused in between without a frame of the camera being late.
const FEW_FRAMES: usize = 4;

/// The frames of a scan so far, in which loops are to be looked for on any thread; their depth is shared with the scan.
pub struct LoopSearch {
    frames: Vec<Keyframe>,
    eye: Eye,
    params: FusionParams,
    n_relocalised: usize,
}

/// Loops that were found, and the model that they lead to.
pub struct LoopsAside {
    found: FoundLoops,
    eye: Eye,
    /// How often the camera had been found in another place when they were looked for.
    n_relocalised: usize,
    /// Frames that came since, to be fused next.
    later: Vec<Keyframe>,
}

impl LoopSearch {
    /// Looks for loops; `None` if there are none, or as soon as `goes_on` says no. Takes as long as the scan took with one processor, or less.
    pub fn run(self, goes_on: &GoesOn) -> Option<LoopsAside> {
        let LoopSearch {
            frames,
            eye,
            params,
            n_relocalised,
        } = self;
        Some(LoopsAside {
            found: loop_closing::find(&frames, &eye, &params, goes_on)?,
            eye,
            n_relocalised,
            later: Vec::new(),
        })
    }
}

impl LoopsAside {
    /// Fuses the frames that came since; `None` as soon as `goes_on` says no.
    pub fn catch_up(mut self, goes_on: &dyn Fn() -> bool) -> Option<Self> {
        let later = std::mem::take(&mut self.later);
        self.found
            .catch_up(&later, &self.eye, goes_on)
            .then_some(self)
    }
}

impl Fusion {
    /// Whether the camera has come back to where it was before, so that looking for loops is worth while.
    pub fn has_come_back(&self) -> bool {
        self.revisits.are_due()
    }

    /// What is needed to look for loops in the scan so far.
    pub fn search_loops(&mut self) -> LoopSearch {
        self.revisits.see_to();
        LoopSearch {
            frames: self.keyframes.frames().to_vec(),
            eye: self.eye.clone(),
            params: self.params.clone(),
            n_relocalised: self.n_relocalised,
        }
    }

    /// Whether the camera was lost and found in another place since loops were looked for. What has drifted there is not what the
    /// last frames before have, with which later ones are moved: loops are to be looked for anew.
    pub fn has_jumped_since(&self, loops: &LoopsAside) -> bool {
        self.n_relocalised != loops.n_relocalised
    }

    /// Gives loops the frames that have come since they were looked for; whether they are too many to be fused in between.
    pub fn hand_later(&self, loops: &mut LoopsAside) -> bool {
        loops.later = self.keyframes.after(loops.found.until_secs()).to_vec();
        loops.later.len() > FEW_FRAMES
    }

    /// Puts the model that loops lead to in the place of this one, and fuses the frames that are not in it yet. The poses handed
    /// out so far are then to be moved by [`LoopClosure::correction`]; tracking goes on. `None`, and nothing is changed, if the
    /// frames would not fit one another as well.
    pub fn take_over(&mut self, loops: LoopsAside) -> Option<LoopClosure> {
        let LoopsAside { mut found, eye, .. } = loops;
        let later = self.keyframes.after(found.until_secs());
        found.catch_up(later, &eye, &|| true);
        let closed = found.judged(&self.fused.volume)?;
        self.replace_volume(closed.fused);
        let correction = &closed.closure.correction;
        self.keyframes.correct(correction);
        self.places.correct(correction);
        self.revisits.correct(correction);
        self.hypothesis = None;
        self.common = None;
        if let Some(infrared) = &mut self.infrared {
            infrared.correct(correction);
        }
        let pose = correction.apply(self.track.time_secs, &self.track.world_from_camera);
        self.track.world_from_camera = pose;
        if let Some(seen) = &mut self.seen {
            seen.moved(&pose);
        }
        Some(closed.closure)
    }
}
