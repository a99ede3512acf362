//! Why an IR frame did not become a shading image.

use serde::Serialize;
use std::fmt;

/// An IR frame that is no shading image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Rejection {
    /// Which frame.
    pub frame_id: u64,
    /// Why.
    #[serde(flatten)]
    pub reason: RejectReason,
}

/// Rejections that are remembered at most, 320 KiB; when there are so many, the older half is forgotten.
const MAX_REMEMBERED: usize = 8192;

/// The IR frames of a scan that are no shading images: how many, and the newest of them.
#[derive(Clone, Debug, Default)]
pub struct Rejections {
    /// In the order in which that was found.
    newest: Vec<Rejection>,
    n_forgotten: usize,
}

impl Rejections {
    /// How many there were in all.
    pub fn count(&self) -> usize {
        self.n_forgotten + self.newest.len()
    }

    /// Those that are remembered, in the order in which that was found.
    pub fn newest(&self) -> &[Rejection] {
        &self.newest
    }

    /// Those that are remembered without the first `n` of all.
    pub fn after(&self, n: usize) -> &[Rejection] {
        let n_known = n.saturating_sub(self.n_forgotten).min(self.newest.len());
        &self.newest[n_known..]
    }

    /// Those that are remembered, in order of the frames.
    pub(super) fn by_frame(mut self) -> Vec<Rejection> {
        self.newest.sort_by_key(|rejection| rejection.frame_id);
        self.newest
    }
}

impl Extend<Rejection> for Rejections {
    fn extend<T: IntoIterator<Item = Rejection>>(&mut self, rejections: T) {
        for rejection in rejections {
            if self.newest.len() == MAX_REMEMBERED {
                self.newest.drain(..MAX_REMEMBERED / 2);
                self.n_forgotten += MAX_REMEMBERED / 2;
            }
            self.newest.push(rejection);
        }
    }
}

/// What speaks against an IR frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "reason", rename_all = "snake_case")]
pub enum RejectReason {
    /// The camera's pose is not known: the frame was not tracked, or (Kinect I) none was before the exposures.
    NotTracked,
    /// The frame carries no depth, which tells what hides the object.
    NoDepth,
    /// The camera moved while the image was exposed.
    TooFast {
        /// Turn per second since the last tracked frame.
        rotation_rad_per_s: f64,
        /// Speed since the last tracked frame.
        speed_m_per_s: f64,
        /// How fast the surface looked at moved on the image.
        image_speed_px_per_s: f64,
    },
    /// Too much of the image is at full scale.
    Saturated {
        /// Share of the pixels.
        share: f64,
    },
    /// No surface that reacts to tilting lies near the optical axis.
    NoInformation,
    /// Other images tell nearly all that this one does.
    Redundant {
        /// What it adds to them, as a share of all information.
        gain_share: f64,
    },
    /// Kinect I: the projector's speckle, not the lamp.
    Speckle {
        /// High-pass energy as a share of the local mean.
        energy: f64,
    },
    /// Kinect I: the image shows neither speckle nor the lamp.
    Dark {
        /// Share of the image that is lit.
        lit_share: f64,
    },
    /// Kinect I: light there is, but not the lamp's; it tells what the room adds to the lamp.
    Unlit {
        /// Brightness against that of the pose under the lamp, or of the brightest pose, distance allowed for.
        brightness: f64,
    },
    /// Kinect I: no speckle, but depth is there, so the projector is not covered.
    Uncovered {
        /// Share of the pixels with depth.
        depth_share: f64,
    },
    /// Kinect I: the camera moved between the last depth before the exposures and the first after them.
    NotStill {
        /// Turn between the two.
        rotation_rad: f64,
        /// Distance between the two.
        translation_m: f64,
    },
    /// Kinect I: the scene, or the camera, moved between the exposures.
    Changed {
        /// Share of the lit area that differs from the other exposures.
        share: f64,
    },
    /// Kinect I: too few exposures of this pose are left.
    FewExposures {
        /// How many there are.
        n_exposures: usize,
    },
    /// Kinect I: the pose has enough exposures without this one.
    Surplus,
    /// Kinect I: tracking did not find the camera again after the exposures.
    LostAfter,
    /// Kinect I: the stream ended before depth came back.
    Unfinished,
}

