//! The sphere in the fused mesh.

use super::plane::plane_through;
use crate::geometry::{Plane, TriMesh};
use nalgebra::{Matrix4, Point3, Vector3, Vector4};

/// What is known of the sphere's radius beforehand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BallRadius {
    /// Nothing: depth and limb say it.
    Unknown,
    /// Measured with callipers, metres.
    Given(f64),
}

impl BallRadius {
    /// Standard deviation of a radius that is this, or was found to be this, metres.
    pub(super) fn sigma_m(self, radius_m: f64) -> f64 {
        radius_m
            * match self {
                BallRadius::Unknown => FOUND_RADIUS_ERROR,
                BallRadius::Given(_) => GIVEN_RADIUS_ERROR,
            }
    }
}

/// A sphere in a fused mesh, or in the frames of a session.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FoundSphere {
    /// Its centre, world frame, metres.
    pub centre_world: Point3<f64>,
    /// Its radius, metres: given, or as depth shows it.
    pub radius_m: f64,
    /// How well the radius is known, metres.
    pub radius_sigma_m: f64,
    /// Share of the sphere's front that is seen.
    pub coverage: f64,
}

/// Spheres that a desk holds and a Kinect sees well, metres.
const RADIUS_BOUNDS_M: [f64; 2] = [0.03, 0.4];
const N_DRAWS: usize = 10_000;
/// Three vertices are drawn so often for the plane that the sphere stands on.
const N_PLANES: usize = 300;
/// What lies within this of a plane lies on it, metres: multipath bends a table by half as much.
pub(super) const ON_PLANE_M: f64 = 0.01;
/// Fewer vertices show nothing.
const MIN_VERTICES: usize = 100;
/// Vertices among which the second one of a pair is looked for, and how far apart the two are, metres.
const N_TRIES: usize = 40;
const PAIR_M: std::ops::Range<f64> = 0.02..0.2;
const N_SCORED: usize = 3_000;
/// A vertex lies on the sphere within this distance, as a share of the radius, and at least 2 mm: multipath near a table
/// bends depth by 5 mm.
const TOLERANCE_SHARE: f64 = 0.03;
/// And its normal within this angle of the radius, as a cosine (20°).
const MIN_NORMAL_COSINE: f64 = 0.94;
/// A sphere shows at least this share of its front in the mesh. A plane shows 0.06 of one: its cap within the normals' 20°.
pub(super) const MIN_COVERAGE: f64 = 0.35;
/// What fusion, or the noise of single frames, and multipath may do to the radius: 4 % on a recorded sphere on a table.
const FOUND_RADIUS_ERROR: f64 = 0.06;
/// What callipers may do to it.
const GIVEN_RADIUS_ERROR: f64 = 0.002;

/// A vertex with its normal.
type Oriented = (Point3<f64>, Vector3<f64>);

/// The sphere that most of what stands out of a plane lies on, by RANSAC over pairs of vertices with their normals; whether it is one
/// its coverage says. `None` where nothing is round.
pub fn best_sphere(mesh: &TriMesh, radius: BallRadius) -> Option<FoundSphere> {
    let normals = smooth_normals(mesh);
    let vertices: Vec<Oriented> = mesh.vertices.iter().copied().zip(normals).collect();
    // A ball of 5 cm is a two hundredth of what is seen of a large table.
    let standing_out = off_the_plane(&vertices);
    if standing_out.len() < MIN_VERTICES {
        return None;
    }
    let mut random = fastrand::Rng::with_seed(1);
    let mut draw = || standing_out[random.usize(..standing_out.len())];
    let scored: Vec<Oriented> = (0..N_SCORED).map(|_| draw()).collect();
    let mut best = (0.0, Point3::origin(), 0.0);
    for _ in 0..N_DRAWS {
        let a = draw();
        // A sphere may be a small part of that: its second vertex is looked for nearby.
        let nearby = (0..N_TRIES).map(|_| draw());
        let b = nearby
            .into_iter()
            .find(|b| PAIR_M.contains(&(b.0 - a.0).norm()));
        let Some((centre, r)) = b.and_then(|b| sphere_of_pair(&a, &b, radius)) else {
            continue;
        };
        // Votes times the share of the sphere that they cover: the shallow cap of a large sphere fits anything flat.
        let votes = scored.iter().filter(|v| lies_on(v, &centre, r)).count() as f64;
        let score = (votes / r).powi(2);
        if score > best.0 {
            best = (score, centre, r);
        }
    }
    let (_, mut centre, mut r) = best;
    for _ in 0..10 {
        let on_sphere = vertices.iter().filter(|v| lies_on(v, &centre, r));
        let on_sphere = on_sphere.map(|(point, _)| (*point, 1.0));
        (centre, r) = refit(on_sphere, &centre, r, radius)?;
    }
    Some(FoundSphere {
        centre_world: centre,
        radius_m: r,
        radius_sigma_m: radius.sigma_m(r),
        coverage: covered_share(mesh, &vertices, &centre, r),
    })
}

