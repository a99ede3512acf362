//! What every view shows at every site: all of the residual of Eq. (6) that does not change while the surface is displaced.
//!
//! Within a solve pixel, distance and light are held (Sec. 4.3) and only the normals move, so that each image is sampled once
//! and a residual costs a scalar product.

use super::energy::unit_normal;
use super::sites::Sites;
use super::view::View;
use crate::geometry::TriMesh;
use crate::shading::median_absolute_deviation;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// One site in one view.
#[derive(Clone, Copy, Debug)]
pub struct Observation {
    /// Observed linear intensity, in its standard deviations.
    pub observed: f32,
    /// Light that arrives, towards the light, in the same unit: its product with the unit normal is the prediction for unit
    /// albedo. World frame.
    light: [f32; 3],
    /// Pixels that a square metre covers, by the unit normal, world frame.
    pixels_per_m2: [f32; 3],
}

impl Observation {
    /// Light that arrives, as a vector whose product with the unit normal is the prediction for unit albedo, in sigmas. Gloss is in it as
    /// it is about the normal of the start of the round.
    #[inline]
    pub fn light(&self) -> Vector3<f64> {
        Vector3::from(self.light.map(f64::from))
    }

    /// Prediction for unit albedo, in sigmas; `None` where the surface faces away from the light.
    #[inline]
    pub fn unit_prediction(&self, normal: &Vector3<f64>) -> Option<f64> {
        let unit = self.light().dot(normal);
        (unit > 0.0).then_some(unit)
    }

    /// Observed less predicted intensity, in sigmas; `None` where the surface faces away from the light.
    #[inline]
    pub fn residual(&self, normal: &Vector3<f64>, albedo: f64) -> Option<f64> {
        Some(f64::from(self.observed) - albedo * self.unit_prediction(normal)?)
    }

    /// How much a facet counts: the pixels that it covers, at most one.
    #[inline]
    pub fn covered(&self, normal: &Vector3<f64>, area_m2: f64) -> f64 {
        let per_m2 = Vector3::from(self.pixels_per_m2.map(f64::from)).dot(normal);
        (area_m2 * per_m2).clamp(0.0, 1.0)
    }
}

/// The observations of all sites.
pub struct Observations {
    /// Where the observations of each face begin; one more than faces.
    starts: Vec<u32>,
    entries: Vec<Observation>,
}

/// Sites looked at for the scale of the residuals: every so many.
const SCALE_STRIDE: usize = 5;
/// Faces that are sampled together.
const TILE: usize = 2048;

impl Observations {
    /// Samples every view at the sites that it sees.
    pub fn new(mesh: &TriMesh, sites: &Sites, views: &[View]) -> Observations {
        Self::every(1, mesh, sites, views)
    }

    /// As [`Self::new`], for what [`Self::residual_scale`] looks at alone.
    pub fn for_scale(mesh: &TriMesh, sites: &Sites, views: &[View]) -> Observations {
        Self::every(SCALE_STRIDE, mesh, sites, views)
    }

    fn every(stride: usize, mesh: &TriMesh, sites: &Sites, views: &[View]) -> Observations {
        let n_faces = sites.points.len();
        let is_glossy = views.iter().any(View::is_glossy);
        // Gloss alone needs it; a face without a normal is seen by nobody.
        let normal_of = |face: usize| match is_glossy {
            true => unit_normal(mesh, face).map_or_else(Vector3::zeros, |(normal, _)| normal),
            false => Vector3::zeros(),
        };
        let of_face = |face: usize, entries: &mut Vec<Observation>| {
            let mut set = match face % stride {
                0 => sites.visible[face],
                _ => 0,
            };
            let before = entries.len();
            let normal = normal_of(face);
            while set != 0 {
                let view = &views[set.trailing_zeros() as usize];
                entries.extend(view.observe(&sites.points[face], &normal));
                set &= set - 1;
            }
            (entries.len() - before) as u32
        };
        let tiles: Vec<(Vec<u32>, Vec<Observation>)> = (0..n_faces.div_ceil(TILE))
            .into_par_iter()
            .map(|tile| {
                let mut entries = Vec::new();
                let faces = tile * TILE..((tile + 1) * TILE).min(n_faces);
                let counts = faces.map(|face| of_face(face, &mut entries)).collect();
                (counts, entries)
            })
            .collect();
        let mut starts = Vec::with_capacity(n_faces + 1);
        starts.push(0);
        let mut end = 0;
        for count in tiles.iter().flat_map(|(counts, _)| counts) {
            end += count;
            starts.push(end);
        }
        let mut entries = Vec::with_capacity(end as usize);
        // Each tile is freed as soon as it is taken over.
        for (_, tile) in tiles {
            entries.extend(tile);
        }
        Observations { starts, entries }
    }

    /// The observations of a face, in the order of the views.
    #[inline]
    pub fn of(&self, face: usize) -> &[Observation] {
        &self.entries[self.starts[face] as usize..self.starts[face + 1] as usize]
    }

    /// Robust standard deviation of all residuals, in sigmas, at least 1: [`median_absolute_deviation`].
    pub fn residual_scale(&self, mesh: &TriMesh, albedo: &[f64]) -> f64 {
        let mut magnitudes: Vec<f64> = (0..mesh.faces.len())
            .into_par_iter()
            .step_by(SCALE_STRIDE)
            .flat_map_iter(|face| {
                let normal = unit_normal(mesh, face).map(|(normal, _)| normal);
                let seen = self.of(face).iter();
                seen.filter_map(move |seen| seen.residual(&normal?, albedo[face]))
            })
            .collect();
        median_absolute_deviation(&mut magnitudes).max(1.0)
    }
}

impl View {
    /// What this view shows at a point; `None` where its pixel is unusable.
    fn observe(
        &self,
        point_world: &Point3<f64>,
        normal_world: &Vector3<f64>,
    ) -> Option<Observation> {
        let seen = self.look(point_world)?;
        let inv_sigma = 1.0 / seen.sigma;
        let world_from_camera = self.camera_from_world.rotation.inverse();
        let normal = self.camera_from_world * normal_world;
        let highlight = self.highlight(&seen.point_camera, &normal);
        let arriving = self.arriving(&seen.point_camera, &seen.pixel);
        // The slope lies across the normal: value and slope are right there.
        let highlight = normal * highlight.value + highlight.by_normal;
        let light = world_from_camera * (arriving + highlight);
        let narrow = |v: Vector3<f64>| [v.x, v.y, v.z].map(|x| x as f32);
        Some(Observation {
            observed: (seen.observed * inv_sigma) as f32,
            light: narrow(light * (seen.gain * inv_sigma)),
            pixels_per_m2: narrow(world_from_camera * self.pixels_per_m2(&seen.point_camera)),
        })
    }
}
