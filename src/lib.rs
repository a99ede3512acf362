//! Relief: a hand-held Kinect scan in, a mesh with detail far below the depth sensor's noise out.
//!
//! The pipeline reads from top to bottom: [`geometry`], [`shading`] and [`robust`] are what everything is built on, then
//! capture → fusion → snapshot → refine → export. Only `pipeline` knows all the stages: [`control`] steers and shows them
//! by it, and lets [`jobs`] refine beside capture.
#![forbid(unsafe_code)]

pub mod atomic_file;
pub mod calibrate;
pub mod capture;
pub mod config;
pub mod control;
pub mod depth_correction;
pub mod devices;
pub mod evaluate;
pub mod export;
pub mod fusion;
pub mod geometry;
pub mod interreflection;
pub mod jobs;
pub mod lock;
pub mod multipath;
pub mod pipeline;
pub mod refine;
pub mod robust;
pub mod shading;
pub mod snapshot;
