//! The paper's own way to albedo groups, Sec. 4.2: sites are points (κx, cρ) in four dimensions, their number of groups is that
//! of the principal components that hold 95 % of the variance, the groups come from K-means, and the costs of Eq. (4) from
//! the distances to their centres.
//!
//! The paper leaves κ and the costs open. Here position and albedo are each scaled to unit variance and position counts κ
//! times; a label costs its squared distance over twice the variance within the groups. It is there for comparison: the number
//! of components says how many directions the features have, not how many materials there are.

use nalgebra::{Matrix4, Point3, Vector4};

/// Sites grouped by position and albedo.
pub struct Clusters {
    centres: Vec<Vector4<f64>>,
    /// Feature of each site; `None` where nobody sees it.
    features: Vec<Option<Vector4<f64>>>,
    /// Variance within the groups.
    variance: f64,
}

/// Weight of position, κ; arbitrary.
const KAPPA: f64 = 0.3;
/// Share of the variance that the components must hold.
const HELD: f64 = 0.95;
/// Sites that K-means looks at, at most.
const MAX_POINTS: usize = 20_000;
/// Iterations of K-means at most.
const MAX_ITERATIONS: usize = 50;

impl Clusters {
    /// Groups sites by their places and albedos, of which those that are not finite do not count, into `max_groups` at most.
    /// `None` without any.
    pub fn fit(places: &[Point3<f64>], albedo: &[f64], max_groups: usize) -> Option<Clusters> {
        let seen = || (0..albedo.len()).filter(|&site| albedo[site].is_finite());
        let raw = |site: usize| places[site].coords.push(albedo[site]);
        let n = seen().count() as f64;
        if n == 0.0 {
            return None;
        }
        let mean = seen().map(raw).sum::<Vector4<f64>>() / n;
        let square = |v: Vector4<f64>| v.component_mul(&v);
        let variances = seen()
            .map(|site| square(raw(site) - mean))
            .sum::<Vector4<f64>>()
            / n;
        // One scale for all three axes: the shape of the object is kept.
        let position = KAPPA / variances.xyz().mean().sqrt().max(f64::MIN_POSITIVE);
        let brightness = 1.0 / variances.w.sqrt().max(f64::MIN_POSITIVE);
        let scale = Vector4::new(position, position, position, brightness);
        let feature = |site: usize| {
            let is_seen = albedo[site].is_finite();
            is_seen.then(|| (raw(site) - mean).component_mul(&scale))
        };
        let features: Vec<_> = (0..albedo.len()).map(feature).collect();
        let points: Vec<_> = features.iter().flatten().copied().collect();
        let points: Vec<_> = points
            .iter()
            .step_by(points.len().div_ceil(MAX_POINTS))
            .copied()
            .collect();
        let centres = means(&points, n_components(&points).min(max_groups));
        let within = points
            .iter()
            .map(|point| (point - nearest(&centres, point).1).norm_squared());
        Some(Clusters {
            variance: (within.sum::<f64>() / points.len() as f64).max(1e-9),
            centres,
            features,
        })
    }

    /// Number of groups.
    pub fn len(&self) -> usize {
        self.centres.len()
    }

    /// The data term of Eq. (4): cost of a group for a site; nothing for one that nobody sees.
    pub fn cost(&self, site: usize, group: usize) -> f64 {
        self.features[site].map_or(0.0, |feature| {
            (feature - self.centres[group]).norm_squared() / (2.0 * self.variance)
        })
    }
}

/// How many principal components hold 95 % of the variance.
fn n_components(points: &[Vector4<f64>]) -> usize {
    let mean = points.iter().sum::<Vector4<f64>>() / points.len() as f64;
    let deviations = points.iter().map(|point| point - mean);
    let covariance = deviations.map(|d| d * d.transpose()).sum::<Matrix4<f64>>();
    let mut variances: [f64; 4] = covariance.symmetric_eigenvalues().into();
    variances.sort_unstable_by(|a, b| b.total_cmp(a));
    let target = HELD * variances.iter().sum::<f64>();
    let mut held = 0.0;
    let enough = variances.iter().position(|variance| {
        held += variance;
        held >= target
    });
    enough.map_or(4, |last| last + 1)
}

