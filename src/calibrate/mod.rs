//! Measuring what `config/` only assumes of a sensor: pure estimators, images in, figures with their intervals out.

mod depth_edges;
mod edge_match;
mod offset;

pub use offset::{ImageOffset, OffsetError, OffsetEstimate, combine_offsets, image_offset};
