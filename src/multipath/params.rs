//! What can be set about multipath.

use serde::{Deserialize, Serialize};

/// Whether and how depth is freed of multipath.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct MultipathParams {
    /// Whether the depth of a Kinect II is corrected.
    pub enabled: bool,
    /// How often a scan may be fused again at its end because its views agree better with another strength; 0 leaves what is
    /// plausible from its brightness.
    pub max_revisions: usize,
}

impl Default for MultipathParams {
    fn default() -> Self {
        MultipathParams {
            enabled: true,
            max_revisions: 2,
        }
    }
}

impl MultipathParams {
    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        match self.max_revisions {
            0..=10 => Ok(()),
            more => Err(format!(
                "multipath.max_revisions is {more}, must be 0 to 10"
            )),
        }
    }
}
