//! What a frame shows, as patches that are lit and light one another.

use crate::geometry::{CellGrid, DepthPatch, RayGrid};
use crate::shading::{Calibration, NearLight};
use depth_camera::Image;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// A patch of surface and its light, camera frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lit {
    /// Its middle, metres.
    pub point: [f32; 3],
    /// Unit normal.
    pub normal: [f32; 3],
    /// Area, square metres.
    pub area_m2: f32,
    /// Linear intensity that it shows, share of full scale; the same from all sides (Lambert).
    pub radiance: f32,
    /// What a perfectly white patch in its place would show of a light of white level 1.
    pub direct: f32,
    /// Distance to the light, metres.
    pub light_m: f32,
}

/// Columns of patches: 16 pixels a patch on a Kinect II. Half as large, and four times as many, left the same error.
const COLUMNS: usize = 32;
/// Pixels between those that are looked at.
const STEP_PX: usize = 4;
/// Light that comes in more slantingly is taken to come in at this cosine: the normal of a patch is not known better.
const MIN_INCIDENCE_COSINE: f64 = 0.15;

/// The patches that one camera's images are cut into.
#[derive(Clone, Debug)]
pub struct PatchGrid {
    rays: RayGrid,
    light: NearLight,
    inv_full_scale: f64,
    inv_gamma: f64,
    /// One over the flat field in the middle of each patch.
    inv_flat: Vec<f64>,
    cells: CellGrid,
}

impl PatchGrid {
    /// Cuts the images of a camera with the given rays, light and full scale of the IR counts.
    pub fn new(
        rays: RayGrid,
        light: NearLight,
        full_scale: f64,
        calibration: &Calibration,
    ) -> Self {
        let i = *rays.camera().intrinsics();
        let cells = CellGrid::new(i.width, i.height, COLUMNS);
        let inv_flat = (0..cells.n_cells())
            .map(|cell| {
                let (u, v) = cells.middle(cell);
                let [x, y] = rays.rays().at(u, v).map(f64::from);
                1.0 / calibration.flat_field.factor(x, y)
            })
            .collect();
        PatchGrid {
            rays,
            light,
            inv_full_scale: 1.0 / full_scale,
            inv_gamma: 1.0 / calibration.gamma,
            inv_flat,
            cells,
        }
    }

    /// The rays of the pixels.
    pub fn rays(&self) -> &RayGrid {
        &self.rays
    }

    /// The cells whose patches they are.
    pub fn cells(&self) -> CellGrid {
        self.cells
    }

    /// The patches of a frame, row by row; `None` where depth is missing or holds an edge.
    pub fn patches<T>(&self, depth_m: &Image<f32>, ir_counts: &Image<T>) -> Vec<Option<Lit>>
    where
        T: Copy + Into<f64> + Send + Sync,
    {
        (0..self.cells.n_cells())
            .into_par_iter()
            .map(|cell| {
                let square = self.cells.square(cell, STEP_PX);
                let patch = DepthPatch::fit(depth_m, &self.rays, square)?;
                let (mut sum, mut n) = (0.0, 0);
                for (u, v) in square.pixels() {
                    if *depth_m.at(u, v) > 0.0 {
                        let counts: f64 = (*ir_counts.at(u, v)).into();
                        let observed = counts * self.inv_full_scale;
                        sum += observed.powf(self.inv_gamma);
                        n += 1;
                    }
                }
                let radiance = sum / f64::from(n) * self.inv_flat[cell];
                radiance.is_finite().then_some(())?;
                self.lit(&patch.centre, &patch.normal, patch.area_m2, radiance)
            })
            .collect()
    }

    /// A patch as the light reaches it; `None` behind the light.
    pub fn lit(
        &self,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
        area_m2: f64,
        radiance: f64,
    ) -> Option<Lit> {
        let incident = self.light.incident(point);
        let least = MIN_INCIDENCE_COSINE * incident.norm();
        let direct = incident.dot(normal).max(least);
        (direct > 0.0).then(|| Lit {
            point: point.coords.cast().into(),
            normal: (*normal).cast().into(),
            area_m2: area_m2 as f32,
            radiance: radiance as f32,
            direct: direct as f32,
            light_m: (self.light.position - point).norm() as f32,
        })
    }
}