/// K-means from centres that are each the point farthest from those before, the first the one farthest from the mean.
fn means(points: &[Vector4<f64>], k: usize) -> Vec<Vector4<f64>> {
    let mut centres = vec![points.iter().sum::<Vector4<f64>>() / points.len() as f64];
    for _ in 0..k {
        let distance = |point: &Vector4<f64>| (point - nearest(&centres, point).1).norm_squared();
        let farthest = points
            .iter()
            .max_by(|a, b| distance(a).total_cmp(&distance(b)));
        centres.extend(farthest.copied());
    }
    centres.remove(0);
    for _ in 0..MAX_ITERATIONS {
        let mut sums = vec![(Vector4::zeros(), 0.0); centres.len()];
        for point in points {
            let (sum, n): &mut (Vector4<f64>, f64) = &mut sums[nearest(&centres, point).0];
            *sum += point;
            *n += 1.0;
        }
        let moved = centres.iter().zip(&sums);
        let moved: Vec<_> = moved
            .map(|(centre, (sum, n))| if *n > 0.0 { sum / *n } else { *centre })
            .collect();
        let is_still = moved
            .iter()
            .zip(&centres)
            .all(|(a, b)| (a - b).norm() < 1e-9);
        centres = moved;
        if is_still {
            break;
        }
    }
    // In the order of their albedos, as all labels are.
    centres.sort_unstable_by(|a, b| a.w.total_cmp(&b.w));
    centres
}

/// The nearest centre and its number.
fn nearest<'a>(centres: &'a [Vector4<f64>], point: &Vector4<f64>) -> (usize, &'a Vector4<f64>) {
    let mut best = (0, &centres[0]);
    for (index, centre) in centres.iter().enumerate().skip(1) {
        if (point - centre).norm_squared() < (point - best.1).norm_squared() {
            best = (index, centre);
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::super::scenes::RippledPlane;
    use super::*;
    use crate::geometry::TriMesh;

    fn centroids(mesh: &TriMesh) -> Vec<Point3<f64>> {
        (0..mesh.faces.len())
            .map(|face| mesh.centroid(face))
            .collect()
    }

    /// A plane whose albedo is a step at its middle, with a little noise.
    fn halves() -> (Vec<Point3<f64>>, Vec<f64>) {
        let mesh = RippledPlane { amplitude_m: 0.0 }.mesh(0.002);
        let albedo = (0..mesh.faces.len())
            .map(|face| {
                let noise = 0.01 * ((face as f64 * 0.618_034).fract() - 0.5);
                noise
                    + if mesh.centroid(face).x < 0.0 {
                        0.1
                    } else {
                        0.3
                    }
            })
            .collect();
        (centroids(&mesh), albedo)
    }

    #[test]
    fn two_albedos_fall_into_groups_of_their_own() {
        let (centroids, mut albedo) = halves();
        albedo[7] = f64::NAN;
        let clusters = Clusters::fit(&centroids, &albedo, 4).unwrap();
        assert!(clusters.len() >= 2);
        assert_eq!(
            (0..clusters.len())
                .map(|group| clusters.cost(7, group))
                .sum::<f64>(),
            0.0
        );
        let group_of = |face: usize| {
            let costs = (0..clusters.len()).map(|group| clusters.cost(face, group));
            let costs: Vec<f64> = costs.collect();
            (0..costs.len())
                .min_by(|&a, &b| costs[a].total_cmp(&costs[b]))
                .unwrap()
        };
        // No group holds sites of both materials.
        let mut materials = vec![[0; 2]; clusters.len()];
        for face in (0..albedo.len()).filter(|&face| albedo[face].is_finite()) {
            materials[group_of(face)][usize::from(albedo[face] > 0.2)] += 1;
        }
        assert!(
            materials.iter().all(|[dark, bright]| dark * bright == 0),
            "{materials:?}"
        );
    }

    #[test]
    fn nothing_seen_gives_no_groups() {
        let mesh = RippledPlane { amplitude_m: 0.0 }.mesh(0.01);
        assert!(Clusters::fit(&centroids(&mesh), &vec![f64::NAN; mesh.faces.len()], 4).is_none());
    }
}
