//! Closing loops: where a scan has come back to what it saw before, the drift in between is taken back.
//!
//! The scan is cut into [`fragments`](super::fragments), every pair of fragments that see the same surface is aligned, a pose
//! graph finds the poses that agree best with all alignments, and every frame is fused again where it then belongs. A pair is
//! believed only if neither looks through the other's surface: inliers and residual cannot tell a false pair. In the end the
//! fragments must lie as close to the surface that all frames make together as they did, or everything stays as it was.
//!
//! Not handled: places that were seen twice but drifted apart beyond the alignment's [reach](MAX_DRIFT_M).

use super::FusionParams;
use super::eye::Eye;
use super::fragment_alignment::{Alignment, MAX_DRIFT_M, align, mutual_overlap};
use super::fragments::{Fragment, cut};
use super::fused_volume::FusedVolume;
use super::icp;
use super::improvement::{Counted, GoesOn, Work};
use super::keyframes::Keyframe;
use super::misfit::mean;
use super::pose_correction::PoseCorrection;
use super::pose_graph::{Edge, optimise};
use super::volume::TsdfVolume;
use crate::geometry::Pose;
use nalgebra::{Matrix6, Point3, Vector6};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// How loops are closed.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct LoopClosingParams {
    /// Memory for the packed depth of the frames, megabytes; 0 switches loop closing off.
    pub max_memory_mb: usize,
    /// Whether loops are closed while the scan goes on, too, each time the camera has been elsewhere and comes back.
    pub while_scanning: bool,
    /// A fragment ends where the camera has turned so far, radians.
    pub fragment_rotation_rad: f64,
    /// A fragment ends where the camera has moved so far, metres.
    pub fragment_translation_m: f64,
    /// A fragment ends after so many frames.
    pub fragment_frames: usize,
    /// Two fragments are aligned if they share this share of their points.
    pub min_shared_share: f64,
    /// Two fragments that look through one another at more than this share of their points are not of one place.
    pub max_looked_through_share: f64,
}

impl Default for LoopClosingParams {
    fn default() -> Self {
        LoopClosingParams {
            max_memory_mb: 512,
            while_scanning: true,
            fragment_rotation_rad: 0.2,
            fragment_translation_m: 0.1,
            fragment_frames: 30,
            min_shared_share: 0.5,
            max_looked_through_share: 0.15,
        }
    }
}

impl LoopClosingParams {
    /// Checks every value against its bound by `within(key, value, low, high)`.
    pub(super) fn validate(
        &self,
        within: impl Fn(&str, f64, f64, f64) -> Result<(), String>,
    ) -> Result<(), String> {
        let within = |key: &str, value: f64, low: f64, high: f64| {
            within(&format!("loop_closing.{key}"), value, low, high)
        };
        within("max_memory_mb", self.max_memory_mb as f64, 0.0, 1e6)?;
        within(
            "fragment_rotation_rad",
            self.fragment_rotation_rad,
            0.01,
            1.0,
        )?;
        within(
            "fragment_translation_m",
            self.fragment_translation_m,
            0.005,
            1.0,
        )?;
        within("fragment_frames", self.fragment_frames as f64, 1.0, 1000.0)?;
        within("min_shared_share", self.min_shared_share, 0.05, 1.0)?;
        let looked_through = self.max_looked_through_share;
        within("max_looked_through_share", looked_through, 0.0, 1.0)
    }
}

/// What closing the loops came to.
#[derive(Clone, Debug)]
pub struct LoopClosure {
    /// How far every pose is moved, by time.
    pub correction: PoseCorrection,
    /// Fragments of the scan.
    pub n_fragments: usize,
    /// Pairs of fragments that see one surface, other than neighbours in time.
    pub n_loops: usize,
    /// Mean distance of the fragments to the fused surface as tracked, metres.
    pub misfit_before_m: f64,
    /// The same with all poses moved.
    pub misfit_after_m: f64,
}

/// Loops that were found, with all frames fused where they then belong; not judged yet.
pub(super) struct FoundLoops {
    correction: PoseCorrection,
    /// With the pose of each one's anchor as tracked, and as corrected.
    fragments: Vec<(Fragment, Pose, Pose)>,
    n_loops: usize,
    misfit_after_m: f64,
    fused: FusedVolume,
    /// When the last frame in it was taken, seconds of the device's clock.
    until_secs: f64,
}

/// Loops that were closed.
pub(super) struct ClosedLoops {
    pub(super) closure: LoopClosure,
    pub(super) fused: FusedVolume,
}

