//! What a view shows of a mesh, integrated over its pixels as the sensor does it.
//!
//! A prediction sampled at pixel centres prefers surfaces that are too smooth, since the image is blurred by the pixels and
//! the prediction is not. Here every pixel is the mean of the facets under it.

use super::gaze::Gaze;
use super::sites::Sites;
use super::view::View;
use crate::geometry::{TriMesh, rasterise};
use depth_camera::Image;

/// Samples a pixel along each axis.
const SAMPLES: usize = 2;

/// Linear intensity that a view would show, NaN where a pixel is not wholly covered by facets that it sees. `sites` are the
/// mesh's and `index` is the view's number in them.
pub fn render(
    view: &View,
    mesh: &TriMesh,
    (sites, index): (&Sites, usize),
    albedo: &[f64],
) -> Image<f32> {
    let mut by_face = vec![f32::NAN; mesh.faces.len()];
    let faces = sites.faces_of(index);
    let points = faces.iter().map(|&face| &sites.points[face as usize]);
    Gaze::new(view).each(points, |index, look| {
        let face = faces[index] as usize;
        let normal_camera = view.camera_from_world * sites.normals[face];
        if let Some(unit) = view.unit_prediction(look, &normal_camera) {
            by_face[face] = (albedo[face] * unit) as f32;
        }
    });
    let samples = rasterise(mesh, &view.camera().finer(SAMPLES), &view.camera_from_world).face;
    let sample = |u: usize, v: usize| {
        let face = *samples.at(u, v) as usize;
        by_face.get(face).copied().unwrap_or(f32::NAN)
    };
    let (width, height) = (samples.width() / SAMPLES, samples.height() / SAMPLES);
    let pixel = |u: usize, v: usize| {
        let sum: f32 = (0..SAMPLES * SAMPLES)
            .map(|k| sample(u * SAMPLES + k % SAMPLES, v * SAMPLES + k / SAMPLES))
            .sum();
        sum / (SAMPLES * SAMPLES) as f32
    };
    let pixels = (0..width * height).map(|k| pixel(k % width, k / width));
    Image::from_vec(width, height, pixels.collect())
}
