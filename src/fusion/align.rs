//! One frame against the model: coarsely to the raycast, finely to the distances, and where these let it slide to the images.

use super::degeneracy::Degeneracy;
use super::eye::Eye;
use super::infrared::Infrared;
use super::normal_equations::NormalEquations;
use super::volume::TsdfVolume;
use super::{Fit, FusionParams, FusionStep, MODEL_LEVEL, OnStep, gates, icp, sdf_alignment};
use crate::geometry::Pose;

/// Levers this long weigh angles against lengths in [`Fit::conditioning`], metres: an object at arm's length.
pub const SIZE_M: f64 = 0.5;

/// A frame as it was aligned.
pub struct AlignedPose {
    /// World from camera.
    pub pose: Pose,
    /// What the signed distances say there.
    pub equations: NormalEquations,
    /// As of [`Fit::conditioning`].
    pub conditioning: f64,
}

/// What holds the camera where the geometry of the frames before let it slide.
#[derive(Clone, Copy)]
pub struct Holding<'a> {
    /// Where that is.
    pub degeneracy: &'a Degeneracy,
    /// The images.
    pub infrared: &'a Infrared,
}

/// Aligns the frame in hand to the raycast model, then to the signed distances, and where these let it slide to the infrared
/// images; `None` where nothing matches at all.
pub fn align(
    eye: &Eye,
    model: &icp::CastModel,
    volume: &TsdfVolume,
    guess: &Pose,
    params: &FusionParams,
    holding: Option<Holding>,
    on_step: &mut OnStep,
) -> Option<(Pose, Fit)> {
    let (arch, noise, icp) = (eye.arch, &eye.noise, &params.icp);
    let pose = icp::align(arch, &eye.frame, model, guess, noise, icp)?;
    on_step(FusionStep::Icp);
    let levels = &eye.frame.reduced;
    let (pose, equations) =
        sdf_alignment::align(arch, levels, volume, &pose, noise, icp.sdf_iterations)?;
    let aligned = AlignedPose {
        pose,
        conditioning: equations.conditioning(SIZE_M),
        equations,
    };
    let held = holding.and_then(|by| by.infrared.hold(eye, volume, by.degeneracy, &aligned));
    let AlignedPose {
        pose,
        equations,
        conditioning,
    } = held.unwrap_or(aligned);
    let level = eye.level(MODEL_LEVEL);
    let mut fit = Fit {
        inlier_share: equations.n_inliers as f64 / equations.n_points.max(1) as f64,
        rmse_m: equations.rmse_m(),
        conditioning,
        see_through_share: icp::see_through_share(level, model, &pose, volume.voxel_size_m()),
        // Told of the frames up to this one, if it is accepted.
        held_share: 1.0,
        fitness: 0.0,
    };
    fit.fitness = gates::fitness(&fit, &eye.frame, noise, params);
    Some((pose, fit))
}