/// Rounds of alignment: the second finds its pairs where the first has put them.
const ROUNDS: usize = 2;
/// A fragment is aligned to so many earlier ones at most, evenly chosen, so that the time grows with the length of the scan
/// and not with its square.
const MAX_PAIRS: usize = 12;
/// What a pair's alignment may be off, root mean square over the shared surface: what the sensor's systematic errors leave.
const PAIR_SIGMA_M: f64 = 0.001;
/// What tracking may drift from one fragment to the next. The sensor's fixed pattern moves with the camera and makes tracking
/// believe in less motion: with a tenth of these, the recorded full turn keeps 1 mm more of its error.
const DRIFT_SIGMA_M: f64 = 0.02;
const DRIFT_SIGMA_RAD: f64 = 0.03;
/// What is left of that information where tracking was lost and found in between: ten times the drift.
const BROKEN_TRUST: f64 = 0.01;
/// Loops that leave the fragments farther from the common surface, by this factor, are not closed. A little farther they may
/// lie, for thin parts and what is fused for the second time change the surface too.
const MAX_MISFIT_GROWTH: f64 = 1.02;
/// One point in so many tells how far a fragment lies from a surface: all of them would hold up the frames of a live camera.
const MISFIT_STEP: usize = 4;
/// A pair that the others contradict by more than this is doubted.
const KERNEL_SIGMAS: f64 = 5.0;

/// Looks for the loops of a scan, and fuses its frames anew; `None` if it never came back to what it had seen, or if it shall not
/// go on.
pub(super) fn find(
    frames: &[Keyframe],
    eye: &Eye,
    params: &FusionParams,
    goes_on: &GoesOn,
) -> Option<FoundLoops> {
    let stretches = cut(frames, &params.loop_closing);
    let step = Counted::new(Work::FuseFragments, stretches.len(), goes_on);
    let fragments: Vec<Fragment> = stretches
        .into_par_iter()
        .map(|stretch| {
            step.goes_on()
                .then(|| Fragment::fuse(frames, stretch, eye.clone(), params))
        })
        .collect::<Option<_>>()?;
    let tracked: Vec<Pose> = fragments
        .iter()
        .map(|fragment| frames[fragment.anchor].world_from_camera)
        .collect();
    let (nodes, n_loops) = settle(frames, &fragments, &tracked, eye, params, goes_on);
    if n_loops == 0 {
        return None;
    }
    let correction = PoseCorrection::of_fragments(frames, &fragments, &nodes);
    let mut fused = FusedVolume::untouched(params.empty_volume());
    let step = Counted::new(Work::CloseLoops, frames.len(), goes_on);
    if !fused.fuse_again(frames, &correction, eye, &|| step.goes_on()) {
        return None;
    }
    let corrected =
        |k: usize, pose: &Pose| correction.apply(frames[fragments[k].anchor].time_secs, pose);
    let corrected: Vec<Pose> = (0..tracked.len())
        .map(|k| corrected(k, &tracked[k]))
        .collect();
    let misfit_after_m = misfit_m(fragments.iter().zip(&corrected), &fused.volume);
    let poses = tracked.into_iter().zip(corrected);
    let fragments = fragments.into_iter().zip(poses);
    Some(FoundLoops {
        fragments: fragments.map(|(f, (a, b))| (f, a, b)).collect(),
        correction,
        n_loops,
        misfit_after_m,
        fused,
        until_secs: frames.last()?.time_secs,
    })
}

impl FoundLoops {
    /// The loops, if the frames fit one another as well as in the volume `live`, into which they were fused as tracked.
    pub(super) fn judged(self, live: &TsdfVolume) -> Option<ClosedLoops> {
        let as_tracked = self.fragments.iter().map(|(f, tracked, _)| (f, tracked));
        let closure = LoopClosure {
            n_fragments: self.fragments.len(),
            n_loops: self.n_loops,
            misfit_before_m: misfit_m(as_tracked, live),
            misfit_after_m: self.misfit_after_m,
            correction: self.correction,
        };
        let fits = closure.misfit_after_m < MAX_MISFIT_GROWTH * closure.misfit_before_m;
        fits.then_some(ClosedLoops {
            closure,
            fused: self.fused,
        })
    }

    /// When the last frame that is in it was taken, seconds of the device's clock.
    pub(super) fn until_secs(&self) -> f64 {
        self.until_secs
    }

    /// Fuses frames that came since, moved as the last ones before them; false if it shall not go on.
    pub(super) fn catch_up(
        &mut self,
        later: &[Keyframe],
        eye: &Eye,
        goes_on: &dyn Fn() -> bool,
    ) -> bool {
        self.until_secs = later
            .last()
            .map_or(self.until_secs, |frame| frame.time_secs);
        self.fused.fuse_again(later, &self.correction, eye, goes_on)
    }
}

/// The poses (world from anchor) on which all pairs of fragments agree best, and how many of the pairs close a loop.
fn settle(
    frames: &[Keyframe],
    fragments: &[Fragment],
    tracked: &[Pose],
    eye: &Eye,
    params: &FusionParams,
    goes_on: &GoesOn,
) -> (Vec<Pose>, usize) {
    let drift = drift_edges(frames, fragments, tracked);
    let mut nodes = tracked.to_vec();
    let mut pairs = Vec::new();
    let mut reach_m = MAX_DRIFT_M;
    for _ in 0..ROUNDS {
        pairs = aligned_pairs(fragments, &nodes, eye, params, reach_m, goes_on);
        // The first round has taken back what lay between them.
        reach_m = 0.0;
        let mut edges = drift.clone();
        edges.extend(pairs.iter().map(Pair::edge));
        optimise(&mut nodes, &edges);
    }
    let n_loops = pairs.iter().filter(|pair| pair.is_loop()).count();
    (nodes, n_loops)
}

