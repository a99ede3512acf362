//! The steps of a frame, and who is told of them.

use serde::Serialize;

/// A step of fusing one frame, in the order in which they happen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FusionStep {
    /// Clipping, pyramid, normals.
    Preprocess,
    /// Alignment to the raycast model.
    Icp,
    /// Alignment to the signed distances.
    SdfAlignment,
    /// Comparing the frame's shape with the model's ([`Fit::held_share`](super::Fit::held_share)), finding the blocks in the truncation
    /// band and allocating new ones.
    Allocate,
    /// Updating the voxels of these blocks.
    Integrate,
    /// Casting the model for the next frame.
    Raycast,
    /// Keeping the frame for closing loops and its place for finding back.
    Remember,
}

impl FusionStep {
    /// All steps, in order.
    pub const ALL: [FusionStep; 7] = [
        FusionStep::Preprocess,
        FusionStep::Icp,
        FusionStep::SdfAlignment,
        FusionStep::Allocate,
        FusionStep::Integrate,
        FusionStep::Raycast,
        FusionStep::Remember,
    ];
}

/// Is told of each step of a frame when it ends: a caller that has a clock measures them, fusion itself has none.
pub type OnStep<'a> = dyn FnMut(FusionStep) + 'a;
