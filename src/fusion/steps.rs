//! The steps of a frame, and who is told of them.

use serde::Serialize;

/// A step of fusing one frame, in the order in which they happen (but for distances where the motion leads, which come first), and what it
/// costs: processor time on one thread in a busy hour, of a frame of `relief-k2` at 2 mm and of the desk at 5 mm with depth to 3 m, where a
/// whole frame takes 7.3 and 7.6 ms (30 November).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FusionStep {
    /// Clipping, pyramid, normals: 0.6 and 0.9 ms, by the pixels of the image.
    Preprocess,
    /// Casting the model from where the last frame was fused: 2.7 and 4.4 ms, by the pixels of the image reduced by 4 and by the steps of their
    /// rays. Only for a frame that does not lie where the camera's motion leads.
    Raycast,
    /// Alignment to the raycast model, for such a frame: 1.2 and 1.1 ms, by iterations over the images reduced by 8 and 4.
    Icp,
    /// Alignment to the signed distances: 1.9 and 2.0 ms, likewise; most of it is reading voxels.
    SdfAlignment,
    /// Comparing the frame's shape with the model's ([`Fit::held_share`](super::Fit::held_share)), finding the blocks in the truncation
    /// band and allocating new ones: 1.2 and 1.2 ms, by the surface in view in blocks.
    Allocate,
    /// Updating the voxels of these blocks: 2.9 and 1.7 ms, by how many of them have their turn; four times as many with voxels half as large.
    Integrate,
    /// Keeping the frame for closing loops and its place for finding back: 0.5 and 0.7 ms, by the pixels of the image.
    Remember,
}

impl FusionStep {
    /// All steps, in order.
    pub const ALL: [FusionStep; 7] = [
        FusionStep::Preprocess,
        FusionStep::Raycast,
        FusionStep::Icp,
        FusionStep::SdfAlignment,
        FusionStep::Allocate,
        FusionStep::Integrate,
        FusionStep::Remember,
    ];
}

/// Is told of each step of a frame when it ends: a caller that has a clock measures them, fusion itself has none.
pub type OnStep<'a> = dyn FnMut(FusionStep) + 'a;
