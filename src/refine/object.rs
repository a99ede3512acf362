//! Which part of a base mesh is the object: what stands above the dominant plane where the cameras looked, with the parts
//! that touch it; or what lies in a box.

use crate::geometry::{EdgeAdjacency, MIN_PART_AREA_M2, Plane, Pose, TriMesh, cell_of};
use crate::snapshot::attention;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use std::cmp::Ordering;
use std::collections::BTreeMap;

/// An axis-aligned box in the world frame, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Roi {
    /// Smallest coordinates.
    pub min: Point3<f64>,
    /// Largest coordinates.
    pub max: Point3<f64>,
}

/// A face belongs to a plane within this distance, metres: three sigmas of fused depth.
const PLANE_REACH_M: f64 = 0.006;
/// Times that the best plane is fitted anew to the faces on it, at most; it ends before where that brings no more surface onto it.
/// Arbitrary.
const PLANE_FITS: usize = 5;
/// What is lower than this above the plane is the plane, metres.
const STAND_OFF_M: f64 = 0.006;
/// ... unless the object encloses it, at so much of its border, and it lies higher than this above the plane in the mean,
/// metres: the floor of a bowl does; the table within a ring lies lower, and what lies apart in shadows has a border of its own.
const FLOOR_MIN_ENCLOSED: f64 = 0.9;
const FLOOR_MIN_HEIGHT_M: f64 = 0.002;
/// Parts nearer to each other than this touch, metres; leaves of a plant leave gaps of a few voxels.
const TOUCH_M: f64 = 0.008;
/// Of so many faces one is asked how near the optical axes it lies, in which neighbours in a list of faces hardly differ.
const ATTENTION_EVERY: usize = 4;
/// ... and of all cameras about so many, spread over the scan: enough for every side that was looked from. Arbitrary.
const ATTENTION_CAMERAS: usize = 24;

/// The faces of the base mesh inside a box.
pub fn select_roi(mesh: &TriMesh, roi: &Roi) -> TriMesh {
    let inside =
        |p: &Point3<f64>| (0..3).all(|axis| p[axis] >= roi.min[axis] && p[axis] <= roi.max[axis]);
    mesh.filter_faces(|face| mesh.corners(face).iter().all(inside))
}

/// The object that the cameras looked at, and the plane it stands on, if there is one; the mesh is empty if nothing is left.
pub fn select_object(mesh: &TriMesh, world_from_cameras: &[Pose]) -> (TriMesh, Option<Plane>) {
    let plane = dominant_plane(mesh);
    let stands = |vertex: &Point3<f64>| {
        let height_m = plane.as_ref().map(|plane| plane.height_m(vertex));
        height_m.is_none_or(|height_m| height_m > STAND_OFF_M)
    };
    let vertex_stands: Vec<bool> = mesh.vertices.iter().map(stands).collect();
    let face_stands = |face: usize| {
        mesh.faces[face]
            .iter()
            .all(|&at| vertex_stands[at as usize])
    };
    let (high, low): (Vec<usize>, Vec<usize>) =
        (0..mesh.faces.len()).partition(|&face| face_stands(face));
    let standing = mesh.filter_faces(face_stands);
    let (labels, n_parts) = standing.face_components();
    let parts = measure_parts(&standing, &labels, n_parts, world_from_cameras);
    let Some(main) = (0..n_parts).max_by(|&a, &b| parts[a].compare(&parts[b])) else {
        return (TriMesh::default(), plane);
    };
    let kept = touching_parts(&standing, &labels, &parts, main);
    let mut is_object = vec![false; mesh.faces.len()];
    for (&face, &label) in high.iter().zip(&labels) {
        is_object[face] = kept[label as usize];
    }
    if let Some(plane) = &plane {
        for face in floors(mesh, &low, &is_object, plane) {
            is_object[face] = true;
        }
    }
    (mesh.filter_faces(|face| is_object[face]), plane)
}