/// Mean distance of the fragments' points to the surface of a volume, where it knows one, metres.
fn misfit_m<'a>(
    world_from_anchors: impl Iterator<Item = (&'a Fragment, &'a Pose)>,
    volume: &TsdfVolume,
) -> f64 {
    let fragments: Vec<_> = world_from_anchors.collect();
    let sums: Vec<(f64, usize)> = fragments
        .into_par_iter()
        .map(|(fragment, world_from_anchor)| {
            let (mut sum, mut n_points) = (0.0, 0);
            for point in fragment.surface_points().step_by(MISFIT_STEP) {
                let point_world = world_from_anchor * Point3::from(point.cast::<f64>());
                let sample = volume.sample_with_gradient(&point_world.coords.cast());
                if let Some((distance, _)) = sample {
                    sum += f64::from(distance.abs());
                    n_points += 1;
                }
            }
            (sum, n_points)
        })
        .collect();
    mean(&sums).unwrap_or_default()
}

/// Two fragments and how they stand to one another.
struct Pair {
    source: usize,
    target: usize,
    alignment: Alignment,
}

impl Pair {
    /// Neighbours in time are no revisit.
    fn is_loop(&self) -> bool {
        self.source - self.target > 1
    }

    fn edge(&self) -> Edge {
        let weight = self.alignment.overlap.shared_share() / (PAIR_SIGMA_M * PAIR_SIGMA_M);
        Edge {
            from: self.source,
            to: self.target,
            to_from_from: self.alignment.target_from_source,
            information: self.alignment.curvature * weight,
            kernel_sigmas: KERNEL_SIGMAS,
        }
    }
}

/// What tracking says of neighbours; between them it may have been lost and found.
fn drift_edges(frames: &[Keyframe], fragments: &[Fragment], tracked: &[Pose]) -> Vec<Edge> {
    let (turn, shift) = (DRIFT_SIGMA_RAD.powi(-2), DRIFT_SIGMA_M.powi(-2));
    let information = Matrix6::from_diagonal(&Vector6::new(turn, turn, turn, shift, shift, shift));
    let stretch = |fragment: &Fragment| frames[fragment.anchor].stretch;
    (1..fragments.len())
        .map(|k| {
            let is_unbroken = stretch(&fragments[k]) == stretch(&fragments[k - 1]);
            Edge {
                from: k,
                to: k - 1,
                to_from_from: tracked[k - 1].inverse() * tracked[k],
                information: information * if is_unbroken { 1.0 } else { BROKEN_TRUST },
                kernel_sigmas: f64::INFINITY,
            }
        })
        .collect()
}

/// Aligns the pairs that see the same surface, as far apart as `reach_m`, and keeps those that can be true; fewer if it shall not go on.
fn aligned_pairs(
    fragments: &[Fragment],
    nodes: &[Pose],
    eye: &Eye,
    params: &FusionParams,
    reach_m: f32,
    goes_on: &GoesOn,
) -> Vec<Pair> {
    let margin_m = icp::BEHIND_VOXELS * params.voxel_size_m as f32;
    let reach_m = reach_m.max(margin_m);
    let closing = &params.loop_closing;
    let guess = |source: usize, target: usize| nodes[target].inverse() * nodes[source];
    let n_fragments = fragments.len();
    let step = Counted::new(Work::FindLoops, n_fragments, goes_on);
    let candidates: Vec<(usize, usize)> = (0..n_fragments)
        .into_par_iter()
        .flat_map_iter(|source| {
            let overlaps = |target: &usize| {
                let (a, b) = (&fragments[source], &fragments[*target]);
                mutual_overlap(a, b, &guess(source, *target), eye, reach_m).shared_share()
                    >= closing.min_shared_share
            };
            let others = if step.goes_on() { source } else { 0 };
            let targets: Vec<usize> = (0..others).filter(overlaps).collect();
            let chosen = evenly(&targets, MAX_PAIRS);
            chosen.into_iter().map(move |target| (source, target))
        })
        .collect();
    let step = Counted::new(Work::AlignFragments, candidates.len(), goes_on);
    candidates
        .into_par_iter()
        .filter_map(|(source, target)| {
            if !step.goes_on() {
                return None;
            }
            let (a, b) = (&fragments[source], &fragments[target]);
            let alignment = align(a, b, &guess(source, target), eye, margin_m)?;
            let overlap = &alignment.overlap;
            let is_true = overlap.shared_share() >= closing.min_shared_share
                && overlap.looked_through_share() <= closing.max_looked_through_share;
            is_true.then_some(Pair {
                source,
                target,
                alignment,
            })
        })
        .collect()
}

/// At most `n` of the targets, evenly spread; the last, which is the nearest in time, is always among them.
fn evenly(targets: &[usize], n: usize) -> Vec<usize> {
    let n_chosen = targets.len().min(n);
    (1..=n_chosen)
        .map(|k| targets[k * targets.len() / n_chosen - 1])
        .collect()
}

#[cfg(test)]
mod tests;
