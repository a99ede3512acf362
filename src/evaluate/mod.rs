//! Scoring against measured truth: the only module that is ever given it. Nothing that reconstructs imports this.

mod surface_error;
mod surface_samples;
mod trajectory;
mod truth;
mod weld;

pub use surface_error::{Cameras, SurfaceError, SurfaceErrorFailure, surface_error};
pub use trajectory::{PosePair, TrajectoryError, trajectory_error};
pub use truth::Truth;
