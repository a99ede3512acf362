//! The infrared images of one pose whose projector is covered: those that the lamp lights, and those from before it was lit, which
//! show what light there is beside it.

use super::exposures::Exposure;
use super::rejection::{RejectReason, Rejection};
use depth_camera::Image;

/// An image less bright than this share of the brightest of its pose is not lit by the lamp, or not yet.
const LIT_SHARE: f64 = 0.5;
/// Under one lamp a pose is no dimmer than this share of the brightest, distance allowed for: 0.48 in recorded scans.
const DIMMEST_POSE: f64 = 0.25;
/// Images without the lamp go together that differ in brightness by no more than this share of the lit ones': while a lamp
/// warms up, or a hand passes, images are no ambient light.
const SAME_SHARE: f64 = 0.02;
/// One alone does not tell whether it is one of these.
const MIN_UNLIT: usize = 2;

/// What was taken at one pose so far.
#[derive(Default)]
pub(super) struct LampGroup {
    exposures: Vec<Exposure>,
    /// Those that the lamp does not light.
    unlit: Vec<Exposure>,
}

impl LampGroup {
    /// Takes in an image in which something is lit, up to `max_exposures`; returns those of the group that thereby are known
    /// not to be exposures.
    pub(super) fn add(&mut self, image: Exposure, max_exposures: usize) -> Vec<Rejection> {
        let brightest = self.brightest();
        let mut refused = Vec::new();
        if image.mean_counts() < LIT_SHARE * brightest {
            refused.push(unlit(image.frame_id, image.mean_counts() / brightest));
            self.add_unlit(image, max_exposures);
            return refused;
        }
        let now = brightest.max(image.mean_counts());
        let (lit, before) = std::mem::take(&mut self.exposures)
            .into_iter()
            .partition(|exposure| exposure.mean_counts() >= LIT_SHARE * now);
        self.exposures = lit;
        for exposure in before {
            refused.push(unlit(exposure.frame_id, exposure.mean_counts() / now));
            self.add_unlit(exposure, max_exposures);
        }
        match self.exposures.len() < max_exposures {
            true => self.exposures.push(image),
            false => refused.push(Rejection {
                frame_id: image.frame_id,
                reason: RejectReason::Surplus,
            }),
        }
        refused
    }

    /// Takes in an image that the lamp does not light; of many only the first are held.
    pub(super) fn add_unlit(&mut self, image: Exposure, max_exposures: usize) {
        if self.unlit.len() < max_exposures {
            self.unlit.push(image);
        }
    }

    /// Those that the lamp lights.
    pub(super) fn exposures(&self) -> &[Exposure] {
        &self.exposures
    }

    /// The counts without the lamp, averaged; `None` where too few images tell them.
    pub(super) fn unlit_counts(&self) -> Option<Image<f32>> {
        let mut means: Vec<f64> = self.unlit.iter().map(Exposure::mean_counts).collect();
        means.sort_unstable_by(f64::total_cmp);
        let middle = *means.get(means.len().saturating_sub(1) / 2)?;
        let apart = SAME_SHARE * self.brightest();
        let same = self.unlit.iter();
        let same = same.filter(|image| (image.mean_counts() - middle).abs() <= apart);
        let same: Vec<&Image<u16>> = same.map(|image| &image.counts).collect();
        if same.len() < MIN_UNLIT {
            return None;
        }
        let mut sums = Image::filled(same[0].width(), same[0].height(), 0.0f32);
        let share = 1.0 / same.len() as f32;
        for counts in same {
            let pixels = sums.data_mut().iter_mut().zip(counts.data());
            pixels.for_each(|(sum, &counts)| *sum += share * f32::from(counts));
        }
        Some(sums)
    }

    /// How many of these may be lit by a lamp that would make the brightest of poses this bright, counts.
    pub(super) fn n_lit(&self, lamp_counts: f64) -> usize {
        let means = self.exposures.iter().map(Exposure::mean_counts);
        means.filter(|counts| is_lit(*counts, lamp_counts)).count()
    }

    /// Drops all if such a lamp lights none of them. They are no ambient light, either: it is not known what lights them.
    pub(super) fn drop_unlit(&mut self, lamp_counts: f64) -> Vec<Rejection> {
        if is_lit(self.brightest(), lamp_counts) {
            return Vec::new();
        }
        let dim = std::mem::take(&mut self.exposures).into_iter();
        dim.map(|exposure| unlit(exposure.frame_id, exposure.mean_counts() / lamp_counts))
            .collect()
    }

    /// Mean counts of the brightest of them; 0 without any.
    fn brightest(&self) -> f64 {
        let means = self.exposures.iter().map(Exposure::mean_counts);
        means.fold(0.0, f64::max)
    }
}

/// Whether an image of mean counts may be lit by a lamp that would make the brightest of poses this bright, counts.
pub(super) fn is_lit(counts: f64, lamp_counts: f64) -> bool {
    counts >= DIMMEST_POSE * lamp_counts
}

/// Says of an image that it is so bright without the lamp, as a share of what it would be under it.
pub(super) fn unlit(frame_id: u64, brightness: f64) -> Rejection {
    Rejection {
        frame_id,
        reason: RejectReason::Unlit { brightness },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(frame_id: u64, counts: u16) -> Exposure {
        Exposure::new(
            frame_id,
            frame_id as f64 / 30.0,
            Image::filled(8, 6, counts),
            None,
        )
    }

    fn group(counts: &[u16]) -> (LampGroup, Vec<Rejection>) {
        let mut group = LampGroup::default();
        let images = counts.iter().enumerate();
        let refused = images.flat_map(|(k, &counts)| group.add(image(k as u64, counts), 4));
        let refused = refused.collect();
        (group, refused)
    }

    #[test]
    fn what_came_before_the_lamp_is_its_ambient_light() {
        let (group, refused) = group(&[80, 82, 400, 410]);
        let lit: Vec<u64> = group.exposures().iter().map(|e| e.frame_id).collect();
        assert_eq!(lit, [2, 3]);
        assert_eq!(refused.len(), 2);
        assert!(matches!(
            refused[0].reason,
            RejectReason::Unlit { brightness } if (brightness - 0.2).abs() < 1e-12
        ));
        let unlit = group.unlit_counts().expect("two tell");
        assert!((unlit.at(3, 3) - 81.0).abs() < 1e-4);
    }

    #[test]
    fn a_lamp_that_warms_up_and_a_hand_that_passes_are_no_ambient_light() {
        let (group, _) = group(&[5, 80, 81, 150, 400, 400, 80]);
        // Two at 80, one at 81.
        let unlit = group.unlit_counts().expect("three tell");
        assert!((unlit.at(3, 3) - 80.5).abs() < 0.6, "{}", unlit.at(3, 3));
    }

    #[test]
    fn one_image_without_the_lamp_tells_nothing() {
        assert!(group(&[80, 400, 400]).0.unlit_counts().is_none());
        assert!(group(&[400, 400]).0.unlit_counts().is_none());
    }

    #[test]
    fn waiting_in_a_lit_room_does_not_use_the_lamp_s_places_up() {
        let (group, refused) = group(&[80, 80, 80, 80, 80, 80, 80, 400, 400, 400, 400, 400]);
        assert_eq!(group.exposures().len(), 4);
        let surplus = refused.iter().filter(|r| r.reason == RejectReason::Surplus);
        // Three before the lamp was lit, and its fifth.
        assert_eq!(surplus.count(), 4);
    }
}
