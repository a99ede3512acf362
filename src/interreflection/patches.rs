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
/// Columns of places that receive light, where the surface is known: 4 pixels a place on a Kinect II.
const RECEIVER_COLUMNS: usize = 128;
/// Pixels between those of them that are looked at.
const RECEIVER_STEP_PX: usize = 2;
/// Neighbours that lie farther off than this are another surface, metres.
const SAME_SURFACE_M: f64 = 0.02;
/// Light that comes in more slantingly is taken to come in at this cosine: the normal of a patch is not known better, nor
/// that of a receiver than by the next.
const MIN_INCIDENCE_COSINE: f64 = 0.15;
const MIN_RECEIVED_COSINE: f64 = 0.1;

/// The patches that one camera's images are cut into.
#[derive(Clone, Debug)]
pub struct PatchGrid {
    rays: RayGrid,
    light: NearLight,
    inv_full_scale: f64,
    gamma: f64,
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
            gamma: calibration.gamma,
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

    /// Linear intensity of each patch of a frame, row by row, share of full scale; not a number where there is no depth.
    pub fn radiances<T>(&self, depth_m: &Image<f32>, ir_counts: &Image<T>) -> Vec<f32>
    where
        T: Copy + Into<f64> + Send + Sync,
    {
        let inv_gamma = 1.0 / self.gamma;
        (0..self.cells.n_cells())
            .into_par_iter()
            .map(|cell| {
                let (mut sum, mut n) = (0.0, 0);
                for (u, v) in self.cells.square(cell, STEP_PX).pixels() {
                    if *depth_m.at(u, v) > 0.0 {
                        let counts: f64 = (*ir_counts.at(u, v)).into();
                        let observed = counts * self.inv_full_scale;
                        sum += observed.powf(inv_gamma);
                        n += 1;
                    }
                }
                (sum / f64::from(n) * self.inv_flat[cell]) as f32
            })
            .collect()
    }

    /// What the [`Self::radiances`] of a frame would be by another response of the same camera, but for what varies within a
    /// patch.
    pub fn linearised_anew(&self, radiances: &[f32], by: &PatchGrid) -> Vec<f32> {
        let exponent = self.gamma / by.gamma;
        let patches = radiances.iter().zip(&self.inv_flat);
        patches
            .map(|(&radiance, inv_flat)| {
                ((f64::from(radiance) / inv_flat).powf(exponent) * inv_flat) as f32
            })
            .collect()
    }

    /// The patches of a frame with their [`Self::radiances`], row by row; `None` where depth is missing or holds an edge.
    ///
    /// # Panics
    /// Unless there is one radiance for each patch.
    pub fn patches(&self, depth_m: &Image<f32>, radiances: &[f32]) -> Vec<Option<Lit>> {
        assert_eq!(
            radiances.len(),
            self.cells.n_cells(),
            "one radiance a patch"
        );
        radiances
            .par_iter()
            .enumerate()
            .map(|(cell, &radiance)| {
                let square = self.cells.square(cell, STEP_PX);
                let patch = DepthPatch::fit(depth_m, &self.rays, square)?;
                radiance.is_finite().then_some(())?;
                self.lit(
                    &patch.centre,
                    &patch.normal,
                    patch.area_m2,
                    f64::from(radiance),
                )
            })
            .collect()
    }

    /// Places of an image that receive light, sixteen in each patch, where the surface is known better than by one frame's
    /// depth (m): `normal_at` gives it near a point of the camera frame, and it is averaged over the neighbouring places of the
    /// same surface. They send no light.
    pub fn receivers(
        &self,
        depth_m: &Image<f32>,
        normal_at: impl Fn(&Point3<f64>) -> Option<Vector3<f64>> + Sync,
    ) -> (CellGrid, Vec<Option<Lit>>) {
        let cells = CellGrid::new(depth_m.width(), depth_m.height(), RECEIVER_COLUMNS);
        let place = |cell: usize| {
            let (mut points, mut normals, mut n) = (Vector3::zeros(), Vector3::zeros(), 0);
            for (u, v) in cells.square(cell, RECEIVER_STEP_PX).pixels() {
                let z = *depth_m.at(u, v);
                if z <= 0.0 {
                    continue;
                }
                let point = Point3::from((self.rays.direction(u, v) * z).cast::<f64>());
                if let Some(normal) = normal_at(&point) {
                    points += point.coords;
                    normals += normal;
                    n += 1;
                }
            }
            (n > 0).then(|| (Point3::from(points / f64::from(n)), normals))
        };
        let places: Vec<Option<(Point3<f64>, Vector3<f64>)>> =
            (0..cells.n_cells()).into_par_iter().map(place).collect();
        let receiver = |cell: usize| {
            let (point, _) = places[cell]?;
            let beside = cells.beside(cell).filter_map(|other| places[other]);
            let same = beside.filter(|(other, _)| (other - point).norm() < SAME_SURFACE_M);
            let normal: Vector3<f64> = same.map(|(_, normal)| normal).sum();
            let normal = normal.try_normalize(0.0)?;
            self.lit_from(MIN_RECEIVED_COSINE, &point, &normal, 0.0, 0.0)
        };
        let receivers = (0..cells.n_cells()).into_par_iter().map(receiver).collect();
        (cells, receivers)
    }

    /// A patch as the light reaches it; `None` behind the light.
    pub fn lit(
        &self,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
        area_m2: f64,
        radiance: f64,
    ) -> Option<Lit> {
        self.lit_from(MIN_INCIDENCE_COSINE, point, normal, area_m2, radiance)
    }

    fn lit_from(
        &self,
        min_cosine: f64,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
        area_m2: f64,
        radiance: f64,
    ) -> Option<Lit> {
        let incident = self.light.incident(point);
        let least = min_cosine * incident.norm();
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
