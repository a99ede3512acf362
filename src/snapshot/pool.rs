//! A bounded pool of candidates, and the choice among them by information.
//!
//! A set of views is worth `Σ log det(I + A)` over the patches and the sides that light comes from, with A the information
//! summed over the views: the first view from a new side is worth much, the tenth alike little. That worth is submodular,
//! so taking the best next view again and again is within a factor 1 − 1/e of the best set. While the scan goes on, the
//! candidate whose removal loses least makes room. What the operator asked for is *pinned*: it is kept and chosen first.

use super::coverage::Coverage;
use super::information::{Information, PatchKey, ViewInformation};
use super::rejection::{RejectReason, Rejection};
use super::{ShadingSnapshot, SnapshotSelection};
use crate::fusion::PoseCorrection;
use std::collections::{BTreeMap, BTreeSet};

/// Determinants multiplied before a logarithm is taken; they stay below 1e12 each, their product far from overflow.
const PER_LOGARITHM: usize = 16;

/// Candidates for shading images with what each tells.
pub(super) struct Pool {
    capacity: usize,
    /// Patches, with their sides, are numbered in order of appearance.
    patch_of: BTreeMap<PatchKey, usize>,
    /// Information of all candidates, by patch.
    total: Vec<Information>,
    /// What all candidates are worth.
    worth: f64,
    /// In order of arrival.
    candidates: Vec<Candidate>,
}

struct Candidate {
    snapshot: ShadingSnapshot,
    /// Whether the operator asked for it.
    is_pinned: bool,
    /// By patch number.
    information: Vec<(usize, Information)>,
}

impl Pool {
    /// An empty pool for this many candidates, at least one.
    pub(super) fn new(capacity: usize) -> Self {
        Pool {
            capacity: capacity.max(1),
            patch_of: BTreeMap::new(),
            total: Vec::new(),
            worth: 0.0,
            candidates: Vec::new(),
        }
    }

    pub(super) fn len(&self) -> usize {
        self.candidates.len()
    }

    /// The candidates, in order of arrival.
    pub(super) fn snapshots(&self) -> impl Iterator<Item = &ShadingSnapshot> {
        self.candidates.iter().map(|candidate| &candidate.snapshot)
    }

    /// Takes a candidate in; when there is no room, the one whose removal loses least (of equals the latest) is put out.
    pub(super) fn offer(
        &mut self,
        snapshot: ShadingSnapshot,
        view: &ViewInformation,
    ) -> Option<Rejection> {
        self.take(snapshot, view, false)
    }

    /// Takes a candidate in that stays, however little it adds.
    pub(super) fn pin(
        &mut self,
        snapshot: ShadingSnapshot,
        view: &ViewInformation,
    ) -> Option<Rejection> {
        self.take(snapshot, view, true)
    }

    fn take(
        &mut self,
        snapshot: ShadingSnapshot,
        view: &ViewInformation,
        is_pinned: bool,
    ) -> Option<Rejection> {
        let information: Vec<_> = view
            .patches
            .iter()
            .map(|(key, information)| (self.patch_number(*key), *information))
            .collect();
        let candidate = Candidate {
            snapshot,
            is_pinned,
            information,
        };
        self.worth += gain(&candidate, &self.total);
        for (patch, information) in &candidate.information {
            self.total[*patch] = self.total[*patch].plus(information);
        }
        self.candidates.push(candidate);
        (self.candidates.len() > self.capacity).then(|| self.evict())
    }

    fn patch_number(&mut self, key: PatchKey) -> usize {
        let next = self.total.len();
        let number = *self.patch_of.entry(key).or_insert(next);
        if number == next {
            self.total.push(Information::default());
        }
        number
    }

