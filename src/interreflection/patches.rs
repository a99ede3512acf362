//! What a frame shows, as patches that are lit and light one another.

use crate::geometry::{CellGrid, DepthPatch, RayGrid};
use crate::shading::{Calibration, NearLight, SATURATION};
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
/// Columns of places that receive light, where the surface is known: 4 pixels a place on a Kinect II. By places of 2 pixels brightness
/// would tell more than the driver's filter has left in the depth.
const PLACE_COLUMNS: usize = 128;
/// Pixels between those of them that are looked at.
pub const PLACE_STEP_PX: usize = 2;
/// Light that comes in more slantingly is taken to come in at this cosine: the normal of a patch is not known better.
const MIN_INCIDENCE_COSINE: f64 = 0.15;

/// The patches that one camera's images are cut into.
#[derive(Clone, Debug)]
pub struct PatchGrid {
    rays: RayGrid,
    light: NearLight,
    inv_full_scale: f64,
    gamma: f64,
    patches: Cut,
    places: Cut,
}

/// An image cut into cells, of which some pixels are looked at.
#[derive(Clone, Debug)]
struct Cut {
    cells: CellGrid,
    step_px: usize,
    /// A cell with a pixel this bright or brighter, share of full scale, is not known.
    saturation: f64,
    /// One over the flat field in the middle of each cell.
    inv_flat: Vec<f64>,
}

impl Cut {
    fn new(
        columns: usize,
        step_px: usize,
        saturation: f64,
        rays: &RayGrid,
        calibration: &Calibration,
    ) -> Self {
        let i = *rays.camera().intrinsics();
        let cells = CellGrid::new(i.width, i.height, columns);
        let inv_flat = (0..cells.n_cells())
            .map(|cell| {
                let (u, v) = cells.middle(cell);
                let [x, y] = rays.rays().at(u, v).map(f64::from);
                1.0 / calibration.flat_field.factor(x, y)
            })
            .collect();
        Cut {
            cells,
            step_px,
            saturation,
            inv_flat,
        }
    }
}

/// Linear intensity of a frame, share of full scale; not a number where there is no depth.
#[derive(Clone, Debug, PartialEq)]
pub struct Radiances {
    /// Of each patch, row by row.
    pub patches: Vec<f32>,
    /// Of each of the finer places that receive light; not a number where it is saturated, too.
    pub places: Vec<f32>,
}

impl PatchGrid {
    /// Cuts the images of a camera with the given rays, light and full scale of the IR counts.
    pub fn new(
        rays: RayGrid,
        light: NearLight,
        full_scale: f64,
        calibration: &Calibration,
    ) -> Self {
        PatchGrid {
            patches: Cut::new(COLUMNS, STEP_PX, f64::INFINITY, &rays, calibration),
            places: Cut::new(PLACE_COLUMNS, PLACE_STEP_PX, SATURATION, &rays, calibration),
            rays,
            light,
            inv_full_scale: 1.0 / full_scale,
            gamma: calibration.gamma,
        }
    }

    /// The rays of the pixels.
    pub fn rays(&self) -> &RayGrid {
        &self.rays
    }

    /// The light.
    pub fn light(&self) -> &NearLight {
        &self.light
    }

    /// The cells whose patches they are.
    pub fn cells(&self) -> CellGrid {
        self.patches.cells
    }

    /// The cells of the places that receive light.
    pub fn places(&self) -> CellGrid {
        self.places.cells
    }

    /// How bright a frame is, by patches and by places.
    pub fn radiances<T>(&self, depth_m: &Image<f32>, ir_counts: &Image<T>) -> Radiances
    where
        T: Copy + Into<f64> + Send + Sync,
    {
        Radiances {
            patches: self.shown_by(&self.patches, depth_m, ir_counts),
            places: self.shown_by(&self.places, depth_m, ir_counts),
        }
    }

    /// How bright a frame is by patches alone.
    pub fn patch_radiances<T>(&self, depth_m: &Image<f32>, ir_counts: &Image<T>) -> Vec<f32>
    where
        T: Copy + Into<f64> + Send + Sync,
    {
        self.shown_by(&self.patches, depth_m, ir_counts)
    }

    fn shown_by<T>(&self, cut: &Cut, depth_m: &Image<f32>, ir_counts: &Image<T>) -> Vec<f32>
    where
        T: Copy + Into<f64> + Send + Sync,
    {
        let inv_gamma = (1.0 / self.gamma) as f32;
        (0..cut.cells.n_cells())
            .into_par_iter()
            .map(|cell| {
                let (mut sum, mut n, mut is_saturated) = (0.0, 0, false);
                for (u, v) in cut.cells.square(cell, cut.step_px).pixels() {
                    if *depth_m.at(u, v) > 0.0 {
                        let counts: f64 = (*ir_counts.at(u, v)).into();
                        let observed = counts * self.inv_full_scale;
                        // In single precision: powers are most of the time.
                        sum += f64::from((observed as f32).powf(inv_gamma));
                        n += 1;
                        is_saturated |= observed >= cut.saturation;
                    }
                }
                match is_saturated {
                    true => f32::NAN,
                    false => (sum / f64::from(n) * cut.inv_flat[cell]) as f32,
                }
            })
            .collect()
    }

    /// What the [`Self::radiances`] of a frame would be by another response of the same camera, but for what varies within a
    /// patch or place.
    pub fn linearised_anew(&self, radiances: &Radiances, by: &PatchGrid) -> Radiances {
        let exponent = self.gamma / by.gamma;
        let anew = |radiances: &[f32], cut: &Cut| {
            let cells = radiances.iter().zip(&cut.inv_flat);
            cells
                .map(|(&radiance, inv_flat)| {
                    ((f64::from(radiance) / inv_flat).powf(exponent) * inv_flat) as f32
                })
                .collect()
        };
        Radiances {
            patches: anew(&radiances.patches, &self.patches),
            places: anew(&radiances.places, &self.places),
        }
    }

    /// The patches of a frame with their [`Self::patch_radiances`], row by row; `None` where depth is missing or holds an edge.
    ///
    /// # Panics
    /// Unless there is one radiance for each patch.
    pub fn patches(&self, depth_m: &Image<f32>, radiances: &[f32]) -> Vec<Option<Lit>> {
        assert_eq!(
            radiances.len(),
            self.patches.cells.n_cells(),
            "one radiance a patch"
        );
        radiances
            .par_iter()
            .enumerate()
            .map(|(cell, &radiance)| {
                let square = self.patches.cells.square(cell, STEP_PX);
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

    /// The same, where slanting light is taken to come in at a cosine of at least `min_cosine`.
    pub fn lit_from(
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
