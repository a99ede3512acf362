//! What every view shows at every site: all of the residual of Eq. (6) that does not change while the surface is displaced.
//!
//! Within a solve pixel, distance and light are held (Sec. 4.3) and only the normals move, so that each image is sampled once
//! and a residual costs a scalar product.

use super::energy::unit_normal;
use super::gaze::{Gaze, Lanes3, Weighed, set_lane};
use super::sites::Sites;
use super::view::View;
use crate::geometry::TriMesh;
use crate::geometry::lanes::LANES;
use crate::shading::median_absolute_deviation;
use nalgebra::Vector3;
use rayon::prelude::*;
use std::ops::Range;

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
    /// Where a view shows nothing.
    const NONE: Observation = Observation {
        observed: f32::NAN,
        light: [0.0; 3],
        pixels_per_m2: [0.0; 3],
    };

    fn of_lane(weighed: &Weighed, lane: usize) -> Observation {
        let of = |lanes: &Lanes3| [0, 1, 2].map(|axis| lanes[axis][lane]);
        Observation {
            observed: weighed.observed[lane],
            light: of(&weighed.light),
            pixels_per_m2: of(&weighed.pixels_per_m2),
        }
    }

    fn is_there(&self) -> bool {
        !self.observed.is_nan()
    }

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
        let gazes: Vec<Gaze> = views.iter().map(Gaze::new).collect();
        let tiles: Vec<Tile> = (0..n_faces.div_ceil(TILE))
            .into_par_iter()
            .map(|tile| {
                let faces = tile * TILE..((tile + 1) * TILE).min(n_faces);
                Tile::new(faces, stride, mesh, sites, &gazes)
            })
            .collect();
        let mut starts = Vec::with_capacity(n_faces + 1);
        starts.push(0);
        let mut end = 0;
        for count in tiles.iter().flat_map(|tile| &tile.counts) {
            end += count;
            starts.push(end);
        }
        let mut entries = Vec::with_capacity(end as usize);
        // Each tile is freed as soon as it is taken over.
        for tile in tiles {
            entries.extend(tile.entries.into_iter().filter(Observation::is_there));
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

/// What the views show of some faces.
struct Tile {
    /// Observations of each face.
    counts: Vec<u32>,
    /// Face by face and in the order of the views, and among them those that are not there.
    entries: Vec<Observation>,
}

impl Tile {
    fn new(
        faces: Range<usize>,
        stride: usize,
        mesh: &TriMesh,
        sites: &Sites,
        gazes: &[Gaze],
    ) -> Tile {
        let set_of = |face: usize| match face % stride {
            0 => sites.visible[face],
            _ => 0,
        };
        let mut starts = Vec::with_capacity(faces.len());
        let mut end = 0;
        for face in faces.clone() {
            starts.push(end);
            end += set_of(face).count_ones();
        }
        let mut tile = Tile {
            counts: vec![0; faces.len()],
            entries: vec![Observation::NONE; end as usize],
        };
        // One view after the other, so that its image stays at hand.
        for (k, gaze) in gazes.iter().enumerate() {
            let seen = faces.clone().filter(|&face| set_of(face) >> k & 1 == 1);
            let before = |face: usize| (set_of(face) & ((1 << k) - 1)).count_ones();
            let slots = seen.map(|face| {
                let index = face - faces.start;
                (face, index, (starts[index] + before(face)) as usize)
            });
            tile.observe(gaze, slots, mesh, sites);
        }
        tile
    }

    /// Fills in what a view shows of faces, given with their numbers in the tile and the places of their observations.
    fn observe(
        &mut self,
        gaze: &Gaze,
        mut slots: impl Iterator<Item = (usize, usize, usize)>,
        mesh: &TriMesh,
        sites: &Sites,
    ) {
        let (mut points, mut normals) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3]);
        loop {
            let (mut to, mut n) = ([(0, 0); LANES], 0);
            for (face, index, slot) in slots.by_ref().take(LANES) {
                set_lane(&mut points, n, &sites.points[face].coords);
                if gaze.needs_normals()
                    && let Some((normal, _)) = unit_normal(mesh, face)
                {
                    set_lane(&mut normals, n, &normal);
                }
                to[n] = (index, slot);
                n += 1;
            }
            if n == 0 {
                return;
            }
            let weighed = gaze.weighed(&points, &normals);
            for (lane, &(index, slot)) in to[..n].iter().enumerate() {
                let seen = Observation::of_lane(&weighed, lane);
                self.counts[index] += u32::from(seen.is_there());
                self.entries[slot] = seen;
            }
        }
    }
}
