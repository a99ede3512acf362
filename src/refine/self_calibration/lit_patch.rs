//! Patches of the surface as the views see them, integrated, so that only their rims count.

use crate::geometry::{cell_of, tangents};
use crate::refine::albedo::first_of_most;
use crate::refine::gaze::Gaze;
use crate::refine::optics::Optics;
use crate::refine::sites::Sites;
use crate::refine::view::View;
use crate::shading::Calibration;
use nalgebra::{Matrix3, Point3, SymmetricEigen, Vector3};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Side of a patch, metres: many facets, and yet nearly one distance to the light. Where facets are large so are patches, for as many.
const PATCH_M: f64 = 0.01;
const FACETS: f64 = 60.0;
/// Facets that a view must see of a patch.
const MIN_FACETS: usize = 20;
/// And the share of its area: where its rim is hidden by a fold or a tooth, that rim is the surface's error.
const MIN_SEEN_SHARE: f64 = 0.8;
/// Views that must see a patch: it has three unknowns of its own.
const MIN_VIEWS: usize = 4;
/// How far Eq. (1) is believed of a patch, as a share of its intensity.
const MODEL_SIGMA: f64 = 0.02;
/// Distance over which what surface and model get wrong goes together, metres. Shorter than alignment's, which has to withstand a
/// surface that is slowly wrong: here each patch has an albedo and a tilt of its own, which take that up.
const CORRELATION_M: f64 = 0.03;

/// A patch in one view.
pub struct Reading {
    /// The view's number.
    pub view: usize,
    /// Logarithm of the observed share of full scale.
    pub log_observed: f64,
    /// Logarithm of the flat field.
    pub log_flat: f64,
    /// Mean place and normal, camera frame, and the directions in which the normal may tilt; the normal is no unit vector.
    pub point: Point3<f64>,
    pub normal: Vector3<f64>,
    pub tilts: [Vector3<f64>; 2],
    /// Indirect light that arrives.
    pub indirect: Vector3<f64>,
    /// Standard deviation of the logarithm of the intensity.
    pub sigma: f64,
}

/// A patch of the surface with all its readings.
pub struct LitPatch {
    /// One for each view that sees enough of it.
    pub readings: Vec<Reading>,
    /// How many independent patches it stands for.
    pub share: f64,
    /// Logarithm of its albedo, and its tilts.
    pub own: Vector3<f64>,
    /// That of most of its facets.
    pub material: usize,
}

impl LitPatch {
    /// Cuts what the views see of a surface into patches. `materials` are those of the facets; without any all are of the first.
    pub fn all(sites: &Sites, views: &[View], optics: &Optics, materials: &[u8]) -> Vec<LitPatch> {
        let facet_m2 = sites.areas_m2.iter().sum::<f64>() / sites.points.len().max(1) as f64;
        let side_m = (FACETS * facet_m2).sqrt().max(PATCH_M);
        let mut cells: BTreeMap<[i32; 3], Vec<u32>> = BTreeMap::new();
        for (face, point) in sites.points.iter().enumerate() {
            if sites.visible[face] != 0 {
                let cell = cells.entry(cell_of(point, side_m)).or_default();
                cell.push(face as u32);
            }
        }
        let sides = cells.into_values().flat_map(|faces| sides(faces, sites));
        let cells: Vec<Vec<u32>> = sides.collect();
        let patch = |faces: &Vec<u32>| LitPatch::new(faces, sites, views, optics, materials);
        cells.par_iter().with_max_len(1).filter_map(patch).collect()
    }

    fn new(
        faces: &[u32],
        sites: &Sites,
        views: &[View],
        optics: &Optics,
        materials: &[u8],
    ) -> Option<LitPatch> {
        let facets = faces.iter().filter_map(|&face| {
            let face = face as usize;
            let area = sites.areas_m2[face];
            (area > 0.0).then(|| (face, sites.normals[face], area))
        });
        let facets: Vec<(usize, Vector3<f64>, f64)> = facets.collect();
        let area_m2: f64 = facets.iter().map(|(_, _, area)| area).sum();
        let mean: Vector3<f64> = facets.iter().map(|(_, normal, area)| normal * *area).sum();
        let mean = mean.try_normalize(0.0)?;
        let tilts = tangents(&mean)?;
        let readings = views.iter().enumerate().filter_map(|(index, view)| {
            let seen = facets.iter().copied();
            let seen = seen.filter(|(face, ..)| sites.visible[*face] >> index & 1 == 1);
            let seen: Vec<_> = seen
                .map(|(face, normal, area)| (&sites.points[face], normal, area))
                .collect();
            let seen_m2: f64 = seen.iter().map(|(.., area)| area).sum();
            (seen_m2 >= MIN_SEEN_SHARE * area_m2)
                .then(|| read(index, view, &seen, &tilts, optics.calibration))?
        });
        let readings: Vec<Reading> = readings.collect();
        (readings.len() >= MIN_VIEWS).then(|| LitPatch {
            readings,
            share: (area_m2 / (CORRELATION_M * CORRELATION_M)).min(1.0),
            own: Vector3::zeros(),
            material: commonest(faces, materials),
        })
    }
}

