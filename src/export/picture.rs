//! Shaded pictures of a mesh, for the report: one grey material under two lights that stand still beside the camera.
//!
//! Shading is computed in linear light, once for each face that 2 × 2 samples of a pixel meet, and averaged over them before it is
//! encoded as sRGB. Shadows, albedo and transparency are not drawn: the picture is to show shape.

use super::{
    PhongParams, PictureView,
    material::{Look, linear_from_srgb, shade, srgb_from_linear},
};
use crate::geometry::{CameraModel, DepthBuffer, TriMesh, area_vector, rasterise};
use depth_camera::Image;
use nalgebra::{Point3, Vector2, Vector3};
use rayon::prelude::*;

/// Samples a pixel along each axis.
const SAMPLES: usize = 2;
/// How much darker the inside of an open surface is drawn.
const INSIDE: f64 = 0.45;

/// Draws a mesh, given one normal a vertex in the mesh's frame.
///
/// The inside of the surface is drawn darker. Where a vertex normal is zero, the face's own is taken.
///
/// # Panics
/// If there are fewer normals than vertices, or a face names a vertex that does not exist.
pub fn phong(
    mesh: &TriMesh,
    normals: &[Vector3<f64>],
    view: &PictureView,
    params: &PhongParams,
) -> Image<[u8; 3]> {
    assert!(
        normals.len() >= mesh.vertices.len(),
        "every vertex needs a normal"
    );
    let camera = view.camera.finer(SAMPLES);
    let camera_from_mesh = view.world_from_camera.inverse();
    let motion = camera_from_mesh.to_homogeneous();
    let scene = Scene {
        faces: &mesh.faces,
        vertices: (mesh.vertices.iter())
            .map(|vertex| motion.transform_point(vertex))
            .collect(),
        normals: (normals.iter())
            .map(|normal| motion.transform_vector(normal))
            .collect(),
        buffer: rasterise(mesh, &camera, &camera_from_mesh),
        camera,
    };
    let (width, height) = (
        view.camera.intrinsics().width,
        view.camera.intrinsics().height,
    );
    let pixels = (0..width * height)
        .into_par_iter()
        .map(|pixel| scene.pixel(pixel % width, pixel / width, params))
        .collect();
    Image::from_vec(width, height, pixels)
}

/// All that shading one sample needs, in the camera frame.
struct Scene<'a> {
    faces: &'a [[u32; 3]],
    vertices: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
    buffer: DepthBuffer,
    camera: CameraModel,
}