    fn evict(&mut self) -> Rejection {
        let losses = self.candidates.iter().map(|c| loss(c, &self.total));
        // Pinned ones make room only where there are no others.
        let pinned = |index: usize| self.candidates[index].is_pinned;
        let (least, loss) = losses
            .enumerate()
            .min_by(|a, b| {
                let free_first = pinned(a.0).cmp(&pinned(b.0));
                free_first.then(a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))
            })
            .expect("a full pool holds a candidate");
        let rejection = redundant(&self.candidates[least], loss, self.worth);
        self.remove(least, loss);
        rejection
    }

    fn remove(&mut self, index: usize, loss: f64) {
        let candidate = self.candidates.remove(index);
        for (patch, information) in &candidate.information {
            self.total[*patch] = self.total[*patch].minus(information);
        }
        self.worth -= loss;
    }

    /// Forgets the candidates that are later than `after_secs` of the device's clock.
    pub(super) fn forget_after(&mut self, after_secs: f64) {
        self.retain(|snapshot| snapshot.device_time_secs <= after_secs);
    }

    /// Forgets the candidates for which `stays` does not hold, looking at the latest first; returns whether a pinned one was among them.
    pub(super) fn retain(&mut self, mut stays: impl FnMut(&ShadingSnapshot) -> bool) -> bool {
        let mut was_pinned = false;
        for index in (0..self.candidates.len()).rev() {
            if !stays(&self.candidates[index].snapshot) {
                was_pinned |= self.candidates[index].is_pinned;
                let loss = loss(&self.candidates[index], &self.total);
                self.remove(index, loss);
            }
        }
        was_pinned
    }

    /// Moves all poses. What candidates tell stays with the patches where they were: those are larger than the drift of a scan.
    pub(super) fn correct(&mut self, correction: &PoseCorrection) {
        for Candidate { snapshot, .. } in &mut self.candidates {
            let time_secs = snapshot.device_time_secs;
            snapshot.world_from_camera = correction.apply(time_secs, &snapshot.world_from_camera);
        }
    }

    /// What all candidates tell of the surface together.
    pub(super) fn coverage(&self) -> Coverage {
        Coverage::of(
            self.patch_of
                .iter()
                .map(|(key, number)| (*key, self.total[*number])),
        )
    }

    /// The best `n` candidates, in order of time, and why the others are not among them. Ends early when the next one would
    /// add less than `min_gain_share` of the information chosen; with 0 it never does.
    pub(super) fn choose(
        self,
        n: usize,
        min_gain_share: f64,
    ) -> (Vec<ShadingSnapshot>, Vec<Rejection>) {
        let Choice { chosen, outdone } = self.choice(n, min_gain_share);
        let candidates = self.candidates.into_iter().enumerate();
        let chosen = candidates.filter(|(index, _)| chosen.contains(index));
        let chosen = chosen.map(|(_, candidate)| candidate.snapshot);
        (in_order_of_time(chosen.collect()), outdone)
    }

    /// What [`Self::choose`] would choose now, copied.
    pub(super) fn chosen(&self, n: usize, min_gain_share: f64) -> SnapshotSelection {
        let Choice { chosen, outdone } = self.choice(n, min_gain_share);
        let chosen = chosen
            .iter()
            .map(|&index| self.candidates[index].snapshot.clone());
        SnapshotSelection {
            accepted: in_order_of_time(chosen.collect()),
            rejected: outdone,
        }
    }

    /// All candidates in order of arrival, with why each would not be chosen now.
    pub(super) fn held(
        &self,
        n: usize,
        min_gain_share: f64,
    ) -> Vec<(&ShadingSnapshot, Option<RejectReason>)> {
        let Choice { chosen, outdone } = self.choice(n, min_gain_share);
        let mut outdone = outdone.into_iter();
        let candidates = self.candidates.iter().enumerate();
        candidates
            .map(|(index, candidate)| {
                let reason = match chosen.contains(&index) {
                    true => None,
                    false => outdone.next().map(|rejection| rejection.reason),
                };
                (&candidate.snapshot, reason)
            })
            .collect()
    }

    fn choice(&self, n: usize, min_gain_share: f64) -> Choice {
        let mut chosen = BTreeSet::new();
        let mut information = vec![Information::default(); self.total.len()];
        let mut worth = 0.0;
        while chosen.len() < n {
            let left = self.candidates.iter().enumerate();
            let gains = left
                .filter(|(index, _)| !chosen.contains(index))
                .map(|(index, c)| (index, gain(c, &information)));
            // Pinned ones first; the first of equals.
            let pinned = |index: usize| self.candidates[index].is_pinned;
            let best = gains.max_by(|a, b| {
                let pinned_first = pinned(a.0).cmp(&pinned(b.0));
                pinned_first.then(a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))
            });
            let Some((best, gain)) = best else { break };
            if !pinned(best) && gain < min_gain_share * (worth + gain) {
                break;
            }
            worth += gain;
            for (patch, added) in &self.candidates[best].information {
                information[*patch] = information[*patch].plus(added);
            }
            chosen.insert(best);
        }
        let left = self.candidates.iter().enumerate();
        let outdone = left
            .filter(|(index, _)| !chosen.contains(index))
            .map(|(_, c)| {
                let gain = gain(c, &information);
                redundant(c, gain, worth + gain)
            })
            .collect();
        Choice { chosen, outdone }
    }
}

/// A choice among the candidates.
struct Choice {
    /// By their place in the pool.
    chosen: BTreeSet<usize>,
    /// Why the others are not among them, in order of arrival.
    outdone: Vec<Rejection>,
}

fn in_order_of_time(mut chosen: Vec<ShadingSnapshot>) -> Vec<ShadingSnapshot> {
    chosen.sort_by(|a, b| a.device_time_secs.total_cmp(&b.device_time_secs));
    chosen
}

/// `worth` includes the candidate.
fn redundant(candidate: &Candidate, gain: f64, worth: f64) -> Rejection {
    let gain_share = if worth > 0.0 { gain / worth } else { 0.0 };
    Rejection {
        frame_id: candidate.snapshot.frame_id,
        reason: RejectReason::Redundant { gain_share },
    }
}

/// What the set with this information would gain by a candidate.
fn gain(candidate: &Candidate, chosen: &[Information]) -> f64 {
    sum_of_logarithms(candidate.information.iter().map(|(patch, added)| {
        let before = &chosen[*patch];
        before.plus(added).determinant() / before.determinant()
    }))
}

/// What the set with this information would lose without a candidate.
fn loss(candidate: &Candidate, total: &[Information]) -> f64 {
    sum_of_logarithms(candidate.information.iter().map(|(patch, removed)| {
        let all = &total[*patch];
        all.determinant() / all.minus(removed).determinant()
    }))
}

fn sum_of_logarithms(values: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut product) = (0.0, 1.0);
    for (index, value) in values.enumerate() {
        product *= value;
        if index % PER_LOGARITHM == PER_LOGARITHM - 1 {
            sum += f64::ln(product);
            product = 1.0;
        }
    }
    sum + product.ln()
}

#[cfg(test)]
mod tests;