/// Those of the `low` faces that the object encloses and that lie clearly above the plane, such as the floor of a bowl.
fn floors(mesh: &TriMesh, low: &[usize], is_object: &[bool], plane: &Plane) -> Vec<usize> {
    let mut of_object = vec![false; mesh.vertices.len()];
    for (corners, _) in mesh.faces.iter().zip(is_object).filter(|(_, is)| **is) {
        corners.iter().for_each(|&at| of_object[at as usize] = true);
    }
    let below = TriMesh {
        vertices: mesh.vertices.clone(),
        faces: low.iter().map(|&face| mesh.faces[face]).collect(),
    };
    let (labels, n_parts) = below.face_components();
    // Walls go up from the floor: of the faces that reach higher only the corners that do not are of it.
    let (mut n_corners, mut sum_of_heights_m) = (vec![0_u32; n_parts], vec![0.0; n_parts]);
    for (corners, &label) in below.faces.iter().zip(&labels) {
        for &at in corners {
            let height_m = plane.height_m(&below.vertices[at as usize]);
            if height_m <= STAND_OFF_M {
                n_corners[label as usize] += 1;
                sum_of_heights_m[label as usize] += height_m;
            }
        }
    }
    let is_raised = |label: u32| {
        let n_corners = f64::from(n_corners[label as usize]);
        sum_of_heights_m[label as usize] > FLOOR_MIN_HEIGHT_M * n_corners
    };
    let raised = TriMesh {
        faces: (below.faces.iter().zip(&labels))
            .filter(|(_, label)| is_raised(**label))
            .map(|(corners, _)| *corners)
            .collect(),
        ..below
    };
    let mut part_of = vec![0; mesh.vertices.len()];
    for (face, &label) in low.iter().zip(&labels) {
        mesh.faces[*face]
            .iter()
            .for_each(|&at| part_of[at as usize] = label as usize);
    }
    let (mut n_border, mut n_enclosed) = (vec![0_u32; n_parts], vec![0_u32; n_parts]);
    let edges = EdgeAdjacency::new(&raised);
    for (&[p, q], &n_faces) in edges.edges.iter().zip(&edges.n_faces) {
        if n_faces == 1 {
            let part = part_of[p as usize];
            n_border[part] += 1;
            n_enclosed[part] += u32::from(of_object[p as usize] && of_object[q as usize]);
        }
    }
    let is_floor = |label: u32| {
        let enclosed = f64::from(n_enclosed[label as usize]);
        // A part without any border has nothing to do with the object.
        is_raised(label)
            && enclosed > 0.0
            && enclosed >= FLOOR_MIN_ENCLOSED * f64::from(n_border[label as usize])
    };
    let of_floors = low
        .iter()
        .zip(&labels)
        .filter(|(_, label)| is_floor(**label));
    of_floors.map(|(&face, _)| face).collect()
}

#[derive(Clone, Copy, Default)]
struct Part {
    area_m2: f64,
    /// Area of one face in [`ATTENTION_EVERY`], weighted by nearness to the optical axes.
    attention: f64,
}

impl Part {
    /// By attention; parts of too few faces to have any, by area.
    fn compare(&self, other: &Part) -> Ordering {
        let by_attention = self.attention.total_cmp(&other.attention);
        by_attention.then(self.area_m2.total_cmp(&other.area_m2))
    }
}

fn measure_parts(
    mesh: &TriMesh,
    labels: &[u32],
    n_parts: usize,
    world_from_cameras: &[Pose],
) -> Vec<Part> {
    let mut parts = vec![Part::default(); n_parts];
    let every = world_from_cameras.len().div_ceil(ATTENTION_CAMERAS).max(1);
    let cameras: Vec<Pose> = world_from_cameras
        .iter()
        .step_by(every)
        .map(Pose::inverse)
        .collect();
    let of_face = |face: usize| {
        let area_m2 = 0.5 * mesh.face_normal(face).norm();
        if !face.is_multiple_of(ATTENTION_EVERY) {
            return (area_m2, 0.0);
        }
        let centroid = mesh.centroid(face);
        let nearness = |camera_from_world: &Pose| {
            let point = camera_from_world * centroid;
            attention(point.x.hypot(point.y).atan2(point.z))
        };
        let attention: f64 = cameras.iter().map(nearness).sum();
        (area_m2, area_m2 * attention)
    };
    let of_faces: Vec<(f64, f64)> = (0..labels.len()).into_par_iter().map(of_face).collect();
    for (&label, (area_m2, attention)) in labels.iter().zip(of_faces) {
        let part = &mut parts[label as usize];
        part.area_m2 += area_m2;
        part.attention += attention;
    }
    parts
}

