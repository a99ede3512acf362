//! When tracking was lost, and why, in words.

use crate::{export::LostSpan, fusion::LossReason};

/// The times during which tracking was lost.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Losses {
    spans: Vec<LostSpan>,
    is_lost: bool,
}

impl Losses {
    /// Whether tracking is lost now.
    pub fn is_lost(&self) -> bool {
        self.is_lost
    }

    /// All spans so far.
    pub fn spans(&self) -> &[LostSpan] {
        &self.spans
    }

    /// Adds a frame without a pose; true if it is the first of its span.
    pub fn extend(&mut self, frame_id: u64, time_secs: f64, reason: &str) -> bool {
        if self.is_lost
            && let Some(span) = self.spans.last_mut()
        {
            span.last_frame_id = frame_id;
            span.end_secs = time_secs;
            return false;
        }
        self.is_lost = true;
        self.spans.push(LostSpan {
            first_frame_id: frame_id,
            last_frame_id: frame_id,
            start_secs: time_secs,
            end_secs: time_secs,
            reason: reason.to_owned(),
        });
        true
    }

    /// Ends the span that is open; true if there is one.
    pub fn end(&mut self) -> bool {
        std::mem::replace(&mut self.is_lost, false)
    }
}

/// A reason as the operator reads it.
pub fn sentence(reason: &LossReason) -> String {
    match reason {
        LossReason::FewInliers { inlier_share } => format!(
            "only {:.0} % of the points lie on the model",
            100.0 * inlier_share
        ),
        LossReason::SeeThrough { share } => format!(
            "the camera would look through the model at {:.0} % of the points",
            100.0 * share
        ),
        LossReason::LargeResidual { rmse_m } => {
            format!(
                "the frame is {:.1} mm off the model on average",
                1e3 * rmse_m
            )
        }
        LossReason::FlatScene { conditioning } => format!(
            "the scene is too flat or too round to hold the camera (conditioning {conditioning:.1e})"
        ),
        LossReason::Jump {
            rotation_rad,
            translation_m,
        } => format!(
            "a jump of {:.1}° and {:.0} mm between frames",
            rotation_rad.to_degrees(),
            1e3 * translation_m
        ),
        LossReason::Elsewhere => {
            "the frame shows something else than the model from where it seems to be".to_owned()
        }
        LossReason::Unconfirmed => {
            "a place was found that the next frame has to confirm".to_owned()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_begin_with_their_first_frame_and_end_when_found() {
        let mut losses = Losses::default();
        assert!(!losses.end());
        assert!(losses.extend(3, 0.3, "jump"));
        assert!(!losses.extend(4, 0.4, "few inliers"));
        assert!(losses.end());
        assert!(losses.extend(9, 0.9, "flat"));
        let [first, second] = losses.spans() else {
            panic!("two spans");
        };
        assert_eq!((first.first_frame_id, first.last_frame_id), (3, 4));
        assert_eq!(first.reason, "jump");
        assert_eq!((second.first_frame_id, second.end_secs), (9, 0.9));
    }
}
