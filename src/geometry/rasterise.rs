//! A z-buffer rasteriser for meshes seen through the distorting camera.
//!
//! Triangles are a pixel or two wide, so that their edges are drawn straight between exactly projected corners.

use super::{CameraModel, Pose, TriMesh};
use depth_camera::Image;
use nalgebra::Vector2;

/// What a camera sees of a mesh, pixel by pixel.
#[derive(Clone, Debug)]
pub struct DepthBuffer {
    /// Depth along the optical axis, metres; infinity where nothing is seen.
    pub depth_m: Image<f32>,
    /// Index of the face seen; `u32::MAX` where there is none.
    pub face: Image<u32>,
}

/// Draws a mesh as seen from a camera; of two surfaces the nearer wins, of equals the one with the smaller face index.
///
/// Both sides of a face are drawn. Faces with a corner that does not project are left out.
pub fn rasterise(mesh: &TriMesh, camera: &CameraModel, camera_from_mesh: &Pose) -> DepthBuffer {
    let (width, height) = (camera.intrinsics().width, camera.intrinsics().height);
    let mut buffer = DepthBuffer {
        depth_m: Image::filled(width, height, f32::INFINITY),
        face: Image::filled(width, height, u32::MAX),
    };
    let camera_from_mesh = camera_from_mesh.to_homogeneous();
    let projected: Vec<Option<Corner>> = mesh
        .vertices
        .iter()
        .map(|vertex| {
            let point_camera = camera_from_mesh.transform_point(vertex);
            let pixel = camera.project(&point_camera)?;
            Some(Corner {
                pixel,
                inv_depth: 1.0 / point_camera.z,
            })
        })
        .collect();
    for (index, face) in mesh.faces.iter().enumerate() {
        let [Some(a), Some(b), Some(c)] = face.map(|vertex| projected[vertex as usize]) else {
            continue;
        };
        draw(&mut buffer, index as u32, [a, b, c]);
    }
    buffer
}

/// A corner of a face on the image.
#[derive(Clone, Copy)]
struct Corner {
    pixel: Vector2<f64>,
    /// 1/z, per metre.
    inv_depth: f64,
}

/// Draws one triangle; depth is interpolated as 1/z, which is linear on the image.
fn draw(buffer: &mut DepthBuffer, face: u32, corners: [Corner; 3]) {
    let [a, b, c] = corners.map(|corner| corner.pixel);
    let (width, height) = (buffer.depth_m.width(), buffer.depth_m.height());
    let low = a.inf(&b).inf(&c);
    let high = a.sup(&b).sup(&c);
    if high.x < 0.0 || high.y < 0.0 {
        return;
    }
    let (u0, v0) = (first_from(low.x), first_from(low.y));
    let u1 = (high.x as usize).min(width - 1);
    let v1 = (high.y as usize).min(height - 1);
    // Most faces are smaller than a pixel and lie between their centres.
    if u0 > u1 || v0 > v1 {
        return;
    }
    let area = (b - a).perp(&(c - a));
    if area == 0.0 {
        return;
    }
    let per_area = 1.0 / area;
    // Barycentric weights are linear on the image: their values at the first pixel, and slopes.
    let first = Vector2::new(u0 as f64, v0 as f64);
    let weight = |p: &Vector2<f64>, q: &Vector2<f64>| {
        let along = (q - p) * per_area;
        ((p - first).perp(&(q - first)) * per_area, -along.y, along.x)
    };
    let (weight_a, weight_b) = (weight(&b, &c), weight(&c, &a));
    // 1/z is linear, too: that of the third corner, and how the others differ from it.
    let [inv_a, inv_b, inv_c] = corners.map(|corner| corner.inv_depth);
    let (inv_a, inv_b) = (inv_a - inv_c, inv_b - inv_c);
    for v in v0..v1 + 1 {
        let down = (v - v0) as f64;
        let [row_a, row_b] = [weight_a, weight_b].map(|(w, _, by_v)| w + by_v * down);
        let row = v * width + u0..v * width + u1 + 1;
        let depths = &mut buffer.depth_m.data_mut()[row.clone()];
        let faces = &mut buffer.face.data_mut()[row];
        for (right, (nearest, seen)) in depths.iter_mut().zip(faces).enumerate() {
            let right = right as f64;
            let (wa, wb) = (row_a + weight_a.1 * right, row_b + weight_b.1 * right);
            if wa < 0.0 || wb < 0.0 || wa + wb > 1.0 {
                continue;
            }
            let depth = (1.0 / (inv_c + wa * inv_a + wb * inv_b)) as f32;
            if depth < *nearest {
                (*nearest, *seen) = (depth, face);
            }
        }
    }
}

/// The first pixel centre at or after a coordinate: processors without SSE 4.1 have no instruction for `ceil`.
fn first_from(coordinate: f64) -> usize {
    let whole = coordinate.max(0.0) as usize;
    whole + usize::from((whole as f64) < coordinate)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::tests::distorted_camera;
    use nalgebra::Point3;

    #[test]
    fn a_slanted_plane_has_its_own_depth_at_every_pixel() {
        let n = 60;
        let at = |i: usize| (i as f64 / n as f64 - 0.5) * 1.2;
        let depth = |x: f64, y: f64| 1.0 + 0.3 * x - 0.2 * y;
        let mut mesh = TriMesh::default();
        for j in 0..=n {
            for i in 0..=n {
                mesh.vertices
                    .push(Point3::new(at(i), at(j), depth(at(i), at(j))));
            }
        }
        for j in 0..n {
            for i in 0..n {
                let v = (j * (n + 1) + i) as u32;
                let down = v + n as u32 + 1;
                mesh.faces
                    .extend([[v, down, v + 1], [v + 1, down, down + 1]]);
            }
        }
        let camera = distorted_camera();
        let buffer = rasterise(&mesh, &camera, &Pose::identity());
        let mut n_seen = 0;
        for v in (40..380).step_by(17) {
            for u in (60..450).step_by(13) {
                let ray = camera
                    .unproject(u as f64, v as f64)
                    .expect("inside the lens");
                let expected = 1.0 / (1.0 - 0.3 * ray.x + 0.2 * ray.y);
                let seen = *buffer.depth_m.at(u, v) as f64;
                if seen.is_finite() {
                    n_seen += 1;
                    // Straight edges between exactly projected corners of 20 mm faces: distortion bends by < 0.1 mm.
                    assert!((seen - expected).abs() < 1e-4, "{u} {v}: {seen} {expected}");
                }
            }
        }
        assert!(n_seen > 500);
    }
}
