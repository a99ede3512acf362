//! What every view shows at every site: all of the residual of Eq. (6) but the normals.
//!
//! Each image is sampled once a round. Within a solve pixel, distance and light are held (Sec. 4.3), or change in proportion to
//! the site's own motion ([`SiteMotion`]); a residual costs a scalar product either way. How much of a pixel a site covers is held.

use super::gaze::{AsItIs, Gaze, Lanes3, Surfels, Weighed, set_lane};
use super::rendering::Rendered;
use super::site_motion::SiteMotion;
use super::sites::Sites;
use super::surface::Surface;
use super::tiles::{TILE, tiles};
use super::view::View;
use crate::geometry::lanes::LANES;
use crate::robust::median_absolute_deviation;
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
    pub light: [f32; 3],
    /// How much the site counts: the pixels that it covers, at most one.
    pub covered: f32,
    /// By how much `observed` changes as the site moves, per metre; 0 where pixels are held.
    pub image_slope: f32,
    /// The same of the prediction for unit albedo.
    pub light_slope: f32,
    /// Whether its pixels are clear of depth edges, so that no other surface is mixed in.
    pub is_clear: bool,
}

impl Observation {
    /// Where a view shows nothing.
    const NONE: Observation = Observation {
        observed: f32::NAN,
        light: [0.0; 3],
        covered: 0.0,
        image_slope: 0.0,
        light_slope: 0.0,
        is_clear: false,
    };

    fn of_lane(weighed: &Weighed, lane: usize, area_m2: f64) -> Observation {
        let of = |lanes: &Lanes3| [0, 1, 2].map(|axis| lanes[axis][lane]);
        Observation {
            observed: weighed.observed[lane],
            light: of(&weighed.light),
            covered: (area_m2 as f32 * weighed.pixels_per_m2[lane]).clamp(0.0, 1.0),
            image_slope: weighed.slopes.image[lane],
            light_slope: weighed.slopes.light[lane],
            is_clear: weighed.is_clear[lane],
        }
    }

    fn is_there(&self) -> bool {
        !self.observed.is_nan()
    }

    /// Light that arrives, as a vector whose product with the unit normal is the prediction for unit albedo, in sigmas. Gloss is in it as
    /// it is about the normal of the start of the round.
    #[inline]
    fn light(&self) -> Vector3<f64> {
        Vector3::from(self.light.map(f64::from))
    }

    /// Prediction for unit albedo, in sigmas; `None` where the surface faces away from the light.
    #[inline]
    pub fn unit_prediction(&self, normal: &Vector3<f64>) -> Option<f64> {
        self.moved(0.0).unit_prediction(normal)
    }

    /// Observed less predicted intensity, in sigmas; `None` where the surface faces away from the light.
    #[inline]
    pub fn residual(&self, normal: &Vector3<f64>, albedo: f64) -> Option<f64> {
        self.moved(0.0).residual(normal, albedo)
    }

    /// What the view shows once the site has moved, metres along its direction.
    #[inline]
    pub fn moved(&self, by_m: f64) -> Moved<'_> {
        Moved { seen: self, by_m }
    }
}

/// One site in one view, moved.
pub struct Moved<'a> {
    seen: &'a Observation,
    by_m: f64,
}

impl Moved<'_> {
    /// The same site moved by so many metres more.
    #[inline]
    pub fn farther(&self, by_m: f64) -> Self {
        self.seen.moved(self.by_m + by_m)
    }

    /// As of [`Observation::observed`].
    #[inline]
    fn observed(&self) -> f64 {
        f64::from(self.seen.observed) + f64::from(self.seen.image_slope) * self.by_m
    }

    /// As of [`Observation::residual`].
    #[inline]
    pub fn residual(&self, normal: &Vector3<f64>, albedo: f64) -> Option<f64> {
        Some(self.observed() - albedo * self.unit_prediction(normal)?)
    }

    /// Prediction for unit albedo, in sigmas; `None` where the surface faces away from the light.
    #[inline]
    pub fn unit_prediction(&self, normal: &Vector3<f64>) -> Option<f64> {
        let unit = self.seen.light().dot(normal) + f64::from(self.seen.light_slope) * self.by_m;
        (unit > 0.0).then_some(unit)
    }
}

/// The observations of all sites.
pub struct Observations {
    /// Of [`TILE`] sites each.
    tiles: Vec<Tile>,
    /// What the observations change with beside the normals.
    motion: Option<SiteMotion>,
}

/// Sites looked at for the scale of the residuals: every so many.
const SCALE_STRIDE: usize = 5;

impl Observations {
    /// Samples every view at the sites that it sees, which may move. What the surface `rendered` shows beside its sites is taken off.
    pub fn new(
        sites: &Sites,
        views: &[View],
        motion: Option<SiteMotion>,
        rendered: Option<&Rendered>,
    ) -> Observations {
        Self::every(1, sites, views, motion, rendered)
    }

    /// As [`Self::new`], for what [`Self::residual_scale`] looks at alone.
    pub fn for_scale(sites: &Sites, views: &[View]) -> Observations {
        Self::every(SCALE_STRIDE, sites, views, None, None)
    }

