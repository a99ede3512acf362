//! Says what a recording or bag is of, from its first seconds, without changing it.

use std::path::Path;

use depth_camera::{CameraError, CameraInfo};
use replay::DepthScale;

use crate::{folder, plan};

/// What is read of a recording or bag.
#[derive(Clone, Debug, PartialEq)]
pub struct Description {
    /// The camera.
    pub info: CameraInfo,
    /// How its 16-bit depth is stored.
    pub depth_scale: DepthScale,
    /// The topics that images are read from, depth first.
    pub topics: Vec<String>,
}

/// Looks at a recording's folder, one of its files, or a bag.
///
/// # Errors
/// [`CameraError::Invalid`] naming file, topic, value and bound.
pub fn describe(path: &Path) -> Result<Description, CameraError> {
    let plan = plan::find(path, &folder::files(path)?)?;
    Ok(Description {
        info: plan.info,
        depth_scale: plan.depth_scale,
        topics: [Some(plan.depth_topic), plan.infrared_topic]
            .into_iter()
            .flatten()
            .collect(),
    })
}
