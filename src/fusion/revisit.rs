//! Whether the camera has come back to where it was before, after it was elsewhere: then there is drift to be taken back.

use super::pose_correction::PoseCorrection;
use super::track::Track;
use crate::geometry::{Motion, Pose, motion_between};

/// A camera that turned or moved farther than this from a place has left it: it saw little there of what it sees now.
const ELSEWHERE: Motion = Motion {
    rotation_rad: 1.8,
    translation_m: 1.5,
};
/// Nearer than this it is back: it sees half of what it saw.
const BACK: Motion = Motion {
    rotation_rad: 0.35,
    translation_m: 0.3,
};
/// A new place is so far from all others; smaller than what is back.
const NEW: Motion = Motion {
    rotation_rad: 0.2,
    translation_m: 0.15,
};
/// So many places at most; later ones are not kept.
const MAX_PLACES: usize = 1000;
/// Loops are looked for so long after the camera came back, seconds: then there is enough to align.
const DWELL_SECS: f64 = 1.0;
/// Loops are looked for again when the scan has become so many times as long: that takes as long as the scan took, so that all of it
/// together stays in proportion to the scan.
const GROWTH: f64 = 1.5;

/// Where the camera was, and what of it it has left since.
#[derive(Clone, Debug, Default)]
pub(super) struct Revisits {
    /// In order of time.
    places: Vec<Place>,
    /// When it came back, until that is seen to.
    back_secs: Option<f64>,
    newest_secs: f64,
    /// When loops were looked for last.
    looked_secs: Option<f64>,
}

#[derive(Clone, Debug)]
struct Place {
    world_from_camera: Pose,
    time_secs: f64,
    /// Since loops were looked for last.
    since: Since,
}

/// What the camera did at a place.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Since {
    /// It was not there.
    Nothing,
    /// It was there.
    Seen,
    /// It was there, and then elsewhere.
    Left,
}

impl Revisits {
    /// Takes in where the camera is.
    pub(super) fn visit(&mut self, track: &Track) {
        let mut is_new = true;
        for place in &mut self.places {
            let motion = motion_between(&place.world_from_camera, &track.world_from_camera);
            match place.since {
                Since::Nothing if motion.is_within(&BACK) => place.since = Since::Seen,
                Since::Seen if !motion.is_within(&ELSEWHERE) => place.since = Since::Left,
                Since::Left if motion.is_within(&BACK) => {
                    self.back_secs.get_or_insert(track.time_secs);
                }
                _ => {}
            }
            is_new &= !motion.is_within(&NEW);
        }
        if is_new && self.places.len() < MAX_PLACES {
            self.places.push(Place {
                world_from_camera: track.world_from_camera,
                time_secs: track.time_secs,
                since: Since::Seen,
            });
        }
        self.newest_secs = track.time_secs;
    }

    /// Whether the camera came back long enough ago for loops to be looked for, in a scan that has grown since they were.
    pub(super) fn are_due(&self) -> bool {
        let first_secs = self.places.first().map_or(0.0, |place| place.time_secs);
        let has_grown = self
            .looked_secs
            .is_none_or(|looked| self.newest_secs - first_secs >= GROWTH * (looked - first_secs));
        let is_settled = |back: f64| self.newest_secs - back >= DWELL_SECS;
        has_grown && self.back_secs.is_some_and(is_settled)
    }

    /// Loops are being looked for: the next time is when the camera has been somewhere, elsewhere, and back again.
    pub(super) fn see_to(&mut self) {
        self.looked_secs = Some(self.newest_secs);
        self.forget_visits();
    }

    fn forget_visits(&mut self) {
        self.back_secs = None;
        for place in &mut self.places {
            place.since = Since::Nothing;
        }
    }

    /// Moves all places.
    pub(super) fn correct(&mut self, correction: &PoseCorrection) {
        for place in &mut self.places {
            place.world_from_camera = correction.apply(place.time_secs, &place.world_from_camera);
        }
    }

    /// Forgets the places that were found later than `after_secs`, and what happened since.
    pub(super) fn forget_after(&mut self, after_secs: f64) {
        self.places.retain(|place| place.time_secs <= after_secs);
        self.newest_secs = self.newest_secs.min(after_secs);
        self.looked_secs = self.looked_secs.map(|looked| looked.min(after_secs));
        self.forget_visits();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// Turns about the vertical axis by `degrees` in steps of 3°, ten a second.
    fn turn(revisits: &mut Revisits, time_secs: &mut f64, from: i32, to: i32) {
        let step = if to > from { 3 } else { -3 };
        for k in 1..=(to - from) / step {
            let angle = f64::from(from + k * step).to_radians();
            let pose = Pose::rotation(Vector3::y() * angle);
            *time_secs += 0.1;
            revisits.visit(&Track::at(pose, *time_secs));
        }
    }

    #[test]
    fn a_full_turn_comes_back_once_and_a_swing_never_leaves() {
        let (mut revisits, mut time_secs) = (Revisits::default(), 0.0);
        for _ in 0..3 {
            turn(&mut revisits, &mut time_secs, 0, 60);
            turn(&mut revisits, &mut time_secs, 60, 0);
        }
        assert!(!revisits.are_due());
        turn(&mut revisits, &mut time_secs, 0, 336);
        assert!(!revisits.are_due(), "not near enough yet");
        turn(&mut revisits, &mut time_secs, 336, 345);
        assert!(!revisits.are_due(), "just come back");
        turn(&mut revisits, &mut time_secs, 345, 378);
        assert!(revisits.are_due());
        revisits.see_to();
        turn(&mut revisits, &mut time_secs, 378, 699);
        assert!(!revisits.are_due(), "seen to, until the next turn is full");
        turn(&mut revisits, &mut time_secs, 699, 780);
        assert!(revisits.are_due(), "another turn");
        revisits.see_to();
        turn(&mut revisits, &mut time_secs, 780, 1161);
        assert!(
            !revisits.are_due(),
            "a turn of a scan that has not grown by half"
        );
        turn(&mut revisits, &mut time_secs, 1161, 1380);
        assert!(revisits.are_due(), "one that has");
        revisits.forget_after(1.0);
        assert!(!revisits.are_due() && revisits.places.len() < 5);
    }
}
