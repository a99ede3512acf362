//! Numbers on a surface, drawn from one side.

use super::PictureView;
use crate::geometry::{TriMesh, rasterise};
use depth_camera::Image;

/// What one sees of a surface from one side, to draw numbers on.
pub struct SeenSurface<'a> {
    mesh: &'a TriMesh,
    /// The face seen at each pixel.
    faces: Image<u32>,
}

impl<'a> SeenSurface<'a> {
    /// Looks at a surface.
    pub fn new(mesh: &'a TriMesh, view: &PictureView) -> Self {
        let seen = rasterise(mesh, &view.camera, &view.world_from_camera.inverse());
        SeenSurface {
            mesh,
            faces: seen.face,
        }
    }

    /// Draws one number a vertex: of each pixel the mean over the corners of the face seen there, NaN where there is none.
    ///
    /// # Panics
    /// If there are fewer values than vertices.
    pub fn draw(&self, values: &[f64]) -> Image<f32> {
        let faces = &self.mesh.faces;
        self.faces.map(|&face| match faces.get(face as usize) {
            Some(corners) => {
                let sum: f64 = corners.iter().map(|&vertex| values[vertex as usize]).sum();
                (sum / 3.0) as f32
            }
            None => f32::NAN,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::{MeanView, PictureSize, tests::bumpy_sphere, three_views};
    use super::*;

    #[test]
    fn a_field_has_its_numbers_on_the_surface_alone() {
        let mesh = bumpy_sphere(24);
        let size = PictureSize {
            width: 40,
            height: 30,
        };
        let [front, ..] = three_views(&mesh, &MeanView::from_poses(&[]), size).unwrap();
        let heights: Vec<f64> = mesh.vertices.iter().map(|vertex| -vertex.y).collect();
        let field = SeenSurface::new(&mesh, &front).draw(&heights);
        assert!(field.at(0, 0).is_nan());
        // The upper half is above the lower one.
        assert!(*field.at(20, 8) > 0.03 && *field.at(20, 22) < -0.03);
    }
}
