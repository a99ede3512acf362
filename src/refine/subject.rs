//! What is refined, and what from.

use super::optics::Optics;
use super::sites::ViewSet;
use crate::geometry::TriMesh;
use crate::robust::median;
use crate::snapshot::ShadingSnapshot;

/// Vertices by which it is known whether an image may show the object; arbitrary.
const LOOKED_AT: usize = 1000;

/// A refinement's object, its surroundings, images and light.
#[derive(Clone, Copy)]
pub struct Subject<'a> {
    /// The whole base mesh, which hides the object from camera and light.
    pub scene: &'a TriMesh,
    /// The part of it to refine.
    pub object: &'a TriMesh,
    /// The shading images.
    pub snapshots: &'a [ShadingSnapshot],
    /// Camera, light and response.
    pub optics: &'a Optics<'a>,
}

impl Subject<'_> {
    /// What a pixel covers of the object, metres, in the median of the images that look at it; 0 without any.
    pub fn footprint_m(&self) -> f64 {
        let centre = self.object.centre();
        let focal_px = self.optics.rays.camera().intrinsics().fx;
        let of_image = |snapshot: &ShadingSnapshot| {
            let in_camera = snapshot.world_from_camera.inverse_transform_point(&centre);
            in_camera.z / focal_px
        };
        let looking = self.images_of_it().into_iter();
        let mut of_images: Vec<f64> = looking.map(of_image).collect();
        median(&mut of_images).unwrap_or_default()
    }

    /// The images that look at the object.
    pub fn images_of_it(&self) -> Vec<&ShadingSnapshot> {
        let looking = self.looking();
        let views = (0..ViewSet::BITS).zip(self.snapshots);
        views
            .filter(|(view, _)| looking >> view & 1 == 1)
            .map(|(_, snapshot)| snapshot)
            .collect()
    }

    /// The views that look at the object, which may be hidden from them.
    pub fn looking(&self) -> ViewSet {
        let camera = self.optics.rays.camera();
        let vertices = &self.object.vertices;
        let every = vertices.len().div_ceil(LOOKED_AT).max(1);
        let looks = |snapshot: &ShadingSnapshot| {
            let camera_from_world = snapshot.world_from_camera.inverse();
            let mut pixels = vertices
                .iter()
                .step_by(every)
                .filter_map(|vertex| camera.project(&(camera_from_world * vertex)));
            pixels.any(|pixel| camera.contains(&pixel, 0.0))
        };
        let views = (0..ViewSet::BITS).zip(self.snapshots);
        let looking = views.filter(|(_, snapshot)| looks(snapshot));
        looking.fold(0, |set, (view, _)| set | 1 << view)
    }
}
