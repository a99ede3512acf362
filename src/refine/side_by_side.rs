//! Neighbouring sites side by side, one a lane: what is asked of each over its views becomes vector code, with the bits that each would
//! have alone.

use super::observations::{Observation, Observations};
use super::surface::Surface;
use super::tiles::TILE;
use nalgebra::Vector3;
use rayon::prelude::*;
use std::array::from_fn;
use std::ops::Range;

/// Sites that go through a kernel together.
pub const SITES: usize = 8;
/// One value for each of them.
pub type OfSites = [f64; SITES];
/// Unit normal of each of them, in the surface's frame; `None` where nothing is asked of one, or there is none.
pub type UnitNormals = [Option<Vector3<f64>>; SITES];

/// What becomes of `n` sites, [`SITES`] of them at once: `of` is given the numbers of some, fewer only at the end, and room for what their
/// views show; what it says of lanes without a site is left out.
pub fn map_sites<T: Send>(
    n: usize,
    of: impl Fn(Range<usize>, &mut Vec<Seen>) -> [T; SITES] + Sync,
) -> Vec<T> {
    let chunks = (0..n.div_ceil(SITES)).into_par_iter();
    let chunks = chunks.with_min_len(TILE / SITES).with_max_len(TILE / SITES);
    let of_chunk = |room: &mut Vec<Seen>, chunk: usize| {
        let first = chunk * SITES;
        of(first..(first + SITES).min(n), room)
    };
    let all: Vec<[T; SITES]> = chunks.map_init(Vec::new, of_chunk).collect();
    let mut all = all.into_flattened();
    all.truncate(n);
    all
}

/// Normals of these sites, [`SITES`] at most, by the number of each.
#[inline(always)]
pub fn unit_normals(
    sites: Range<usize>,
    of: impl Fn(usize) -> Option<Vector3<f64>>,
) -> UnitNormals {
    from_fn(|lane| {
        let site = sites.start + lane;
        if site < sites.end { of(site) } else { None }
    })
}

/// What one view shows of each site, as of [`Observation`]; all of it is finite. Where a site has fewer views than others, nothing of it is
/// covered.
#[derive(Clone, Copy, Default)]
pub struct Seen {
    observed: [f32; SITES],
    light: [[f32; SITES]; 3],
    covered: [f32; SITES],
    image_slope: [f32; SITES],
    light_slope: [f32; SITES],
}

/// What one view shows of each site where it is, and what it would show for unit albedo: 0 where the light does not reach it.
#[derive(Clone, Copy)]
pub struct Shown {
    /// Observed intensity, in its standard deviations.
    pub observed: OfSites,
    /// Predicted for unit albedo, in the same unit.
    pub unit: OfSites,
    /// As of [`Observation::covered`].
    pub covered: OfSites,
}

/// How sites lie, and how many views show each.
#[derive(Clone, Copy, Default)]
pub struct Placed {
    /// Unit normal of each, in the surface's frame.
    pub normals: [OfSites; 3],
    /// How far each has moved along its direction, metres.
    pub moved_m: OfSites,
    /// Views that show it; none of one without a normal.
    pub n_views: [usize; SITES],
}

impl Placed {
    /// Those from the `first` on that have a normal; the room becomes what views show of them.
    #[inline(always)]
    pub fn new(
        observations: &Observations,
        surface: &Surface,
        first: usize,
        normals: &UnitNormals,
        room: &mut Vec<Seen>,
    ) -> Placed {
        room.clear();
        let mut placed = Placed::default();
        for (lane, normal) in normals.iter().enumerate() {
            let Some(normal) = normal else { continue };
            let site = first + lane;
            for (axis, of_sites) in placed.normals.iter_mut().enumerate() {
                of_sites[lane] = normal[axis];
            }
            placed.moved_m[lane] = observations.moved_m(surface, site);
            let views = observations.of(site);
            placed.n_views[lane] = views.len();
            Seen::set_views(room, lane, views);
        }
        placed
    }
}

impl Seen {
    /// Writes the views of one site; `all` grows to as many as any has.
    #[inline(always)]
    pub fn set_views(all: &mut Vec<Seen>, lane: usize, views: &[Observation]) {
        if all.len() < views.len() {
            all.resize(views.len(), Seen::default());
        }
        for (seen, view) in all.iter_mut().zip(views) {
            seen.observed[lane] = view.observed;
            for axis in 0..3 {
                seen.light[axis][lane] = view.light[axis];
            }
            seen.covered[lane] = view.covered;
            seen.image_slope[lane] = view.image_slope;
            seen.light_slope[lane] = view.light_slope;
        }
    }

    /// What it shows of the sites where they are.
    #[inline(always)]
    pub fn shown(&self, placed: &Placed) -> Shown {
        let Placed {
            normals, moved_m, ..
        } = placed;
        let mut shown = Shown {
            observed: [0.0; SITES],
            unit: [0.0; SITES],
            covered: [0.0; SITES],
        };
        for i in 0..SITES {
            let light = |axis: usize| f64::from(self.light[axis][i]) * normals[axis][i];
            let lit = light(0) + light(1) + light(2);
            let unit = lit + f64::from(self.light_slope[i]) * moved_m[i];
            shown.covered[i] = f64::from(self.covered[i]);
            shown.unit[i] = if unit > 0.0 { unit } else { 0.0 };
            shown.observed[i] =
                f64::from(self.observed[i]) + f64::from(self.image_slope[i]) * moved_m[i];
        }
        shown
    }

    /// Derivatives of the residuals of sites with these albedos by their unit normals and, per metre, by their motion.
    #[inline(always)]
    pub fn by_normal_and_motion(&self, albedo: &OfSites) -> [OfSites; 4] {
        let mut rows = [[0.0; SITES]; 4];
        let [by_x, by_y, by_z, by_motion] = &mut rows;
        for (by_axis, light) in [by_x, by_y, by_z].into_iter().zip(&self.light) {
            for i in 0..SITES {
                by_axis[i] = f64::from(light[i]) * -albedo[i];
            }
        }
        for i in 0..SITES {
            let [image, light] = [&self.image_slope, &self.light_slope].map(|of| f64::from(of[i]));
            by_motion[i] = image - albedo[i] * light;
        }
        rows
    }
}

impl Shown {
    /// Eq. (6): observed less predicted intensity, in sigmas.
    #[inline(always)]
    pub fn residuals(&self, albedo: &OfSites) -> OfSites {
        let mut residuals = [0.0; SITES];
        for i in 0..SITES {
            residuals[i] = self.observed[i] - albedo[i] * self.unit[i];
        }
        residuals
    }
}
