//! Refinement of the scanned mesh: detail far below the depth sensor's noise, from infrared shading.

pub mod remesh;
