//! What can be set about multipath.

use serde::{Deserialize, Serialize};

/// Whether depth is freed of multipath.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct MultipathParams {
    /// Whether the depth of a Kinect II is corrected.
    pub enabled: bool,
}

impl Default for MultipathParams {
    fn default() -> Self {
        MultipathParams { enabled: true }
    }
}