    fn every(
        stride: usize,
        sites: &Sites,
        views: &[View],
        motion: Option<SiteMotion>,
        rendered: Option<&Rendered>,
    ) -> Observations {
        let gazes: Vec<Gaze> = views.iter().map(Gaze::new).collect();
        let tiles = tiles(sites.points.len()).map(|range| {
            let looked_at = LookedAt {
                sites,
                motion: motion.as_ref(),
                rendered,
            };
            Tile::new(range, stride, looked_at, &gazes)
        });
        Observations {
            tiles: tiles.collect(),
            motion,
        }
    }

    /// How far a site has moved since it was looked at, metres; 0 where sites are held.
    #[inline]
    pub fn moved_m(&self, surface: &Surface, site: usize) -> f64 {
        let motion = self.motion.as_ref();
        motion.map_or(0.0, |motion| motion.moved_m(surface, site))
    }

    /// The observations of a site, in the order of the views.
    #[inline]
    pub fn of(&self, site: usize) -> &[Observation] {
        let Tile { starts, entries } = &self.tiles[site / TILE];
        let site = site % TILE;
        &entries[starts[site] as usize..starts[site + 1] as usize]
    }

    /// Robust standard deviation of all residuals, in sigmas, at least 1: [`median_absolute_deviation`].
    pub fn residual_scale(&self, sites: &Sites, albedo: &[f64]) -> f64 {
        let mut magnitudes: Vec<f64> = (0..sites.points.len())
            .into_par_iter()
            .step_by(SCALE_STRIDE)
            .flat_map_iter(|site| {
                let seen = self.of(site).iter();
                seen.filter_map(move |seen| seen.residual(&sites.normals[site], albedo[site]))
            })
            .collect();
        median_absolute_deviation(&mut magnitudes).max(1.0)
    }
}

/// What views look at.
#[derive(Clone, Copy)]
struct LookedAt<'a> {
    sites: &'a Sites,
    motion: Option<&'a SiteMotion>,
    rendered: Option<&'a Rendered<'a>>,
}

/// What the views show of some sites.
struct Tile {
    /// Where the observations of each site begin; one more than sites.
    starts: Vec<u32>,
    /// Site by site and in the order of the views.
    entries: Vec<Observation>,
}

impl Tile {
    fn new(range: Range<usize>, stride: usize, looked_at: LookedAt, gazes: &[Gaze]) -> Tile {
        let set_of = |site: usize| match site % stride {
            0 => looked_at.sites.visible[site],
            _ => 0,
        };
        let mut starts = vec![0; range.len() + 1];
        let mut end = 0;
        for site in range.clone() {
            starts[site - range.start] = end;
            end += set_of(site).count_ones();
        }
        starts[range.len()] = end;
        let mut entries = vec![Observation::NONE; end as usize];
        // One view after the other, so that its image stays at hand.
        for (k, gaze) in gazes.iter().enumerate() {
            let seen = range.clone().filter(|&site| set_of(site) >> k & 1 == 1);
            let slots = seen.map(|site| {
                let before = (set_of(site) & ((1 << k) - 1)).count_ones();
                (site, (starts[site - range.start] + before) as usize)
            });
            observe((k, gaze), slots, looked_at, &mut entries);
        }
        let mut there = 0;
        for site in 0..range.len() {
            let slots = starts[site] as usize..starts[site + 1] as usize;
            starts[site] = there;
            let seen = entries[slots].iter().filter(|entry| entry.is_there());
            there += seen.count() as u32;
        }
        starts[range.len()] = there;
        entries.retain(Observation::is_there);
        Tile { starts, entries }
    }
}

/// Fills in what a view shows of sites, given with the places of their observations.
fn observe(
    (view, gaze): (usize, &Gaze),
    mut slots: impl Iterator<Item = (usize, usize)>,
    looked_at: LookedAt,
    entries: &mut [Observation],
) {
    let LookedAt {
        sites,
        motion,
        rendered,
    } = looked_at;
    let image = rendered.and_then(|rendered| rendered.image(view));
    let mut surfels = Surfels::new(sites.gloss.is_matte());
    let mut along = motion.map(|_| [[0.0; LANES]; 3]);
    let mut albedo = [0.0; LANES];
    loop {
        let (mut to, mut n) = ([(0, 0.0); LANES], 0);
        for (site, slot) in slots.by_ref().take(LANES) {
            sites.write(site, &mut surfels, n);
            if let (Some(along), Some(motion)) = (&mut along, motion) {
                set_lane(along, n, motion.along(site));
            }
            if let Some(rendered) = rendered {
                albedo[n] = rendered.albedo[site] as f32;
            }
            to[n] = (slot, sites.areas_m2[site]);
            n += 1;
        }
        if n == 0 {
            return;
        }
        let as_it_is = image.map(|image| AsItIs {
            image,
            albedo: &albedo,
        });
        let weighed = gaze.weighed(&surfels, along.as_ref(), as_it_is);
        for (lane, &(slot, area_m2)) in to[..n].iter().enumerate() {
            entries[slot] = Observation::of_lane(&weighed, lane, area_m2);
        }
    }
}
