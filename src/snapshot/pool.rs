//! A bounded pool of candidates, and the choice among them by information.
//!
//! A set of views is worth `Σ log det(I + A)` over the patches, with A the patch's information summed over the views: the
//! first view from a new side is worth much, the tenth alike little. That worth is submodular, so taking the best next view
//! again and again is within a factor 1 − 1/e of the best set. While the scan goes on, the candidate whose removal loses
//! least makes room.

use super::ShadingSnapshot;
use super::information::{Information, PatchKey, ViewInformation};
use super::rejection::{RejectReason, Rejection};
use std::collections::BTreeMap;

/// Determinants multiplied before a logarithm is taken; they stay below 1e12 each, their product far from overflow.
const PER_LOGARITHM: usize = 16;

/// Candidates for shading images with what each tells.
pub(super) struct Pool {
    capacity: usize,
    /// Patches are numbered in order of appearance.
    patch_of: BTreeMap<PatchKey, usize>,
    /// Information of all candidates, by patch.
    total: Vec<Information>,
    /// In order of arrival.
    candidates: Vec<Candidate>,
}

struct Candidate {
    snapshot: ShadingSnapshot,
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
            candidates: Vec::new(),
        }
    }

    pub(super) fn len(&self) -> usize {
        self.candidates.len()
    }

    /// Takes a candidate in; when there is no room, the one whose removal loses least (of equals the latest) is put out.
    pub(super) fn offer(
        &mut self,
        snapshot: ShadingSnapshot,
        view: &ViewInformation,
    ) -> Option<Rejection> {
        let information: Vec<_> = view
            .patches
            .iter()
            .map(|(key, information)| (self.patch_number(*key), *information))
            .collect();
        for (patch, information) in &information {
            self.total[*patch] = self.total[*patch].plus(information);
        }
        self.candidates.push(Candidate {
            snapshot,
            information,
        });
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
        let (least, loss) = losses
            .enumerate()
            .min_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))
            .expect("a full pool holds a candidate");
        let worth = sum_of_logarithms(self.total.iter().map(Information::determinant));
        let candidate = self.candidates.remove(least);
        for (patch, information) in &candidate.information {
            self.total[*patch] = self.total[*patch].minus(information);
        }
        redundant(&candidate, loss, worth)
    }

    /// The best `n` candidates, in order of time, and why the others are not among them. Ends early when the next one would
    /// add less than `min_gain_share` of the information chosen; with 0 it never does.
    pub(super) fn choose(
        mut self,
        n: usize,
        min_gain_share: f64,
    ) -> (Vec<ShadingSnapshot>, Vec<Rejection>) {
        let mut chosen = Vec::new();
        let mut information = vec![Information::default(); self.total.len()];
        let mut worth = 0.0;
        while chosen.len() < n {
            let gains = self.candidates.iter().map(|c| gain(c, &information));
            // The first of equals.
            let best = gains
                .enumerate()
                .max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
            let Some((best, gain)) = best else { break };
            if gain < min_gain_share * (worth + gain) {
                break;
            }
            worth += gain;
            let candidate = self.candidates.remove(best);
            for (patch, added) in &candidate.information {
                information[*patch] = information[*patch].plus(added);
            }
            chosen.push(candidate.snapshot);
        }
        chosen.sort_by(|a, b| a.device_time_secs.total_cmp(&b.device_time_secs));
        let rejected = self
            .candidates
            .iter()
            .map(|c| redundant(c, gain(c, &information), worth))
            .collect();
        (chosen, rejected)
    }
}

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
mod tests {
    use super::*;
    use crate::snapshot::information::{Optics, view_information};
    use crate::snapshot::scenes::{self, Plane};
    use depth_camera::Sensor;

    /// A view from the origin of a plane that leans by 35° towards `azimuth_rad`.
    fn candidate(frame_id: u64, azimuth_rad: f64) -> (ShadingSnapshot, ViewInformation) {
        let plane = Plane::tilted(35.0_f64.to_radians(), azimuth_rad);
        let optics = Optics::new(&scenes::camera_info(Sensor::Kinect2)).unwrap();
        let (mut snapshot, model) = scenes::view_of_plane(&plane, &nalgebra::Isometry3::identity());
        snapshot.frame_id = frame_id;
        snapshot.device_time_secs = frame_id as f64;
        let view = view_information(&snapshot, &model, &optics);
        (snapshot, view)
    }

    fn ids(snapshots: &[ShadingSnapshot]) -> Vec<u64> {
        snapshots.iter().map(|s| s.frame_id).collect()
    }

    #[test]
    fn a_new_tilt_is_chosen_before_a_repeated_one() {
        let mut pool = Pool::new(8);
        for (frame_id, azimuth) in [(0, 0.0), (1, 0.0), (2, 0.0), (3, 1.6)] {
            let (snapshot, view) = candidate(frame_id, azimuth);
            assert_eq!(pool.offer(snapshot, &view), None);
        }
        let (chosen, rejected) = pool.choose(2, 0.0);
        assert!(ids(&chosen).contains(&3));
        assert_eq!(chosen.len() + rejected.len(), 4);
    }

    #[test]
    fn a_full_pool_puts_out_the_latest_of_equals() {
        let mut pool = Pool::new(3);
        let mut evicted = Vec::new();
        for (frame_id, azimuth) in [(0, 0.0), (1, 1.6), (2, 0.0), (3, 0.0), (4, 3.1)] {
            let (snapshot, view) = candidate(frame_id, azimuth);
            evicted.extend(pool.offer(snapshot, &view).map(|r| r.frame_id));
        }
        assert_eq!(evicted, [3, 2]);
        assert_eq!(pool.len(), 3);
        assert_eq!(ids(&pool.choose(3, 0.0).0), [0, 1, 4]);
    }

    #[test]
    fn choosing_ends_when_little_is_gained() {
        let mut pool = Pool::new(40);
        for frame_id in 0..40 {
            let (snapshot, view) = candidate(frame_id, 0.3);
            pool.offer(snapshot, &view);
        }
        let (chosen, rejected) = pool.choose(36, 0.03);
        assert!(chosen.len() > 3 && chosen.len() < 20, "{}", chosen.len());
        assert!(rejected.iter().all(|r| matches!(
            r.reason,
            RejectReason::Redundant { gain_share } if gain_share < 0.03
        )));
    }

    #[test]
    fn worth_is_submodular_and_losses_are_gains_in_reverse() {
        let mut pool = Pool::new(8);
        for (frame_id, azimuth) in [(0, 0.0), (1, 0.8), (2, 1.6)] {
            let (snapshot, view) = candidate(frame_id, azimuth);
            pool.offer(snapshot, &view);
        }
        let last = &pool.candidates[2];
        let nothing = vec![Information::default(); pool.total.len()];
        let mut others = pool.total.clone();
        for (patch, information) in &last.information {
            others[*patch] = others[*patch].minus(information);
        }
        assert!(gain(last, &others) < gain(last, &nothing));
        assert!((gain(last, &others) - loss(last, &pool.total)).abs() < 1e-9);
    }
}
