//! A z-buffer rasteriser for meshes seen through the distorting camera.
//!
//! Triangles are a pixel or two wide, so that their edges are drawn straight between exactly projected corners.

use super::{CameraModel, Pose, TriMesh};
use depth_camera::Image;
use nalgebra::Point3;
use pulp::{Arch, Simd, WithSimd};

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
    rasterise_by(Arch::new(), mesh, camera, camera_from_mesh)
}

fn rasterise_by(
    arch: Arch,
    mesh: &TriMesh,
    camera: &CameraModel,
    camera_from_mesh: &Pose,
) -> DepthBuffer {
    let (width, height) = (camera.intrinsics().width, camera.intrinsics().height);
    let camera_from_mesh = camera_from_mesh.to_homogeneous();
    let corner = |vertex: &Point3<f64>| {
        let point_camera = camera_from_mesh.transform_point(vertex);
        let pixel = camera.project(&point_camera);
        let [u, v] = pixel.map_or([f64::NAN; 2], Into::into);
        Corner {
            u,
            v,
            inv_depth: 1.0 / point_camera.z,
        }
    };
    // Rows are written a few pixels at a time, the last ones past the end.
    let n_padded = width * height + BESIDE;
    let mut canvas = Canvas {
        size: [width, height],
        depth_m: vec![f32::INFINITY; n_padded],
        face: vec![u32::MAX; n_padded],
    };
    arch.dispatch(DrawAll {
        canvas: &mut canvas,
        faces: &mesh.faces,
        corners: &mesh.vertices.iter().map(corner).collect::<Vec<_>>(),
    });
    let Canvas {
        mut depth_m,
        mut face,
        ..
    } = canvas;
    depth_m.truncate(width * height);
    face.truncate(width * height);
    DepthBuffer {
        depth_m: Image::from_vec(width, height, depth_m),
        face: Image::from_vec(width, height, face),
    }
}

/// A corner of a face on the image, pixels; not a number where it does not project.
#[derive(Clone, Copy)]
struct Corner {
    u: f64,
    v: f64,
    /// 1/z, per metre.
    inv_depth: f64,
}

/// A face reaches over its edges by so much of its weights, more than rounding moves them: no pixel is missed between two.
const EDGE: f32 = 1e-6;
/// Pixels of a row that are drawn together at most.
const BESIDE: usize = 16;
/// 0, 1, 2, ….
const STEPS: [f32; BESIDE] = {
    let mut steps = [0.0; BESIDE];
    let mut k = 0;
    while k < BESIDE {
        steps[k] = k as f32;
        k += 1;
    }
    steps
};

/// The buffers while they are drawn on, with [`BESIDE`] pixels to spare.
struct Canvas {
    size: [usize; 2],
    depth_m: Vec<f32>,
    face: Vec<u32>,
}

struct DrawAll<'a> {
    canvas: &'a mut Canvas,
    faces: &'a [[u32; 3]],
    corners: &'a [Corner],
}

impl WithSimd for DrawAll<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for (index, &[a, b, c]) in (0..).zip(self.faces) {
            let corner = |vertex: u32| &self.corners[vertex as usize];
            let corners = [corner(a), corner(b), corner(c)];
            self.canvas.draw(simd, index, corners);
        }
    }
}

