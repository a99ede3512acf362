//! The white level at which the views of a scan agree best.

use super::{Evidence, strength};
use crate::interreflection::WhiteLevel;

/// What is known of a scan's white level, and what the scan itself has told of it so far.
#[derive(Clone, Debug)]
pub struct WhiteSearch {
    /// Strength that is plausible from the scan's brightness.
    plausible: f64,
    /// The strength that the scan was fused with last, and what it told.
    tried: Option<(f64, Evidence)>,
    /// Standard deviation of the strength as known by now.
    sigma: f64,
}

/// The white level at which the views of a scan should agree better.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NextWhite {
    /// The white level; `None` is no multipath.
    pub white: Option<WhiteLevel>,
    /// Whether the one before it will do: the scan need not be fused again for it.
    pub will_do: bool,
}

/// How far a plausible strength may be off, as a share: albedos of 0.4 to 0.8 are taken for 0.6.
const PLAUSIBLE_SIGMA: f64 = 0.35;
/// Disagreement of views that has other causes and looks like multipath all the same, metres: what sensors do at slanting
/// incidence beside.
const OTHER_CAUSES_M: f64 = 3e-5;
/// Share of a wrong strength that tracking and fusion do not hide: 0.4 to 0.6 on the recorded scans.
const SHOWN_SHARE: f64 = 0.5;
/// Shares beyond these bounds are noise.
const SHOWN_SHARES: [f64; 2] = [0.25, 1.0];
/// A scan is fused again for a larger change of strength than this share. At 0.1 a chest's base mesh was left at 0.78 mm, which comes
/// to 0.62.
const TOLERANCE: f64 = 0.04;

impl WhiteSearch {
    /// A search that starts from what is plausible.
    pub fn from(plausible: WhiteLevel) -> Self {
        let plausible = strength(Some(plausible));
        WhiteSearch {
            plausible,
            tried: None,
            sigma: PLAUSIBLE_SIGMA * plausible,
        }
    }

    /// Standard deviation of a white level as a share of it, by what is known now.
    pub fn relative_sigma(&self, white: WhiteLevel) -> f64 {
        self.sigma / strength(Some(white))
    }

    /// Takes in what a scan tells that was fused with a white level, and gives the one to fuse it with next: where plausibility
    /// and views, each weighed by what it may be off, agree best.
    pub fn next(&mut self, white: Option<WhiteLevel>, evidence: Evidence) -> NextWhite {
        let here = strength(white);
        let before = self.tried.replace((here, evidence));
        let shown = before.map_or(SHOWN_SHARE, |(there, evidence_there)| {
            let seen = (evidence_there.slope - evidence.slope) / (here - there);
            seen.clamp(SHOWN_SHARES[0], SHOWN_SHARES[1])
        });
        let told = here + evidence.slope / shown;
        let told_sigma = evidence.sigma.hypot(OTHER_CAUSES_M / evidence.predicted_m) / shown;
        let told_weight = told_sigma.powi(-2);
        let plausible_weight = (PLAUSIBLE_SIGMA * self.plausible).powi(-2);
        let next = (told * told_weight + self.plausible * plausible_weight)
            / (told_weight + plausible_weight);
        self.sigma = (told_weight + plausible_weight).sqrt().recip();
        let next = next.max(0.0);
        NextWhite {
            white: WhiteLevel::of_strength(next),
            will_do: (next - here).abs() <= TOLERANCE * here.max(next),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A scan whose strength is `truth`, that shows `shown` of what is wrong, of views that should disagree by `predicted_m`.
    fn told(white: Option<WhiteLevel>, truth: f64, shown: f64, predicted_m: f64) -> Evidence {
        Evidence {
            slope: shown * (truth - strength(white)),
            sigma: 0.002,
            predicted_m,
            residual_m: 1e-3,
            n_patches: 1000,
        }
    }

    /// The strength that a search ends with which starts from a plausible one.
    fn found(plausible: f64, truth: f64, shown: f64, predicted_m: f64) -> f64 {
        let start = WhiteLevel::of_strength(plausible).expect("positive");
        let mut search = WhiteSearch::from(start);
        let mut white = Some(start);
        for _ in 0..4 {
            let next = search.next(white, told(white, truth, shown, predicted_m));
            if next.will_do {
                break;
            }
            white = next.white;
        }
        strength(white)
    }

    #[test]
    fn views_that_tell_much_lead_to_the_truth_from_either_side() {
        for (plausible, truth, shown) in [(0.9, 1.2, 0.5), (2.0, 0.9, 0.4), (0.5, 1.0, 0.7)] {
            let strength = found(plausible, truth, shown, 4e-3);
            assert!((strength / truth - 1.0).abs() < 0.2, "{truth}: {strength}");
        }
    }

    #[test]
    fn a_small_object_whose_brightness_misleads_is_told_by_views_that_should_differ_by_little() {
        for (plausible, truth) in [(2.4, 1.7), (1.0, 1.6)] {
            let strength = found(plausible, truth, 0.4, 3e-4);
            assert!((strength / truth - 1.0).abs() < 0.15, "{truth}: {strength}");
        }
    }

    #[test]
    fn where_views_agree_without_multipath_hardly_any_is_left() {
        assert!(found(0.9, 0.0, 0.5, 4e-3) < 0.15);
    }

    #[test]
    fn views_that_tell_nothing_leave_what_is_plausible() {
        assert_eq!(
            found(0.9, 0.2, 0.5, 1e-5),
            strength(WhiteLevel::of_strength(0.9))
        );
    }
}
