//! What albedo a site has by itself, whatever group it is in: the median of the views that see it clear of depth edges, and how much
//! that says.

use super::MAX_VIEWS;
use super::observations::{Observation, Observations};
use super::sites::Sites;
use rayon::prelude::*;

/// A site that many views see tells twice what one does that so many see, and one that `FULLY_TOLD` see counts as one: those of
/// `pot-k1` are seen by four as a rule, those of a Kinect II's scan by ten or more.
const HALF_TOLD: f64 = 6.0;
const FULLY_TOLD: f64 = 14.0;

/// A site's own albedo by the views that see it, of which less than half may err: a leaf's shade or a rim that the base surface has
/// elsewhere is not in all of them. Unlike the robust ratio it does not depend on the group that the site is in.
#[derive(Clone, Copy, Debug)]
pub struct Median {
    /// Its logarithm; NaN where no view tells, as beside depth edges.
    pub log: f64,
    /// Views that tell as much, `(Σ s²)² / Σ s⁴`.
    n_views: f64,
}

impl Median {
    /// Of pairs of what is observed and predicted for albedo 1, one a view, weighted by the latter's square as in Eq. (2).
    fn of(pairs: impl Iterator<Item = (f64, f64)>) -> Median {
        let mut ratios = [(0.0, 0.0); MAX_VIEWS];
        let mut n_told = 0;
        for ((observed, s), ratio) in pairs.zip(&mut ratios) {
            *ratio = (observed / s, s * s);
            n_told += 1;
        }
        let ratios = &mut ratios[..n_told];
        ratios.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let (sum, squares) = ratios.iter().fold((0.0, 0.0), |(sum, squares), (_, w)| {
            (sum + w, squares + w * w)
        });
        let mut below = 0.0;
        let median = ratios.iter().find(|(_, weight)| {
            below += weight;
            2.0 * below >= sum
        });
        Median {
            log: median.map_or(f64::NAN, |(ratio, _)| ratio.ln()),
            n_views: sum * sum / squares,
        }
    }

    /// How much it counts in the choice of a group: what a view gets wrong does not go down with the sites that it shows.
    pub fn weight(&self) -> f64 {
        (1.0 + HALF_TOLD / FULLY_TOLD) * self.n_views / (self.n_views + HALF_TOLD)
    }
}

/// If fewer of the sites that views show are seen clear of depth edges, as of a wire alone, the others count as well; arbitrary.
const MIN_CLEAR_SHARE: f64 = 0.25;

/// The median of each site by what is clear of depth edges: pixels that mix make a rim of another material. Sites that are seen beside
/// edges alone are not told, and labelled as those round them, unless [most](MIN_CLEAR_SHARE) of the surface is such.
pub fn medians(sites: &Sites, observations: &Observations) -> Vec<Median> {
    let of_sites = |counts: fn(&Observation) -> bool| -> Vec<Median> {
        let indices = (0..sites.points.len()).into_par_iter();
        let pairs = |site: usize| {
            let normal = &sites.normals[site];
            let counting = observations
                .of(site)
                .iter()
                .filter(move |seen| counts(seen));
            counting.filter_map(move |seen| {
                let s = seen.unit_prediction(normal)?;
                Some((f64::from(seen.observed), s))
            })
        };
        indices.map(|site| Median::of(pairs(site))).collect()
    };
    let clear = of_sites(|seen| seen.is_clear);
    let n_told = clear.iter().filter(|median| !median.log.is_nan()).count();
    let shown = (0..clear.len()).filter(|&site| !observations.of(site).is_empty());
    match (n_told as f64) < MIN_CLEAR_SHARE * shown.count() as f64 {
        true => of_sites(|_| true),
        false => clear,
    }
}

#[cfg(test)]
mod tests {
    use super::super::scenes::{RippledPlane, calibration, optics, poses, rays, views};
    use super::super::sites::{SiteKind, ViewSet};
    use super::*;
    use crate::geometry::TriMesh;

    #[test]
    fn sites_are_told_by_what_is_clear_of_edges_or_by_all_of_a_narrow_strip() {
        let (rays, calibration) = (rays(), calibration());
        let optics = optics(&rays, &calibration);
        let flat = RippledPlane { amplitude_m: 0.0 };
        // The farthest from the middle across it that is told, and that is seen, metres.
        let reach = |mesh: &TriMesh| {
            let views = views(&flat, mesh, &optics, &poses(0.1));
            let sites = Sites::new(SiteKind::Vertex, mesh, &views, ViewSet::MAX);
            let told = medians(&sites, &Observations::new(&sites, &views, None, None));
            let of = |counts: &dyn Fn(usize) -> bool| {
                let counting = (0..told.len()).filter(|&site| counts(site));
                let across = counting.map(|site| mesh.vertices[site].y.abs());
                across.fold(0.0, f64::max)
            };
            let seen = sites.are_seen();
            (of(&|site| !told[site].log.is_nan()), of(&|site| seen[site]))
        };
        let mesh = flat.mesh(0.001);
        let strip = |half_m: f64| TriMesh {
            vertices: mesh.vertices.clone(),
            faces: {
                let is_in = |&corner: &u32| mesh.vertices[corner as usize].y.abs() < half_m;
                let faces = mesh.faces.iter().copied();
                faces.filter(|face| face.iter().all(is_in)).collect()
            },
        };
        let (told_m, seen_m) = reach(&strip(0.015));
        // By two pixels of 1.2 mm, or three; the live depth goes on beyond.
        let less_m = seen_m - told_m;
        assert!(told_m > 0.0 && (0.002..0.005).contains(&less_m), "{less_m}");
        let (told_m, seen_m) = reach(&strip(0.003));
        assert!(told_m > 0.0 && told_m == seen_m, "{told_m} {seen_m}");
    }

    #[test]
    fn shade_in_two_views_of_five_does_not_make_a_site_darker() {
        let lit = |s: f64| (0.4 * s, s);
        let shaded = |s: f64| (0.1 * s, s);
        let views = [lit(0.8), shaded(0.9), lit(1.0), lit(0.7), shaded(0.6)];
        let median = Median::of(views.into_iter());
        assert!((median.log - 0.4f64.ln()).abs() < 1e-12);
        assert!((4.0..5.0).contains(&median.n_views), "{median:?}");
        // What is seen aslant hardly counts.
        let aslant = Median::of([lit(1.0), shaded(0.1), shaded(0.1), shaded(0.1)].into_iter());
        assert!((aslant.log - 0.4f64.ln()).abs() < 1e-12);
        assert!((1.0..1.1).contains(&aslant.n_views), "{aslant:?}");
        assert!(aslant.weight() < 0.5 * median.weight());
        let seen_by_all = Median {
            n_views: FULLY_TOLD,
            ..median
        };
        assert!((seen_by_all.weight() - 1.0).abs() < 1e-12);
        assert!(Median::of(std::iter::empty()).log.is_nan());
    }
}