impl RejectReason {
    /// The reason's stable name, as in its JSON.
    pub fn code(&self) -> &'static str {
        match self {
            RejectReason::NotTracked => "not_tracked",
            RejectReason::NoDepth => "no_depth",
            RejectReason::TooFast { .. } => "too_fast",
            RejectReason::Saturated { .. } => "saturated",
            RejectReason::NoInformation => "no_information",
            RejectReason::Redundant { .. } => "redundant",
            RejectReason::Speckle { .. } => "speckle",
            RejectReason::Dark { .. } => "dark",
            RejectReason::Unlit { .. } => "unlit",
            RejectReason::Uncovered { .. } => "uncovered",
            RejectReason::NotStill { .. } => "not_still",
            RejectReason::Changed { .. } => "changed",
            RejectReason::FewExposures { .. } => "few_exposures",
            RejectReason::Surplus => "surplus",
            RejectReason::LostAfter => "lost_after",
            RejectReason::Unfinished => "unfinished",
        }
    }

    /// What the operator can do, as a sentence.
    pub fn advice(&self) -> &'static str {
        match self {
            RejectReason::NotTracked => "Wait until the camera is tracked.",
            RejectReason::NoDepth => "Point the camera at the object, within range.",
            RejectReason::TooFast { .. } => "Move more slowly, or stop for a moment.",
            RejectReason::Saturated { .. } => {
                "Go farther away, or tilt the camera against the surface."
            }
            RejectReason::NoInformation => "Point the camera at the object, not past it.",
            RejectReason::Redundant { .. } => "Look at the object from another side.",
            RejectReason::Speckle { .. } | RejectReason::Uncovered { .. } => {
                "Cover the projector before the picture."
            }
            RejectReason::Dark { .. } | RejectReason::Unlit { .. } => "Light the lamp.",
            RejectReason::NotStill { .. } => {
                "Hold still from before the projector is covered until it is free again."
            }
            RejectReason::Changed { .. } => {
                "Keep camera, lamp and object still during the exposures."
            }
            RejectReason::FewExposures { .. } => "Keep the projector covered a little longer.",
            RejectReason::Surplus => "Uncover the projector: this pose is done.",
            RejectReason::LostAfter => "Uncover the projector without moving the camera.",
            RejectReason::Unfinished => "Uncover the projector before the scan ends.",
        }
    }
}

impl fmt::Display for RejectReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            RejectReason::NotTracked => write!(f, "the pose is not known"),
            RejectReason::NoDepth => write!(f, "no depth with the IR image"),
            RejectReason::TooFast {
                rotation_rad_per_s,
                speed_m_per_s,
                image_speed_px_per_s,
            } => write!(
                f,
                "moving at {rotation_rad_per_s:.2} rad/s and {speed_m_per_s:.2} m/s, {image_speed_px_per_s:.0} px/s on the image"
            ),
            RejectReason::Saturated { share } => {
                write!(f, "{:.1} % of the pixels are saturated", 100.0 * share)
            }
            RejectReason::NoInformation => {
                write!(f, "no surface near the optical axis reacts to tilting")
            }
            RejectReason::Redundant { gain_share } => {
                write!(f, "adds {:.2} % of information", 100.0 * gain_share)
            }
            RejectReason::Speckle { energy } => write!(f, "speckle of energy {energy:.3}"),
            RejectReason::Dark { lit_share } => {
                write!(f, "only {:.1} % of the image is lit", 100.0 * lit_share)
            }
            RejectReason::Unlit { brightness } => write!(
                f,
                "without the lamp, {:.1} % as bright as with it",
                100.0 * brightness
            ),
            RejectReason::Uncovered { depth_share } => write!(
                f,
                "{:.1} % of the pixels have depth, the projector is not covered",
                100.0 * depth_share
            ),
            RejectReason::NotStill {
                rotation_rad,
                translation_m,
            } => write!(
                f,
                "not held still: {:.2}° and {:.1} mm from before to after",
                rotation_rad.to_degrees(),
                translation_m * 1000.0
            ),
            RejectReason::Changed { share } => write!(
                f,
                "{:.1} % of the lit area differs between exposures",
                100.0 * share
            ),
            RejectReason::FewExposures { n_exposures } => {
                write!(f, "{n_exposures} usable exposures of this pose")
            }
            RejectReason::Surplus => write!(f, "the pose has enough exposures"),
            RejectReason::LostAfter => write!(f, "tracking was lost after the exposures"),
            RejectReason::Unfinished => write!(f, "the stream ended before depth came back"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_rejections_are_remembered_and_all_are_counted() {
        let mut rejections = Rejections::default();
        let n_rejected = 3 * MAX_REMEMBERED;
        for frame in 0..n_rejected {
            rejections.extend([Rejection {
                frame_id: frame as u64,
                reason: RejectReason::NotTracked,
            }]);
            let [only] = rejections.after(frame) else {
                panic!("one is new");
            };
            assert_eq!(only.frame_id, frame as u64);
            assert!(rejections.newest().len() <= MAX_REMEMBERED);
        }
        assert_eq!(rejections.count(), n_rejected);
        assert_eq!(rejections.after(0), rejections.newest());
        assert!(rejections.after(n_rejected).is_empty());
        assert!(rejections.by_frame().len() >= MAX_REMEMBERED / 2);
    }

    #[test]
    fn reasons_are_told_with_their_figures() {
        let reason = RejectReason::NotStill {
            rotation_rad: 0.01,
            translation_m: 0.0042,
        };
        assert_eq!(
            reason.to_string(),
            "not held still: 0.57° and 4.2 mm from before to after"
        );
        let rejection = Rejection {
            frame_id: 7,
            reason: RejectReason::Speckle { energy: 0.5 },
        };
        assert_eq!(
            serde_json::to_string(&rejection).unwrap(),
            r#"{"frame_id":7,"reason":"speckle","energy":0.5}"#
        );
        assert_eq!(rejection.reason.code(), "speckle");
    }
}