impl Scene<'_> {
    /// Mean of the samples of a pixel, encoded. Each face is shaded once, in the middle of its samples, and all are looked at along the
    /// ray of the pixel's own middle.
    fn pixel(&self, u: usize, v: usize, params: &PhongParams) -> [u8; 3] {
        const N: usize = SAMPLES * SAMPLES;
        const MIDDLE: f64 = (SAMPLES - 1) as f64 / 2.0;
        let (first_u, first_v) = (u * SAMPLES, v * SAMPLES);
        let places: [_; N] =
            std::array::from_fn(|k| [first_u + k % SAMPLES, first_v + k / SAMPLES]);
        let faces = places.map(|[u, v]| *self.buffer.face.at(u, v));
        if faces == [u32::MAX; N] {
            return params.background;
        }
        let ray = self
            .camera
            .unproject(first_u as f64 + MIDDLE, first_v as f64 + MIDDLE);
        let Some(look) = ray.and_then(|ray| Look::along(&ray.push(1.0))) else {
            return params.background;
        };
        let (mut grey, mut n_covered) = (0.0, 0);
        for (first, &face) in faces.iter().enumerate() {
            if face == u32::MAX || faces[..first].contains(&face) {
                continue;
            }
            let (mut n, mut depth_m, mut at) = (0, 0.0, Vector2::zeros());
            for (&[u, v], _) in places.iter().zip(&faces).filter(|&(_, &of)| of == face) {
                n += 1;
                depth_m += f64::from(*self.buffer.depth_m.at(u, v));
                at += Vector2::new(u as f64, v as f64);
            }
            let (at, depth_m) = (at / f64::from(n), depth_m / f64::from(n));
            let ray = self.camera.unproject(at.x, at.y);
            let brightness =
                ray.and_then(|ray| self.brightness(face, &ray, depth_m, &look, params));
            if let Some(brightness) = brightness {
                grey += f64::from(n) * brightness;
                n_covered += n as usize;
            }
        }
        match n_covered {
            0 => params.background,
            N => [srgb_from_linear(grey / N as f64); 3],
            _ => params.background.map(|code| {
                let behind = (N - n_covered) as f64 * linear_from_srgb(code);
                srgb_from_linear((grey + behind) / N as f64)
            }),
        }
    }

    /// Linear brightness of a face at a depth (m) along a ray; `None` where the surface has no normal.
    fn brightness(
        &self,
        face: u32,
        ray: &Vector2<f64>,
        depth_m: f64,
        look: &Look,
        params: &PhongParams,
    ) -> Option<f64> {
        let face = face as usize;
        let corners = self.faces[face].map(|vertex| self.vertices[vertex as usize]);
        let face_normal = area_vector(corners);
        let normal = if params.flat {
            face_normal
        } else {
            let point = Point3::from(ray.push(1.0) * depth_m);
            let smooth = self.smooth_normal(face, &corners, &point, &face_normal);
            match smooth.norm_squared() > 0.0 {
                true => smooth,
                false => face_normal,
            }
        };
        let outside = face_normal.dot(&look.towards_camera) >= 0.0;
        let normal = normal.try_normalize(0.0)? * if outside { 1.0 } else { -1.0 };
        let brightness = shade(&normal, look, params);
        Some(brightness * if outside { 1.0 } else { INSIDE })
    }

    /// The vertex normals interpolated at a point of a face, of any length; zero if they cancel.
    fn smooth_normal(
        &self,
        face: usize,
        corners: &[Point3<f64>; 3],
        point: &Point3<f64>,
        twice_area: &Vector3<f64>,
    ) -> Vector3<f64> {
        let [a, b, c] = corners.map(|corner| corner - point);
        // Signed areas opposite to each corner; beyond an edge by rounding means on it.
        let area = |p: &Vector3<f64>, q: &Vector3<f64>| p.cross(q).dot(twice_area).max(0.0);
        let weights = [area(&b, &c), area(&c, &a), area(&a, &b)];
        let vertices = self.faces[face];
        (0..3)
            .map(|k| self.normals[vertices[k] as usize] * weights[k])
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::super::{MeanView, PictureSize, tests::bumpy_sphere, three_views};
    use super::*;

    const SIZE: PictureSize = PictureSize {
        width: 80,
        height: 60,
    };

    #[test]
    fn a_sphere_is_round_bright_at_the_upper_left_and_on_white() {
        let mesh = bumpy_sphere(48);
        let [front, ..] = three_views(&mesh, &MeanView::from_poses(&[]), SIZE).unwrap();
        let picture = phong(
            &mesh,
            &mesh.vertex_normals(),
            &front,
            &PhongParams::default(),
        );
        let grey = |u: usize, v: usize| picture.at(u, v)[0];
        assert_eq!((grey(0, 0), grey(79, 59)), (255, 255));
        assert!(
            grey(28, 18) > grey(52, 42) && grey(28, 18) < 250,
            "{} {}",
            grey(28, 18),
            grey(52, 42)
        );
        let n_covered = picture.data().iter().filter(|p| p[0] < 255).count() as f64;
        // The sphere fills the shorter side but for the margin and 6 % bumps.
        let disc = std::f64::consts::PI * 30.0 * 30.0;
        assert!(
            n_covered / disc > 0.85 && n_covered / disc < 1.0,
            "{}",
            n_covered / disc
        );
    }

    #[test]
    fn flat_shading_differs_and_the_inside_is_darker() {
        let mesh = bumpy_sphere(12);
        let [front, ..] = three_views(&mesh, &MeanView::from_poses(&[]), SIZE).unwrap();
        let (smooth, flat) = (
            PhongParams::default(),
            PhongParams {
                flat: true,
                ..PhongParams::default()
            },
        );
        let normals = mesh.vertex_normals();
        assert_ne!(
            phong(&mesh, &normals, &front, &smooth),
            phong(&mesh, &normals, &front, &flat)
        );
        let mut inverted = mesh.clone();
        inverted.faces.iter_mut().for_each(|face| face.swap(0, 1));
        let inside = phong(&inverted, &inverted.vertex_normals(), &front, &smooth);
        let outside = phong(&mesh, &normals, &front, &smooth);
        assert!(inside.at(40, 30)[0] < outside.at(40, 30)[0] - 20);
    }
}
