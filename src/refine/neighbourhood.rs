//! What of Eq. (4) depends on where sites are: how much neighbours hold together, and which of them belong to one part.

use super::sites::{SiteKind, Sites};
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// What sites of one kind are to their neighbours.
#[derive(Clone, Copy, Debug)]
pub struct Neighbourhood {
    /// Cost of each neighbour in another group, in units of an independent negative log likelihood: V.
    pub potts: f64,
    /// So many neighbours err together; what they tell must not be taken for independent.
    pub n_correlated: f64,
    /// Parts of an object meet where neighbours are folded towards one another by more.
    max_fold_cosine: f64,
}

impl Neighbourhood {
    /// Of a kind of sites.
    pub fn of(kind: SiteKind) -> Self {
        match kind {
            // 45°; less and more label `pot-k1` worse.
            SiteKind::Face => Neighbourhood {
                potts: 1.5,
                n_correlated: 50.0,
                max_fold_cosine: 0.7,
            },
            // Half as many on the same surface, of which a border parts twice as many pairs, so that each costs less; what is painted
            // too finely for that is left to tints. The normal of one in a fold is half turned, 23°.
            SiteKind::Vertex => Neighbourhood {
                potts: 1.0,
                n_correlated: 25.0,
                max_fold_cosine: 0.92,
            },
        }
    }

    /// The pairs of neighbours but for those across a concave fold: there parts meet (Hoffman and Richards 1984), which may well be
    /// of two materials.
    pub fn within_parts(&self, sites: &Sites, neighbours: &[[u32; 2]]) -> Vec<[u32; 2]> {
        let is_within = |pair: &&[u32; 2]| {
            let places = pair.map(|site| &sites.points[site as usize]);
            let normals = pair.map(|site| &sites.normals[site as usize]);
            !self.is_fold(places, normals)
        };
        neighbours.par_iter().filter(is_within).copied().collect()
    }

    /// Whether two sites, given by their places and normals, meet in a concave fold.
    fn is_fold(&self, places: [&Point3<f64>; 2], normals: [&Vector3<f64>; 2]) -> bool {
        let [normal, beyond] = normals;
        let along = places[1] - places[0];
        (beyond - normal).dot(&along) < 0.0 && normal.dot(beyond) < self.max_fold_cosine
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_meet_in_concave_folds_and_not_at_convex_edges() {
        let of_faces = Neighbourhood::of(SiteKind::Face);
        let floor = (Point3::new(-0.01, 0.0, 0.0), Vector3::z());
        let rising = |slope_deg: f64| {
            let (sin, cos) = slope_deg.to_radians().sin_cos();
            let place = Point3::new(0.01 * cos, 0.0, 0.01 * sin);
            (place, Vector3::new(-sin, 0.0, cos))
        };
        let is_fold = |slope_deg: f64| {
            let wall = rising(slope_deg);
            let one_way = of_faces.is_fold([&floor.0, &wall.0], [&floor.1, &wall.1]);
            let other_way = of_faces.is_fold([&wall.0, &floor.0], [&wall.1, &floor.1]);
            assert_eq!(one_way, other_way);
            one_way
        };
        assert!(is_fold(90.0) && is_fold(50.0));
        assert!(!is_fold(30.0) && !is_fold(0.0) && !is_fold(-50.0) && !is_fold(-90.0));
    }
}