/// Facets of one place by the side that they face: a thin wall has two, of which no view sees both.
fn sides(faces: Vec<u32>, sites: &Sites) -> [Vec<u32>; 2] {
    let squares = faces.iter().map(|&face| {
        let normal = &sites.normals[face as usize];
        normal * normal.transpose() * sites.areas_m2[face as usize]
    });
    let squares = SymmetricEigen::new(squares.sum::<Matrix3<f64>>());
    let across = squares.eigenvectors.column(squares.eigenvalues.imax());
    let (front, back) = faces
        .into_iter()
        .partition(|&face| sites.normals[face as usize].dot(&across) >= 0.0);
    [front, back]
}

/// The material of most of some facets, the first of several; the first where there are none.
fn commonest(faces: &[u32], materials: &[u8]) -> usize {
    let of_faces = faces
        .iter()
        .filter_map(|&face| materials.get(face as usize));
    let mut counts = [0u32; 1 + u8::MAX as usize];
    of_faces.for_each(|&material| counts[material as usize] += 1);
    first_of_most(&counts)
}

/// Integrates what a view shows of facets (centroid, normal, area), world frame.
fn read(
    index: usize,
    view: &View,
    facets: &[(&Point3<f64>, Vector3<f64>, f64)],
    tilts: &[Vector3<f64>; 2],
    calibration: &Calibration,
) -> Option<Reading> {
    let (mut area, mut observed, mut weighted_log) = (0.0, 0.0, 0.0);
    let mut sums = [Vector3::zeros(); 3];
    let (mut n_facets, mut variance) = (0, 0.0);
    let points = facets.iter().map(|(point, ..)| *point);
    Gaze::new(view).each(points, |index, look| {
        let (_, normal, a) = facets[index];
        if look.observed.is_nan() || look.observed <= 0.0 {
            return;
        }
        let p = look.point_camera;
        let flat = calibration.flat_field.factor(p.x / p.z, p.y / p.z);
        let response = calibration.gamma * (look.observed * flat).ln();
        area += a;
        observed += a * look.observed;
        weighted_log += a * look.observed * response;
        for (sum, part) in sums.iter_mut().zip([p.coords, normal, look.indirect]) {
            *sum += part * a;
        }
        variance += (look.sigma / look.observed).powi(2);
        n_facets += 1;
    });
    let [point, normal, indirect] = sums.map(|sum| sum / area);
    let log_observed = weighted_log / observed;
    let turn = view.camera_from_world.rotation;
    let noise = variance.sqrt() / f64::from(n_facets);
    (n_facets as usize >= MIN_FACETS).then(|| Reading {
        view: index,
        log_observed,
        // So that, with the gamma of the image, the reading is the logarithm of the mean intensity.
        log_flat: log_observed / calibration.gamma - (observed / area).ln(),
        point: Point3::from(point),
        normal: turn * normal,
        tilts: tilts.map(|tilt| turn * tilt),
        indirect,
        sigma: noise.hypot(MODEL_SIGMA),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::TriMesh;
    use crate::refine::scenes::RippledPlane;
    use crate::refine::sites::SiteKind;

    #[test]
    fn both_sides_of_a_thin_wall_are_patches() {
        let front = RippledPlane {
            amplitude_m: 0.0004,
        };
        let front = front.mesh(0.0015);
        let n = front.vertices.len() as u32;
        let back = front.vertices.iter().map(|p| p + 0.002 * Vector3::z());
        let wall = TriMesh {
            vertices: front.vertices.iter().copied().chain(back).collect(),
            faces: front
                .faces
                .iter()
                .copied()
                .chain(front.faces.iter().map(|&[a, b, c]| [a + n, c + n, b + n]))
                .collect(),
        };
        let sites = Sites::unseen(SiteKind::Face, &wall);
        let both = sides((0..wall.faces.len() as u32).collect(), &sites);
        for side in &both {
            assert_eq!(side.len(), front.faces.len());
            let normals = side.iter().map(|&face| sites.normals[face as usize]);
            assert!(normals.sum::<Vector3<f64>>().norm() > 0.9 * side.len() as f64);
        }
        // What is seen from one side alone is one.
        let [one, none] = sides((0..front.faces.len() as u32).collect(), &sites);
        assert_eq!(one.len() + none.len(), front.faces.len());
        assert!(one.is_empty() || none.is_empty());
    }
}