impl Canvas {
    /// Draws one triangle; depth is interpolated as 1/z, which is linear on the image.
    #[inline(always)]
    fn draw<S: Simd>(&mut self, simd: S, face: u32, [a, b, c]: [&Corner; 3]) {
        let [width, height] = self.size;
        let (low_u, high_u) = (a.u.min(b.u).min(c.u), a.u.max(b.u).max(c.u));
        let (low_v, high_v) = (a.v.min(b.v).min(c.v), a.v.max(b.v).max(c.v));
        let (u0, v0) = (first_from(low_u), first_from(low_v));
        let u1 = (high_u as usize).min(width - 1);
        let v1 = (high_v as usize).min(height - 1);
        // Most faces are smaller than a pixel and lie between their centres.
        let is_beside = (high_u < 0.0) | (high_v < 0.0) | (u0 > u1) | (v0 > v1);
        // Not a number where a corner is not.
        let area = (b.u - a.u) * (c.v - a.v) - (b.v - a.v) * (c.u - a.u);
        let has_area = (area < 0.0) | (area > 0.0);
        if is_beside | !has_area {
            return;
        }
        let per_area = 1.0 / area;
        // Barycentric weights are linear on the image: their values at the first pixel, and slopes.
        let (u, v) = (u0 as f64, v0 as f64);
        let weight = |p: &Corner, q: &Corner| {
            let at_first = (p.u - u) * (q.v - v) - (p.v - v) * (q.u - u);
            [at_first, p.v - q.v, q.u - p.u].map(|twice_area| twice_area * per_area)
        };
        let (weight_a, weight_b) = (weight(b, c), weight(c, a));
        let splat = |value: f64| simd.splat_f32s(value as f32);
        let (slope_a, slope_b) = (splat(weight_a[1]), splat(weight_b[1]));
        // 1/z is linear, too: that of the third corner, and how the others differ from it.
        let inv_c = splat(c.inv_depth);
        let inv_a = splat(a.inv_depth - c.inv_depth);
        let inv_b = splat(b.inv_depth - c.inv_depth);
        let one = simd.splat_f32s(1.0);
        let (least, most) = (simd.splat_f32s(-EDGE), simd.splat_f32s(1.0 + EDGE));
        for row in v0..v1 + 1 {
            for first in (u0..u1 + 1).step_by(BESIDE) {
                let (right, down) = ((first - u0) as f64, (row - v0) as f64);
                let here =
                    |[at_first, by_u, by_v]: [f64; 3]| splat(at_first + by_u * right + by_v * down);
                let (first_a, first_b) = (here(weight_a), here(weight_b));
                let last = splat((u1 - first) as f64);
                let pixels = row * width + first..row * width + first + BESIDE;
                let (nearest, _) = S::as_mut_simd_f32s(&mut self.depth_m[pixels.clone()]);
                let (seen, _) = S::as_mut_simd_u32s(&mut self.face[pixels]);
                let n_registers = (u1 - first) / S::F32_LANES + 1;
                let (all_steps, _) = S::as_simd_f32s(&STEPS);
                let registers = nearest.iter_mut().zip(seen).zip(all_steps);
                for ((nearest, seen), &steps) in registers.take(n_registers) {
                    let wa = simd.add_f32s(first_a, simd.mul_f32s(slope_a, steps));
                    let wb = simd.add_f32s(first_b, simd.mul_f32s(slope_b, steps));
                    let of_both = simd.add_f32s(simd.mul_f32s(wa, inv_a), simd.mul_f32s(wb, inv_b));
                    let depth = simd.div_f32s(one, simd.add_f32s(inv_c, of_both));
                    let no_more = |a, b| simd.less_than_or_equal_f32s(a, b);
                    let is_in_a_and_b = simd.and_m32s(no_more(least, wa), no_more(least, wb));
                    let is_in_c = no_more(simd.add_f32s(wa, wb), most);
                    let is_within = simd.and_m32s(is_in_a_and_b, is_in_c);
                    let is_in_row = no_more(steps, last);
                    let is_nearer = simd.less_than_f32s(depth, *nearest);
                    let is_seen = simd.and_m32s(is_within, simd.and_m32s(is_in_row, is_nearer));
                    *nearest = simd.select_f32s(is_seen, depth, *nearest);
                    *seen = simd.select_u32s(is_seen, simd.splat_u32s(face), *seen);
                }
            }
        }
    }
}

/// The first pixel centre at or after a coordinate: processors without SSE 4.1 have no instruction for `ceil`.
#[inline(always)]
fn first_from(coordinate: f64) -> usize {
    let whole = coordinate.max(0.0) as usize;
    whole + usize::from((whole as f64) < coordinate)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::tests::distorted_camera;
    use crate::geometry::lanes::arch_levels;

    /// 1.2 m a side, of faces of 20 mm.
    fn slanted_plane() -> TriMesh {
        let n = 60;
        let at = |i: usize| (i as f64 / n as f64 - 0.5) * 1.2;
        let mut mesh = TriMesh::default();
        for j in 0..=n {
            for i in 0..=n {
                let (x, y) = (at(i), at(j));
                mesh.vertices.push(Point3::new(x, y, depth(x, y)));
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
        mesh
    }

    fn depth(x: f64, y: f64) -> f64 {
        1.0 + 0.3 * x - 0.2 * y
    }

    #[test]
    fn every_instruction_set_draws_the_same_and_no_pixel_is_missed() {
        let (mesh, camera) = (slanted_plane(), distorted_camera());
        let mut drawn: Vec<DepthBuffer> = Vec::new();
        for arch in arch_levels() {
            drawn.push(rasterise_by(arch, &mesh, &camera, &Pose::identity()));
        }
        let [first, others @ ..] = &drawn[..] else {
            panic!("there is always one");
        };
        let bits = |buffer: &DepthBuffer| -> Vec<u32> {
            let depths = buffer.depth_m.data().iter();
            depths.map(|depth| depth.to_bits()).collect()
        };
        for other in others {
            assert!(bits(first) == bits(other));
            assert!(first.face.data() == other.face.data());
        }
        let mut n_inside = 0;
        for v in 0..first.depth_m.height() {
            for u in 0..first.depth_m.width() {
                let Some(ray) = camera.unproject(u as f64, v as f64) else {
                    continue;
                };
                let on_plane = ray / (1.0 - 0.3 * ray.x + 0.2 * ray.y);
                if on_plane.amax() < 0.59 {
                    n_inside += 1;
                    assert!(first.depth_m.at(u, v).is_finite(), "a hole at {u}, {v}");
                }
            }
        }
        assert!(n_inside > 100_000, "{n_inside}");
    }

    #[test]
    fn a_slanted_plane_has_its_own_depth_at_every_pixel() {
        let mesh = slanted_plane();
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