/// The parts connected to `main` by gaps of less than `TOUCH_M`, noise left out.
fn touching_parts(mesh: &TriMesh, labels: &[u32], parts: &[Part], main: usize) -> Vec<bool> {
    // Parts meet where their vertices share a cell of a grid, or neighbouring cells.
    let mut cells: BTreeMap<[i32; 3], Vec<u32>> = BTreeMap::new();
    for (face, &label) in labels.iter().enumerate() {
        if parts[label as usize].area_m2 < MIN_PART_AREA_M2 {
            continue;
        }
        let cell = cells
            .entry(cell_of(&mesh.centroid(face), TOUCH_M))
            .or_default();
        if !cell.contains(&label) {
            cell.push(label);
        }
    }
    let mut touches: Vec<Vec<u32>> = vec![Vec::new(); parts.len()];
    for (cell, here) in &cells {
        for step in 0..27 {
            let next = [
                cell[0] + step % 3 - 1,
                cell[1] + step / 3 % 3 - 1,
                cell[2] + step / 9 - 1,
            ];
            let Some(there) = cells.get(&next) else {
                continue;
            };
            for &a in here {
                touches[a as usize].extend(there.iter().filter(|&&b| b != a));
            }
        }
    }
    let mut kept = vec![false; parts.len()];
    kept[main] = true;
    let mut pending = vec![main];
    while let Some(part) = pending.pop() {
        for &next in &touches[part] {
            if !kept[next as usize] {
                kept[next as usize] = true;
                pending.push(next as usize);
            }
        }
    }
    kept
}

/// The plane that holds most of the surface, by RANSAC over oriented faces and a least-squares fit of its inliers.
pub fn dominant_plane(mesh: &TriMesh) -> Option<Plane> {
    /// Faces looked at, and planes tried: enough for a plane of 15 % to be met 60 times.
    const MAX_FACES: usize = 40_000;
    const N_TRIALS: usize = 400;
    let every = mesh.faces.len().div_ceil(MAX_FACES).max(1);
    let faces: Vec<(Point3<f64>, Vector3<f64>, f64)> = (0..mesh.faces.len())
        .step_by(every)
        .filter_map(|face| {
            let normal = mesh.face_normal(face);
            let area = normal.norm();
            Some((mesh.centroid(face), normal.try_normalize(0.0)?, area))
        })
        .collect();
    let total: f64 = faces.iter().map(|face| face.2).sum();
    let support = |plane: &Plane| -> f64 {
        faces
            .iter()
            .filter(|face| on_plane(plane, face))
            .map(|face| face.2)
            .sum()
    };
    // A stride that shares no factor with the count visits faces all over the mesh.
    let stride = if faces.len().is_multiple_of(7919) {
        7907
    } else {
        7919
    };
    let candidates = (0..N_TRIALS.min(faces.len())).map(|trial| {
        let (point, normal, _) = &faces[(trial * stride) % faces.len()];
        Plane::through(point, *normal)
    });
    let candidates: Vec<Plane> = candidates.collect();
    let supports: Vec<f64> = candidates.par_iter().map(support).collect();
    let (mut plane, mut area) = candidates
        .into_iter()
        .zip(supports)
        .max_by(|a, b| a.1.total_cmp(&b.1))?;
    for _ in 0..PLANE_FITS {
        let Some(fitted) = fit_plane(&plane, &faces) else {
            break;
        };
        let fitted_area = support(&fitted);
        if fitted_area < area {
            break;
        }
        (plane, area) = (fitted, fitted_area);
    }
    (area >= Plane::SUPPORT_SHARE * total).then_some(plane)
}

fn on_plane(plane: &Plane, (point, normal, _): &(Point3<f64>, Vector3<f64>, f64)) -> bool {
    plane.holds(point, normal, PLANE_REACH_M)
}

/// Least-squares plane through the faces that lie on `plane`, weighted by area.
fn fit_plane(plane: &Plane, faces: &[(Point3<f64>, Vector3<f64>, f64)]) -> Option<Plane> {
    let inliers = || faces.iter().filter(|face| on_plane(plane, face));
    let area: f64 = inliers().map(|face| face.2).sum();
    let mean = inliers().fold(Vector3::zeros(), |sum, face| sum + face.0.coords * face.2) / area;
    let covariance = inliers().fold(nalgebra::Matrix3::zeros(), |sum, face| {
        let offset = face.0.coords - mean;
        sum + offset * offset.transpose() * face.2
    });
    let eigen = covariance.symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let normal: Vector3<f64> = eigen.eigenvectors.column(least).into();
    let normal = if normal.dot(&plane.normal) < 0.0 {
        -normal
    } else {
        normal
    };
    let normal = normal.try_normalize(0.0)?;
    Some(Plane::through(&Point3::from(mean), normal))
}
