//! The anchor of Eq. (8) as depth knows it: fused depth is off slowly, by a fraction of a millimetre over centimetres, and
//! wrong in the detail, which the sensor blurs. What it holds is therefore the mean displacement of a patch of the surface.

use crate::geometry::{TriMesh, cell_of, facing_side};
use nalgebra::Vector3;
use std::collections::BTreeMap;

/// A patch by the vertices that stand for it.
pub type Patch = Vec<u32>;

/// Vertices that stand for a patch at most: they couple with each other in the normal matrix, all pairs.
const MAX_VERTICES: usize = 20;

/// Cuts a mesh into patches of about `size_m`: the vertices that share a cell of a grid and the main axis of their normals.
pub fn cut(mesh: &TriMesh, normals: &[Vector3<f64>], size_m: f64) -> Vec<Patch> {
    let mut cells: BTreeMap<([i32; 3], usize), Patch> = BTreeMap::new();
    for (vertex, (point, normal)) in mesh.vertices.iter().zip(normals).enumerate() {
        let place = (cell_of(point, size_m), facing_side(normal));
        cells.entry(place).or_default().push(vertex as u32);
    }
    cells
        .into_values()
        .map(|all| {
            let stride = all.len().div_ceil(MAX_VERTICES);
            all.into_iter().step_by(stride).collect()
        })
        .collect()
}
