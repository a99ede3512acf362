//! Multipath: light that reaches a time-of-flight sensor over a second surface, and makes the first one look farther away.
//!
//! A Kinect II measures the mean path of all light that a pixel receives. Near a table, in corners and folds a good part of
//! it has come over a neighbouring surface (Fuchs, *Multipath interference compensation in time-of-flight camera images*,
//! ICPR 2010; Jiménez et al., *Modelling and correction of multipath interference in time of flight cameras*, 2012). On the
//! recorded bust that is 12 mm at the foot and nothing on top of the head. One infrared image and its depth hold what is
//! needed to predict it: how bright every neighbour is as seen, and where it is (`bounce.rs`). Unknown is one number,
//! how bright a perfectly white surface would be ([`WhiteLevel`]): it belongs to the device, and shows itself in a scan by how
//! views of one place disagree ([`Evidence`]).
//!
//! Pure; a frame costs about a million pairs of patches. Not handled: more than one bounce in the *paths* (in the brightness
//! all bounces are contained), gloss, and surfaces that neither the image nor the table's plane shows.

mod bounce;
mod evidence;
mod params;
mod patches;
mod range_bias;
mod search;
mod support;

pub use evidence::{Evidence, Seen};
pub use params::MultipathParams;
pub use range_bias::RangeBias;
pub use search::WhiteSearch;

#[cfg(test)]
mod tests;

use crate::geometry::{CameraModel, RayGrid};
use crate::shading::{Calibration, NearLight};
use depth_camera::{CameraInfo, Frame, Image, LightKind, Sensor};
use evidence::evidence;
use nalgebra::{Point3, Vector3};
use patches::{Lit, PatchGrid};
use std::f64::consts::PI;

/// Linear intensity, as a share of full scale, that a perfectly white surface shows one metre before the light and facing it.
/// A constant of the device; the strength of multipath is its reciprocal.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
pub struct WhiteLevel(pub f64);

impl WhiteLevel {
    /// The white level of a strength of multipath; `None`, which is no multipath, unless it is positive.
    fn of_strength(strength: f64) -> Option<Self> {
        (strength > 0.0).then(|| WhiteLevel(1.0 / (PI * strength)))
    }
}

/// The strength of multipath, 1/(π white level); no white level is no multipath.
fn strength(white: Option<WhiteLevel>) -> f64 {
    white.map_or(0.0, |WhiteLevel(white)| 1.0 / (PI * white))
}

/// Albedo that the brightest surfaces of a scan are taken to have as long as nothing better is known: plaster, paper and
/// skin reflect 0.5 to 0.8 of near infrared.
const BRIGHT_ALBEDO: f64 = 0.6;
/// Those surfaces are the brightest 5 %: a few patches may be glossy.
const BRIGHT_QUANTILE: f64 = 0.95;

/// Predicts multipath from the frames of one camera.
#[derive(Clone, Debug)]
pub struct Multipath {
    grid: PatchGrid,
}

/// What a frame tells of its own multipath.
#[derive(Clone, Debug)]
pub struct Prediction {
    /// How far too long every range is, for any [`WhiteLevel`].
    pub bias: RangeBias,
    /// The white level if the frame's brightest surfaces are plaster.
    pub plausible_white: WhiteLevel,
}

impl Multipath {
    /// A predictor for a camera that measures time of flight and lights the scene itself; `None` for any other.
    pub fn new(info: &CameraInfo, calibration: &Calibration) -> Option<Self> {
        let (light, full_scale) = (info.light.as_ref()?, info.ir_full_scale?);
        let is_lit_flight = info.sensor == Sensor::Kinect2 && light.kind == LightKind::Emitter;
        let light: NearLight = calibration.light.near_light(light);
        let rays = RayGrid::new(CameraModel::new(info.intrinsics));
        is_lit_flight.then(|| Multipath {
            grid: PatchGrid::new(rays, light, full_scale, calibration),
        })
    }

    /// Predicts the multipath of a frame; `None` if it lacks an image or shows next to nothing.
    pub fn predict(&self, frame: &Frame) -> Option<Prediction> {
        let (depth, ir) = (frame.depth.as_ref()?, frame.ir.as_ref()?);
        let patches = self.grid.patches(depth, ir);
        let plausible_white = plausible_white(&patches)?;
        let beyond = support::beyond_the_image(&patches, &self.grid);
        let sources: Vec<Lit> = patches.iter().flatten().chain(&beyond).copied().collect();
        let bounces = bounce::bounces(&patches, &sources);
        Some(Prediction {
            bias: RangeBias::new(self.grid.cells(), &bounces),
            plausible_white,
        })
    }

    /// Compares the views of a scan that was fused with the multipath of `white`; `signed_distance` gives distance (m, positive
    /// outside) and gradient of the model at a point of the world. `None` where too little was seen.
    pub fn evidence(
        &self,
        views: &[Seen],
        white: Option<WhiteLevel>,
        signed_distance: impl Fn(&Point3<f64>) -> Option<(f64, Vector3<f64>)> + Sync,
    ) -> Option<Evidence> {
        evidence(views, self.grid.rays(), white, signed_distance)
    }

    /// A depth image (metres, 0 is none) with its bias changed from that of one white level to that of another; `None`
    /// stands for no multipath at all.
    pub fn corrected(
        &self,
        depth_m: &Image<f32>,
        bias: &RangeBias,
        from: Option<WhiteLevel>,
        to: Option<WhiteLevel>,
    ) -> Image<f32> {
        bias.corrected(depth_m, self.grid.rays(), from, to)
    }
}

/// The white level at which the bright patches have the albedo of plaster.
fn plausible_white(patches: &[Option<Lit>]) -> Option<WhiteLevel> {
    let mut reflected: Vec<f32> = patches
        .iter()
        .flatten()
        .map(|patch| patch.radiance / patch.direct)
        .collect();
    let index = (BRIGHT_QUANTILE * reflected.len() as f64) as usize;
    let (_, bright, _) = (index < reflected.len())
        .then(|| reflected.select_nth_unstable_by(index, f32::total_cmp))?;
    (*bright > 0.0).then(|| WhiteLevel(f64::from(*bright) / BRIGHT_ALBEDO))
}
