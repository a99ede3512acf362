//! Numbers on a surface, drawn from one side.

use super::PictureView;
use crate::geometry::{TriMesh, label_of_most_corners, rasterise};
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
        self.draw_faces(|corners| {
            let sum: f64 = corners.map(|vertex| values[vertex as usize]).iter().sum();
            (sum / 3.0) as f32
        })
    }

    /// Draws one label a vertex: of each pixel [that of most corners](label_of_most_corners) of the face seen there, NaN where there is
    /// none.
    ///
    /// # Panics
    /// If there are fewer labels than vertices.
    pub fn draw_labels(&self, labels: &[u8]) -> Image<f32> {
        self.draw_faces(|corners| f32::from(label_of_most_corners(corners, labels)))
    }

    /// Draws what each face has by its corners.
    fn draw_faces(&self, of_corners: impl Fn([u32; 3]) -> f32) -> Image<f32> {
        let faces = &self.mesh.faces;
        let of_face = |&face: &u32| faces.get(face as usize).map(|&corners| of_corners(corners));
        self.faces.map(|face| of_face(face).unwrap_or(f32::NAN))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{MeanView, PictureSize, tests::bumpy_sphere, three_views};
    use super::*;
    use nalgebra::Point3;

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

    #[test]
    fn a_pixel_has_the_label_of_most_corners() {
        let corner = |x, y| Point3::new(x, y, 0.0);
        let mesh = TriMesh {
            vertices: vec![corner(0.0, 0.0), corner(1.0, 0.0), corner(0.0, 1.0)],
            faces: vec![[0, 1, 2]],
        };
        let seen = SeenSurface {
            mesh: &mesh,
            faces: Image::from_vec(2, 1, vec![0, u32::MAX]),
        };
        let drawn = |labels: [u8; 3]| {
            let field = seen.draw_labels(&labels);
            assert!(field.at(1, 0).is_nan());
            *field.at(0, 0)
        };
        assert_eq!(drawn([0, 3, 3]), 3.0);
        assert_eq!(drawn([3, 0, 3]), 3.0);
        assert_eq!(drawn([1, 2, 3]), 1.0);
    }
}
