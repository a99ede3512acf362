//! What becomes of a frame.

use super::degeneracy::MAX_DEGENERATE_SHARE;
use crate::geometry::Pose;
use serde::Serialize;

/// How well a frame fits the model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Fit {
    /// Share of the frame's points that found their place on the model.
    pub inlier_share: f64,
    /// Weighted root mean square distance of the inliers to the model, metres.
    pub rmse_m: f64,
    /// Smallest over largest eigenvalue of the normal equations: near zero the geometry lets the camera slide.
    pub conditioning: f64,
    /// Share of the frame's points that lie behind a surface of the model: the camera would look through it. Where nearly all of the frame
    /// lay on the model, which was not cast then, the share of those that do not.
    pub see_through_share: f64,
    /// How firmly the geometry holds the motion that it holds least, angles scaled by the size of what is seen: mean square
    /// share of that motion that the distances show, by the frame's own normals or by what the last ten had in common with the
    /// model; 0 where the camera can slide.
    pub held_share: f64,
    /// How far the frame is from being lost, 0 to 1: 0 at the nearest gate, 1 halfway between every gate and a perfect fit.
    pub fitness: f64,
}

impl Fit {
    /// Whether the shape of what is seen lets the camera slide, whatever else holds it.
    pub fn is_sliding(&self) -> bool {
        self.held_share < MAX_DEGENERATE_SHARE
    }
}

/// Why the camera is lost.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "reason", rename_all = "snake_case")]
pub enum LossReason {
    /// Too few points of the frame lie on the model: too fast, too close, or another place.
    FewInliers {
        /// Share of the points that lie on the model.
        inlier_share: f64,
    },
    /// The camera would look through surfaces of the model: it is elsewhere, however well the rest fits.
    SeeThrough {
        /// Share of the points that lie behind the model.
        share: f64,
    },
    /// The frame lies on the model badly.
    LargeResidual {
        /// Root mean square distance of the inliers, metres.
        rmse_m: f64,
    },
    /// The geometry in view does not hold the camera: a flat or round scene.
    FlatScene {
        /// Smallest over largest eigenvalue of the alignment.
        conditioning: f64,
    },
    /// The camera would have moved faster than a hand does.
    Jump {
        /// Turn since the last good pose, radians.
        rotation_rad: f64,
        /// Distance from the last good pose, metres.
        translation_m: f64,
    },
    /// A place was found where the frame may have been taken; the next one has to confirm it.
    Unconfirmed,
    /// The frame does not show what the model shows from where it seems to be.
    Elsewhere,
}

/// What became of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TrackingOutcome {
    /// The frame was aligned and fused.
    Tracked {
        /// Pose of the camera.
        world_from_camera: Pose,
        /// How well it fits; `None` for the first frame and for given poses.
        fit: Option<Fit>,
    },
    /// The frame shows no surface: covered lens or projector, or nothing in range. Tracking waits.
    NoDepth,
    /// The frame does not fit the model and was not fused.
    Lost(LossReason),
}
