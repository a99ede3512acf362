//! Poses, the camera model, triangle meshes, closest points on them and the z-buffer rasteriser: everything that knows
//! shape but not light.
//!
//! Frames of reference: `world` (first camera pose, or that of given poses), `camera` (IR camera: x right, y down, z
//! forward), `light`, and `pixel` (u right, v down, centres at integers). Transforms are `target_from_source` and chain by
//! adjacent names.

mod bilinear;
mod bvh;
pub(crate) mod camera;
mod cells;
mod clustering;
mod disjoint_sets;
pub mod lanes;
mod lens;
mod lists;
mod manifold;
mod mesh;
mod motion_equations;
mod patch;
mod plane;
mod point_grid;
mod pose;
mod range_error;
mod rasterise;
mod rigid;
mod tangents;
mod triangle;
mod watertight;

pub use bilinear::{Bilinear, bilinear};
pub use bvh::{ClosestPoint, TriangleBvh};
pub use camera::{CameraModel, RayGrid};
pub use cells::CellGrid;
pub use clustering::{Clustering, cluster_vertices, coarsened};
pub use lens::{Lens, LocalLens, Projected};
pub(crate) use lists::Lists;
pub use manifold::{Manifold, border_loops, cut_to_manifold};
pub use mesh::{
    EdgeAdjacency, MIN_PART_AREA_M2, TriMesh, area_vector, facing_side, label_of_most_corners,
};
pub use motion_equations::MotionEquations;
pub use patch::{DepthPatch, PixelSquare};
pub use plane::Plane;
pub use point_grid::{PointGrid, cell_of};
pub use pose::{
    Motion, Pose, between, increment, increment_about, increment_of, mean_pose, motion_between,
    of_unit_length, path_length_m, point_to_plane_row,
};
pub use range_error::RangeError;
pub use rasterise::{DepthBuffer, rasterise};
pub use rigid::Rigid;
pub use tangents::tangents;
pub use watertight::{Watertight, close_holes};
