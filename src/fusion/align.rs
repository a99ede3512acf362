//! One frame against the model: coarsely to the raycast, finely to the distances, and where these let it slide to the images.

use super::degeneracy::{CommonShape, Degeneracy};
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

/// What is known beside the model.
#[derive(Clone, Copy, Default)]
pub struct Beside<'a> {
    /// What the frames before had in common with it.
    pub common: Option<&'a CommonShape>,
    /// The images.
    pub infrared: Option<&'a Infrared>,
}

/// Aligns the frame in hand to the raycast model, then to the signed distances, and where these let it slide to the infrared
/// images; `None` where nothing matches at all.
pub fn align(
    eye: &Eye,
    model: &icp::CastModel,
    volume: &TsdfVolume,
    guess: &Pose,
    params: &FusionParams,
    beside: Beside,
    on_step: &mut OnStep,
) -> Option<(Pose, Fit)> {
    let (arch, noise, icp) = (eye.arch, &eye.noise, &params.icp);
    let pose = icp::align(arch, &eye.frame, model, guess, noise, icp)?;
    on_step(FusionStep::Icp);
    let levels = &eye.frame.reduced;
    let (pose, equations) =
        sdf_alignment::align(arch, levels, volume, &pose, noise, icp.sdf_iterations)?;
    let degeneracy = Degeneracy::of(eye, beside.common, &pose)?;
    let aligned = AlignedPose::new(pose, equations);
    let infrared = beside.infrared;
    let held = infrared.and_then(|images| images.hold(eye, volume, &degeneracy, &aligned));
    let aligned = held.unwrap_or(aligned);
    let level = eye.level(MODEL_LEVEL);
    let see_through_share =
        icp::see_through_share(level, model, &aligned.pose, volume.voxel_size_m());
    on_step(FusionStep::SdfAlignment);
    let fit = aligned.fit(eye, params, see_through_share, &degeneracy);
    Some((aligned.pose, fit))
}

impl AlignedPose {
    /// Where distances alone have led.
    pub fn new(pose: Pose, equations: NormalEquations) -> Self {
        AlignedPose {
            pose,
            conditioning: equations.conditioning(SIZE_M),
            equations,
        }
    }

    /// How well the frame in hand fits there.
    pub fn fit(
        &self,
        eye: &Eye,
        params: &FusionParams,
        see_through_share: f64,
        degeneracy: &Degeneracy,
    ) -> Fit {
        let AlignedPose {
            equations,
            conditioning,
            ..
        } = self;
        let mut fit = Fit {
            inlier_share: equations.inlier_share(),
            rmse_m: equations.rmse_m(),
            conditioning: *conditioning,
            see_through_share,
            held_share: degeneracy.least_share,
            fitness: 0.0,
        };
        fit.fitness = gates::fitness(&fit, &eye.frame, &eye.noise, params);
        fit
    }
}
