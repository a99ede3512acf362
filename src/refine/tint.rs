//! Slow changes of albedo within a group: stains, worn paint, the grain of a stone.
//!
//! What every view shows too dark by the same share, wherever its light stood, is albedo and not shape: a tilt looks darker from
//! one side and brighter from the other. So the mean over all views and a patch of the base surface tells the albedo there, as far as
//! depth knows the surface. How much of it is believed the patches say together, by how much more they differ than shape makes
//! them. It is told once, before anything moves: left to later rounds it went over into the shape, which explained the rest
//! of each round.

use super::albedo::Ratio;
use super::sites::Sites;
use crate::geometry::PointGrid;
use crate::shading::median_absolute_deviation;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Side of a patch, metres: depth holds the tilt of larger ones.
const PATCH_M: f64 = 0.015;
/// Distance over which tints go over into one another, metres.
const REACH_M: f64 = 0.025;
/// Patches of fewer sites tell nothing, nor do sites that fewer views see: one view cannot tell albedo from shape.
const MIN_SITES: usize = 8;
const MIN_VIEWS: u32 = 4;
/// Standard deviation of the logarithm of a patch's brightness that has other causes: tilts of the fused surface, light over other
/// surfaces. Patches of one albedo differ by 0.006 to 0.023 on fused surfaces.
const OTHER_CAUSES: f64 = 0.02;
/// A larger change is another material or a shadow; arbitrary.
const MAX_LOG_TINT: f64 = 0.35;

/// What a patch of one group tells.
struct Patch {
    label: u8,
    place: Point3<f64>,
    /// Logarithm of its albedo over the group's.
    log: f64,
}

/// By which factor the albedo of each site differs from its group's; `ratios` are the sites' own albedos. All are 1 where patches
/// differ by no more than shape explains.
pub fn tints(sites: &Sites, labels: &[u8], groups: &[f64], ratios: &[Ratio]) -> Vec<f64> {
    let patches = patches(sites, labels, groups, ratios);
    let mut logs: Vec<f64> = patches.iter().map(|patch| patch.log).collect();
    let variance = median_absolute_deviation(&mut logs).powi(2);
    let own = variance - OTHER_CAUSES * OTHER_CAUSES;
    if own <= 0.0 {
        return vec![1.0; labels.len()];
    }
    let believed = own / variance;
    let places = patches.iter().map(|patch| patch.place).collect();
    let grid = PointGrid::new(places, REACH_M);
    let tint = |(point, &label): (&Point3<f64>, &u8)| {
        let near = grid.near(point).map(|index| &patches[index]);
        let (sum, weights) =
            near.filter(|patch| patch.label == label)
                .fold((0.0, 0.0), |(sum, weights), patch| {
                    let inside = 1.0 - (patch.place - point).norm_squared() / (REACH_M * REACH_M);
                    let weight = inside * inside;
                    (sum + weight * patch.log, weights + weight)
                });
        match weights > 0.0 {
            true => (believed * sum / weights).exp(),
            false => 1.0,
        }
    };
    sites.points.par_iter().zip(labels).map(tint).collect()
}

fn patches(sites: &Sites, labels: &[u8], groups: &[f64], ratios: &[Ratio]) -> Vec<Patch> {
    let mut cells: BTreeMap<(u8, [i32; 3]), Vec<usize>> = BTreeMap::new();
    for (site, point) in sites.points.iter().enumerate() {
        if ratios[site].1 > 0.0 && sites.visible[site].count_ones() >= MIN_VIEWS {
            let cell = [point.x, point.y, point.z].map(|x| (x / PATCH_M).floor() as i32);
            cells.entry((labels[site], cell)).or_default().push(site);
        }
    }
    let patch = |((label, _), of_patch): ((u8, _), Vec<usize>)| {
        let places = of_patch.iter().map(|&site| sites.points[site].coords);
        let place = places.sum::<Vector3<f64>>() / of_patch.len() as f64;
        let (n, d) = of_patch.iter().fold((0.0, 0.0), |(n, d), &site| {
            (n + ratios[site].0, d + ratios[site].1)
        });
        let log = (n / (d * groups[label as usize])).ln();
        (of_patch.len() >= MIN_SITES && log.abs() < MAX_LOG_TINT).then(|| Patch {
            label,
            place: Point3::from(place),
            log,
        })
    };
    cells.into_iter().filter_map(patch).collect()
}

#[cfg(test)]
mod tests {
    use super::super::site_gloss::SiteGloss;
    use super::super::sites::SiteKind;
    use super::*;

    /// A plane of 0.2 m, seen by so many views, of two groups of sites beside one another.
    fn plane(n_views: u32) -> (Sites, Vec<u8>) {
        let points: Vec<Point3<f64>> = (0..200)
            .flat_map(|i| (0..200).map(move |j| Point3::new(1e-3 * i as f64, 1e-3 * j as f64, 0.5)))
            .collect();
        let labels = points.iter().map(|point| u8::from(point.x > 0.1)).collect();
        let n = points.len();
        let sites = Sites {
            kind: SiteKind::Face,
            normals: vec![-Vector3::z(); n],
            areas_m2: vec![1e-6; n],
            visible: vec![(1 << n_views) - 1; n],
            gloss: SiteGloss::default(),
            points,
        };
        (sites, labels)
    }

    const GROUPS: [f64; 2] = [0.3, 0.7];

    fn told(n_views: u32, tint: impl Fn(&Point3<f64>) -> f64) -> (Vec<f64>, Vec<f64>) {
        let (sites, labels) = plane(n_views);
        let truth: Vec<f64> = sites.points.iter().map(tint).collect();
        let ratios: Vec<Ratio> = truth
            .iter()
            .zip(&labels)
            .map(|(tint, &label)| (2.0 * tint * GROUPS[label as usize], 2.0))
            .collect();
        (tints(&sites, &labels, &GROUPS, &ratios), truth)
    }

    #[test]
    fn a_stain_is_told_in_either_group() {
        let (found, truth) = told(6, |p| 1.0 + 0.12 * (30.0 * p.x).sin() * (40.0 * p.y).cos());
        let square: f64 = found.iter().zip(&truth).map(|(f, t)| (f - t).powi(2)).sum();
        let rms = (square / truth.len() as f64).sqrt();
        assert!(rms < 0.025, "{rms} of a stain of 0.06");
    }

    #[test]
    fn what_shape_may_have_made_is_left_to_it() {
        let (found, _) = told(6, |p| 1.0 + 0.015 * (30.0 * p.x).sin());
        assert!(found.iter().all(|&tint| tint == 1.0));
    }

    #[test]
    fn few_views_tell_no_stain() {
        let (found, _) = told(3, |p| 1.0 + 0.12 * (30.0 * p.x).sin());
        assert!(found.iter().all(|&tint| tint == 1.0));
    }
}
