//! Why a surface was not refined, or a refined one is not delivered.

use super::MAX_VIEWS;
use super::held_out::HeldOut;
use super::materials::Swallowed;

/// Above this share of the mean intensity the light model does not explain the images: 0.02 to 0.19 where the calibration
/// fits, 0.71 on a recording with a foreign calibration and textured albedo.
pub const MAX_BELIEVABLE_RMSE: f64 = 0.4;
/// An object may have this share of edges with more than two faces; arbitrary.
pub const MAX_NON_MANIFOLD_SHARE: f64 = 0.01;

/// Why nothing was refined, or what was refined is not delivered; the figures stand in the text.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RefineError {
    /// The object's mesh is empty, or a crumb.
    #[error("no surface of the object is left to refine")]
    NoSurface,
    /// Faces meet in ways that no surface does.
    #[error(
        "the object is no surface: {n_edges} of its {of} edges have more than two faces, at most {:.0} % may",
        100.0 * MAX_NON_MANIFOLD_SHARE
    )]
    NotManifold {
        /// Edges with more than two faces.
        n_edges: usize,
        /// All edges.
        of: usize,
    },
    /// No view saw anything of the object.
    #[error("none of the {n_views} shading images sees the object well enough")]
    NothingVisible {
        /// How many images there were.
        n_views: usize,
    },
    /// The object is white in all views.
    #[error(
        "the object is saturated in {n_saturated} of {n_views} shading images; go farther away"
    )]
    Saturated {
        /// Images in which most of the object is saturated.
        n_saturated: usize,
        /// How many images there were.
        n_views: usize,
    },
    /// Too many views.
    #[error("{n_views} shading images given, at most {MAX_VIEWS} can be used")]
    TooManyViews {
        /// How many images there were.
        n_views: usize,
    },
    /// The solver's pattern did not fit into memory.
    #[error("not enough memory for the solver")]
    OutOfMemory,
    /// The images cannot be explained.
    #[error(
        "the images contradict the calibration, {:.0} % of their mean intensity remains unexplained (at most {:.0} % can be \
         believed): gamma or light is wrong, or the surface has many albedos; the base mesh stands",
        100.0 * rmse, 100.0 * MAX_BELIEVABLE_RMSE
    )]
    Contradicted {
        /// Root mean square of observed less rendered intensity, share of the mean.
        rmse: f64,
    },
    /// Several materials were given one label.
    #[error(
        "one label was given to materials of which one is {:.1} times as bright as another, the rarer on {:.0} % of the surface, and their \
         borders would come out as relief: refine.max_albedos has to be above 1 and refine.albedo.mode \"mixture\"; the base mesh stands",
        .0.contrast, 100.0 * .0.rarer_share
    )]
    OneLabel(Swallowed),
    /// Brightness changes over the images as the light model does not know it.
    #[error(
        "the images contradict the calibration, brightness differs slowly by {:.1} % from what the light would give (at most \
         {:.1} %, by refine.trust.max_slow_gain and what of the light is indirect): gamma or light is wrong; the base mesh stands",
        100.0 * slow_gain, 100.0 * limit
    )]
    SlowlyContradicted {
        /// Root mean square of the gains less 1.
        slow_gain: f64,
        /// Its bound.
        limit: f64,
    },
    /// Images that refinement did not use fit the base surface better.
    #[error(
        "the refined surface explains the images held out from it worse than the base surface, which stands: unexplained is {:.1} % of the \
         mean intensity ({:.1} % by the base surface), and {:.1} % of its gradient ({:.1} %)",
        100.0 * .0.refined.intensity, 100.0 * .0.base.intensity, 100.0 * .0.refined.gradient, 100.0 * .0.base.gradient
    )]
    WorseThanBase(HeldOut),
}
