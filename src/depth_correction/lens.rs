//! A lens whose focal lengths are not what they are said to be.
//!
//! Lenses of one kind differ by a percent or two, and a calibration that is shipped for the kind knows nothing of that; a recording may state
//! another camera's, or have been scaled otherwise across than down. With a focal length that is 2 % too short all that is seen is 2 % too wide
//! for its depth, slopes are too flat, and a surface that was seen from all round does not close: a base mesh lies three times as far off.
//! Views of one surface tell both focal lengths, across and down ([`Views::longer_focus`]), to a percent, and a scan is fused again by the rays of
//! another camera; it stays so if its frames then lie closer to the model than without.
//!
//! Not told: less than that; and scale, for a scene that is larger as a whole looks alike.
//!
//! [`Views::longer_focus`]: super::gross_error::Views::longer_focus

use crate::geometry::{CameraModel, RayGrid};
use depth_camera::Intrinsics;
use std::sync::Arc;

/// No lens is off by more than this share of a focal length. (What a first round tells may be twice too much, as other errors pass for it.)
const MAX_LONGER: f64 = 0.08;

/// The lens that the views of a scan agree with.
#[derive(Clone)]
pub(super) struct Lens {
    /// What it is said to be.
    said: Intrinsics,
    /// By what shares of themselves its focal lengths are longer, across and down.
    longer: [f64; 2],
    /// By it.
    rays: Arc<RayGrid>,
}

impl Lens {
    /// One with focal lengths longer by shares than they are said to be; `None` if no lens is so far off.
    pub(super) fn new(said: &Intrinsics, longer: [f64; 2]) -> Option<Self> {
        let camera = CameraModel::new(*said).with_longer_focus(longer);
        let is_one = longer.iter().all(|longer| longer.abs() <= MAX_LONGER);
        is_one.then(|| Lens {
            said: *said,
            longer,
            rays: Arc::new(RayGrid::new(camera)),
        })
    }

    /// One whose focal lengths are longer than this one's by further shares.
    pub(super) fn plus(&self, [across, down]: [f64; 2]) -> Option<Self> {
        let longer = |so_far: f64, by: f64| (1.0 + so_far) * (1.0 + by) - 1.0;
        let [x, y] = self.longer;
        Lens::new(&self.said, [longer(x, across), longer(y, down)])
    }

    /// The rays of its pixels.
    pub(super) fn rays(&self) -> &RayGrid {
        &self.rays
    }

    /// The camera with it.
    pub(super) fn intrinsics(&self) -> &Intrinsics {
        self.rays.camera().intrinsics()
    }

    /// By how much its focal lengths are longer than they are said to be, across and down, per cent.
    pub(super) fn longer_percent(&self) -> [f64; 2] {
        self.longer.map(|longer| 100.0 * longer)
    }

    /// What was put right, as a sentence for the operator.
    pub(super) fn put_right(&self) -> String {
        let than_said = |percent: f64| match percent > 0.0 {
            true => format!("{percent:.1} % longer"),
            false => format!("{:.1} % shorter", -percent),
        };
        let [across, down] = self.longer_percent().map(than_said);
        let (now, said) = (self.intrinsics(), &self.said);
        format!(
            "views of this scan agree with focal lengths {across} across and {down} down than the camera is said to have, and it was \
             fused with those: fx {:.1}, fy {:.1} pixels for {:.1} and {:.1}, which the `session.toml` of a recording may state",
            now.fx, now.fy, said.fx, said.fy
        )
    }
}
