//! Points spread evenly over a mesh.

use crate::geometry::TriMesh;
use nalgebra::{Point3, Vector3};

/// A point of a surface with the normal interpolated there, unit length.
pub(super) type Oriented = (Point3<f64>, Vector3<f64>);

/// So many points in equal steps of area over the faces for which `keep` holds; within a face they follow the sequence of the
/// plastic number, whose first values fill a square evenly. No chance is in it.
pub(super) fn sample(
    mesh: &TriMesh,
    normals: &[Vector3<f64>],
    count: usize,
    keep: impl Fn(&[u32; 3]) -> bool,
) -> Vec<Oriented> {
    const STEPS: [f64; 2] = [0.754_877_666_246_693, 0.569_840_290_998_053];
    let faces: Vec<usize> = (0..mesh.faces.len())
        .filter(|&face| keep(&mesh.faces[face]))
        .collect();
    let areas = || faces.iter().map(|&face| mesh.face_normal(face).norm());
    let total: f64 = areas().sum();
    let mut samples = Vec::with_capacity(count);
    let mut passed = 0.0;
    for (&face, area) in faces.iter().zip(areas()) {
        passed += area;
        while samples.len() < count && (samples.len() as f64 + 0.5) * total <= passed * count as f64
        {
            let mut weights = STEPS.map(|step| (samples.len() as f64 * step).fract());
            if weights[0] + weights[1] > 1.0 {
                weights = weights.map(|weight| 1.0 - weight);
            }
            let weights = [1.0 - weights[0] - weights[1], weights[0], weights[1]];
            samples.push(interpolate(mesh, normals, face, &weights));
        }
    }
    samples
}

fn interpolate(
    mesh: &TriMesh,
    normals: &[Vector3<f64>],
    face: usize,
    weights: &[f64; 3],
) -> Oriented {
    let (mut point, mut normal) = (Vector3::zeros(), Vector3::zeros());
    for (&vertex, &weight) in mesh.faces[face].iter().zip(weights) {
        point += mesh.vertices[vertex as usize].coords * weight;
        normal += normals[vertex as usize] * weight;
    }
    let normal = normal.try_normalize(1e-12).unwrap_or_default();
    (Point3::from(point), normal)
}