/// The vertices that do not lie on the plane that most of them lie on.
fn off_the_plane(vertices: &[Oriented]) -> Vec<Oriented> {
    if vertices.len() < MIN_VERTICES {
        return Vec::new();
    }
    let mut random = fastrand::Rng::with_seed(1);
    let mut draw = || vertices[random.usize(..vertices.len())].0;
    let scored: Vec<Point3<f64>> = (0..N_SCORED).map(|_| draw()).collect();
    let planes = (0..N_PLANES).filter_map(|_| plane_through(&draw(), &draw(), &draw()));
    let n_on = |plane: &Plane| scored.iter().filter(|p| lies_on_plane(p, plane)).count();
    let best = planes.max_by_key(n_on);
    let off = |point: &Point3<f64>| best.is_none_or(|plane| !lies_on_plane(point, &plane));
    let vertices = vertices.iter().copied();
    vertices.filter(|(point, _)| off(point)).collect()
}

fn lies_on_plane(point: &Point3<f64>, plane: &Plane) -> bool {
    plane.height_m(point).abs() < ON_PLANE_M
}

/// Vertex normals averaged over about a centimetre: those of a mesh of few frames are off by 15°.
fn smooth_normals(mesh: &TriMesh) -> Vec<Vector3<f64>> {
    /// Rounds of averaging over the faces round a vertex; edges are about 2 mm.
    const N_ROUNDS: usize = 12;
    let mut normals = mesh.vertex_normals();
    for _ in 0..N_ROUNDS {
        let sums = mesh.sums_at_vertices(Vector3::zeros(), |face| {
            let [a, b, c] = mesh.faces[face].map(|vertex| normals[vertex as usize]);
            a + b + c
        });
        normals = sums
            .into_iter()
            .map(|sum| sum.try_normalize(0.0).unwrap_or_default())
            .collect();
    }
    normals
}

/// Where the normals of two vertices meet, nearly; `None` where they do not.
fn sphere_of_pair(a: &Oriented, b: &Oriented, radius: BallRadius) -> Option<(Point3<f64>, f64)> {
    let (across, turn) = (b.0 - a.0, b.1 - a.1);
    let turned = turn.norm_squared();
    if turned < 0.05 {
        return None;
    }
    // Least squares of b + r n_b = a + r n_a, seen from the centre.
    let r = match radius {
        BallRadius::Unknown => across.dot(&turn) / turned,
        BallRadius::Given(r) => r,
    };
    let gap = (across - turn * r).norm();
    let in_bounds = r > RADIUS_BOUNDS_M[0] && r < RADIUS_BOUNDS_M[1];
    (in_bounds && gap < 2.0 * tolerance_m(r)).then(|| {
        let centre = ((a.0 - a.1 * r).coords + (b.0 - b.1 * r).coords) * 0.5;
        (Point3::from(centre), r)
    })
}

pub(super) fn tolerance_m(r: f64) -> f64 {
    (TOLERANCE_SHARE * r).max(0.002)
}

fn lies_on((point, normal): &Oriented, centre: &Point3<f64>, r: f64) -> bool {
    let arm = point - centre;
    let distance = arm.norm();
    (distance - r).abs() < tolerance_m(r) && normal.dot(&arm) > MIN_NORMAL_COSINE * distance
}

/// One step of least squares on the distances of points, each with its weight, from the sphere; `None` where they do not tell it.
pub(super) fn refit(
    points: impl Iterator<Item = (Point3<f64>, f64)>,
    centre: &Point3<f64>,
    r: f64,
    radius: BallRadius,
) -> Option<(Point3<f64>, f64)> {
    let (mut jtj, mut jtr) = (Matrix4::zeros(), Vector4::zeros());
    for (point, weight) in points {
        let arm = point - centre;
        let distance = arm.norm();
        let out = arm / distance;
        let by_radius = match radius {
            BallRadius::Unknown => 1.0,
            BallRadius::Given(_) => 0.0,
        };
        let row = Vector4::new(out.x, out.y, out.z, by_radius);
        jtj += row * row.transpose() * weight;
        jtr += row * (weight * (distance - r));
    }
    if let BallRadius::Given(_) = radius {
        jtj[(3, 3)] = 1.0;
    }
    let step = jtj.cholesky()?.solve(&jtr);
    Some((centre + step.xyz(), r + step.w))
}

/// Area of the mesh on the sphere, over that of half the sphere: faces all of whose corners lie on it.
fn covered_share(mesh: &TriMesh, vertices: &[Oriented], centre: &Point3<f64>, r: f64) -> f64 {
    let on_sphere = mesh.filter_faces(|face| {
        let corners = mesh.faces[face].iter();
        corners
            .into_iter()
            .all(|vertex| lies_on(&vertices[*vertex as usize], centre, r))
    });
    on_sphere.area_m2() / (std::f64::consts::TAU * r * r)
}
