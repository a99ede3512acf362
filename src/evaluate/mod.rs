//! Scoring against measured truth: the only module that is ever given it. Nothing that reconstructs imports this.

mod trajectory;

pub use trajectory::{PosePair, TrajectoryError, trajectory_error};
