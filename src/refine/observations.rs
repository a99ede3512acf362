//! What every view shows at every site: all of the residual of Eq. (6) that does not change while the surface is displaced.
//!
//! Within a solve pixel, distance and light are held (Sec. 4.3) and only the normals move, so that each image is sampled once
//! and a residual costs a scalar product.

use super::gaze::{Gaze, Lanes3, Weighed, set_lane};
use super::sites::Sites;
use super::view::View;
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
    /// Of [`TILE`] faces each.
    tiles: Vec<Tile>,
}

/// Sites looked at for the scale of the residuals: every so many.
const SCALE_STRIDE: usize = 5;
/// Faces that are sampled together.
const TILE: usize = 2048;

impl Observations {
    /// Samples every view at the sites that it sees.
    pub fn new(sites: &Sites, views: &[View]) -> Observations {
        Self::every(1, sites, views)
    }

    /// As [`Self::new`], for what [`Self::residual_scale`] looks at alone.
    pub fn for_scale(sites: &Sites, views: &[View]) -> Observations {
        Self::every(SCALE_STRIDE, sites, views)
    }

    fn every(stride: usize, sites: &Sites, views: &[View]) -> Observations {
        let n_faces = sites.points.len();
        let gazes: Vec<Gaze> = views.iter().map(Gaze::new).collect();
        let tiles = (0..n_faces.div_ceil(TILE)).into_par_iter().map(|tile| {
            let faces = tile * TILE..((tile + 1) * TILE).min(n_faces);
            Tile::new(faces, stride, sites, &gazes)
        });
        Observations {
            tiles: tiles.collect(),
        }
    }

    /// The observations of a face, in the order of the views.
    #[inline]
    pub fn of(&self, face: usize) -> &[Observation] {
        let Tile { starts, entries } = &self.tiles[face / TILE];
        let face = face % TILE;
        &entries[starts[face] as usize..starts[face + 1] as usize]
    }

    /// Robust standard deviation of all residuals, in sigmas, at least 1: [`median_absolute_deviation`].
    pub fn residual_scale(&self, sites: &Sites, albedo: &[f64]) -> f64 {
        let mut magnitudes: Vec<f64> = (0..sites.points.len())
            .into_par_iter()
            .step_by(SCALE_STRIDE)
            .flat_map_iter(|face| {
                let seen = self.of(face).iter();
                seen.filter_map(move |seen| seen.residual(&sites.normals[face], albedo[face]))
            })
            .collect();
        median_absolute_deviation(&mut magnitudes).max(1.0)
    }
}

/// What the views show of some faces.
struct Tile {
    /// Where the observations of each face begin; one more than faces.
    starts: Vec<u32>,
    /// Face by face and in the order of the views.
    entries: Vec<Observation>,
}

impl Tile {
    fn new(faces: Range<usize>, stride: usize, sites: &Sites, gazes: &[Gaze]) -> Tile {
        let set_of = |face: usize| match face % stride {
            0 => sites.visible[face],
            _ => 0,
        };
        let mut starts = vec![0; faces.len() + 1];
        let mut end = 0;
        for face in faces.clone() {
            starts[face - faces.start] = end;
            end += set_of(face).count_ones();
        }
        starts[faces.len()] = end;
        let mut entries = vec![Observation::NONE; end as usize];
        // One view after the other, so that its image stays at hand.
        for (k, gaze) in gazes.iter().enumerate() {
            let seen = faces.clone().filter(|&face| set_of(face) >> k & 1 == 1);
            let slots = seen.map(|face| {
                let before = (set_of(face) & ((1 << k) - 1)).count_ones();
                (face, (starts[face - faces.start] + before) as usize)
            });
            observe(gaze, slots, sites, &mut entries);
        }
        let mut there = 0;
        for start in 0..faces.len() {
            let range = starts[start] as usize..starts[start + 1] as usize;
            starts[start] = there;
            let seen = entries[range].iter().filter(|entry| entry.is_there());
            there += seen.count() as u32;
        }
        starts[faces.len()] = there;
        entries.retain(Observation::is_there);
        Tile { starts, entries }
    }
}

/// Fills in what a view shows of faces, given with the places of their observations.
fn observe(
    gaze: &Gaze,
    mut slots: impl Iterator<Item = (usize, usize)>,
    sites: &Sites,
    entries: &mut [Observation],
) {
    let (mut points, mut normals) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3]);
    loop {
        let (mut to, mut n) = ([0; LANES], 0);
        for (face, slot) in slots.by_ref().take(LANES) {
            set_lane(&mut points, n, &sites.points[face].coords);
            set_lane(&mut normals, n, &sites.normals[face]);
            to[n] = slot;
            n += 1;
        }
        if n == 0 {
            return;
        }
        let weighed = gaze.weighed(&points, &normals);
        for (lane, &slot) in to[..n].iter().enumerate() {
            entries[slot] = Observation::of_lane(&weighed, lane);
        }
    }
}
