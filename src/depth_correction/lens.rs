//! A lens whose focal length is not what it is said to be.
//!
//! Lenses of one kind differ by a percent or two, and a calibration that is shipped for the kind knows nothing of that. With a focal length
//! that is 2 % too short all that is seen is 2 % too wide for its depth, slopes are too flat, and a surface that was seen from all round does
//! not close: a base mesh lies three times as far off. Views of one surface tell it ([`Views::longer_focus`]) to a percent, and a scan is
//! fused again by the rays of another camera.
//!
//! Not told: less than that; scale, for a scene that is larger as a whole looks alike; and one axis beside the other.
//!
//! [`Views::longer_focus`]: super::gross_error::Views::longer_focus

use crate::geometry::{CameraModel, RayGrid};
use depth_camera::Intrinsics;
use std::sync::Arc;

/// No lens is off by more than this share of its focal length.
const MAX_LONGER: f64 = 0.05;

/// The lens that the views of a scan agree with.
#[derive(Clone)]
pub(super) struct Lens {
    /// What it is said to be.
    said: Intrinsics,
    /// By how much of itself its focal length is longer.
    longer: f64,
    /// By it.
    rays: Arc<RayGrid>,
}

impl Lens {
    /// One with a focal length longer by a share than it is said to be; `None` if no lens is so far off.
    pub(super) fn new(said: &Intrinsics, longer: f64) -> Option<Self> {
        let camera = CameraModel::new(*said).with_longer_focus(longer);
        (longer.abs() <= MAX_LONGER).then(|| Lens {
            said: *said,
            longer,
            rays: Arc::new(RayGrid::new(camera)),
        })
    }

    /// One that is longer than this by a further share.
    pub(super) fn plus(&self, longer: f64) -> Option<Self> {
        Lens::new(&self.said, (1.0 + self.longer) * (1.0 + longer) - 1.0)
    }

    /// The rays of its pixels.
    pub(super) fn rays(&self) -> &RayGrid {
        &self.rays
    }

    /// The camera with it.
    pub(super) fn intrinsics(&self) -> &Intrinsics {
        self.rays.camera().intrinsics()
    }

    /// By how much its focal length is longer than it is said to be, per cent.
    pub(super) fn longer_percent(&self) -> f64 {
        100.0 * self.longer
    }

    /// What was put right, as a sentence for the operator.
    pub(super) fn put_right(&self) -> String {
        let than_said = if self.longer > 0.0 {
            "longer"
        } else {
            "shorter"
        };
        let (now, said) = (self.intrinsics(), &self.said);
        format!(
            "views of this scan agree with a focal length {:.1} % {than_said} than the camera is said to have, and it was fused with that: \
             fx {:.1}, fy {:.1} pixels for {:.1} and {:.1}, which the `session.toml` of a recording may state",
            self.longer_percent().abs(),
            now.fx,
            now.fy,
            said.fx,
            said.fy
        )
    }
}
