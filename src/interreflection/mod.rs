//! Light that surfaces send one another, from one infrared image with its depth.
//!
//! One image holds what is needed to predict it: how bright every neighbour is as seen, all bounces included, and where it is;
//! the plane that things stand on goes on beyond the image ([`LitScene`]). Unknown is one number, how bright a perfectly white
//! surface would be ([`WhiteLevel`]): it turns the brightness of a neighbour into the share of light that it sends on. Depth of
//! a time-of-flight sensor suffers from that light (`multipath`), and so does shading ([`IndirectLight`]).
//!
//! Pure. Not handled: gloss, surfaces that neither the image nor the table's plane shows, and what stands between two patches.

mod indirect_light;
mod patches;
mod receivers;
mod sources;
mod support;

pub use indirect_light::IndirectLight;
pub use patches::{Lit, PatchGrid, Radiances};
pub use receivers::{Receiver, receivers};
pub use sources::{Sources, Way};

use crate::robust::{median, quantile};
use depth_camera::Image;
use std::f64::consts::PI;

/// Linear intensity, as a share of full scale, that a perfectly white surface shows one metre before the light and facing it.
/// A constant of the device; the strength of interreflection is its reciprocal.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
pub struct WhiteLevel(pub f64);

impl WhiteLevel {
    /// The white level of a strength of interreflection; `None`, which is no interreflection, unless it is positive.
    pub fn of_strength(strength: f64) -> Option<Self> {
        (strength > 0.0).then(|| WhiteLevel(1.0 / (PI * strength)))
    }

    /// The strength of interreflection, 1/(π white level): light sent on for each unit of brightness, area and solid angle.
    pub fn strength(self) -> f64 {
        1.0 / (PI * self.0)
    }

    /// The median of what is plausible for each image of a scan, which has one light; `None` of none.
    pub fn of_one_light(plausible: Vec<WhiteLevel>) -> Option<Self> {
        let plausible = plausible.into_iter();
        let mut plausible: Vec<f64> = plausible.map(|WhiteLevel(white)| white).collect();
        median(&mut plausible).map(WhiteLevel)
    }
}

/// Albedo that the brightest surfaces of a scan are taken to have as long as nothing better is known: plaster, paper and
/// skin reflect 0.5 to 0.8 of near infrared.
const BRIGHT_ALBEDO: f64 = 0.6;
/// Those surfaces are the brightest 5 %: a few patches may be glossy.
const BRIGHT_QUANTILE: f64 = 0.95;

/// The surfaces that an image shows, as patches that light one another, camera frame.
#[derive(Clone, Debug)]
pub struct LitScene {
    patches: Vec<Option<Lit>>,
    beyond: Vec<Lit>,
}

impl LitScene {
    /// Cuts a depth image (metres, 0 is none) and its infrared image (counts) into patches.
    pub fn new<T>(grid: &PatchGrid, depth_m: &Image<f32>, ir_counts: &Image<T>) -> Self
    where
        T: Copy + Into<f64> + Send + Sync,
    {
        Self::of_radiances(grid, depth_m, &grid.patch_radiances(depth_m, ir_counts))
    }

    /// Cuts a depth image (metres, 0 is none) into patches whose [`PatchGrid::patch_radiances`] are known.
    pub fn of_radiances(grid: &PatchGrid, depth_m: &Image<f32>, radiances: &[f32]) -> Self {
        let patches = grid.patches(depth_m, radiances);
        let beyond = support::beyond_the_image(&patches, grid);
        LitScene { patches, beyond }
    }

    /// The patches of the image, row by row; `None` where depth is missing or holds an edge.
    pub fn patches(&self) -> &[Option<Lit>] {
        &self.patches
    }

    /// All that sends light: the patches of the image, and those of the plane beyond it.
    pub fn sources(&self) -> Sources {
        let seen = self.patches.iter().flatten();
        Sources::new(seen.chain(&self.beyond))
    }

    /// The white level at which the bright patches have the albedo of plaster; `None` where next to nothing is seen.
    pub fn plausible_white(&self) -> Option<WhiteLevel> {
        let seen = self.patches.iter().flatten();
        let reflected = seen.map(|patch| f64::from(patch.radiance / patch.direct));
        let bright = quantile(&mut reflected.collect::<Vec<_>>(), BRIGHT_QUANTILE)?;
        (bright > 0.0).then(|| WhiteLevel(bright / BRIGHT_ALBEDO))
    }
}
