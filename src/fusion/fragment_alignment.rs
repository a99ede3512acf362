//! Where one fragment stands against another: point-to-plane alignment, and whether both can be true of one scene.

use super::eye::Eye;
use super::fragments::{FRAGMENT_LEVEL, Fragment};
use super::icp::is_small;
use super::noise::DepthNoise;
use super::normal_equations::{NormalEquations, Rows, TileSums, huber_weight};
use super::raycast::ModelMap;
use crate::geometry::lanes::{LANES, Lane};
use crate::geometry::{Lens, Pose, Rigid};
use nalgebra::{Matrix6, Vector3};
use pulp::{Arch, Simd, WithSimd};

/// How a fragment stands against another.
#[derive(Clone, Debug)]
pub(super) struct Alignment {
    /// Where the source's anchor stands in the frame of the target's.
    pub target_from_source: Pose,
    /// Mean square distance, point to plane, by a left increment of the pose: m² per (rad, m)².
    pub curvature: Matrix6<f64>,
    /// What both see.
    pub overlap: Overlap,
}

/// What two fragments see of one another's surface.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Overlap {
    /// Points of the one fragment.
    pub n_points: usize,
    /// Points that lie on the other's surface.
    pub n_shared: usize,
    /// Points through which the other one has looked: they stand in front of what it measured.
    pub n_looked_through: usize,
}

impl Overlap {
    /// Share of the points that lie on the other's surface.
    pub fn shared_share(&self) -> f64 {
        self.n_shared as f64 / self.n_points.max(1) as f64
    }

    /// Share of the points that the other one has looked through among those that it could judge.
    pub fn looked_through_share(&self) -> f64 {
        self.n_looked_through as f64 / (self.n_shared + self.n_looked_through).max(1) as f64
    }

    fn plus(self, other: Overlap) -> Overlap {
        Overlap {
            n_points: self.n_points + other.n_points,
            n_shared: self.n_shared + other.n_shared,
            n_looked_through: self.n_looked_through + other.n_looked_through,
        }
    }
}

/// What a full turn drifts at most, metres.
pub(super) const MAX_DRIFT_M: f32 = 0.04;
/// Largest distance of a pair of points, metres: drift, then what noise and slant leave.
const MAX_DISTANCE_M: [f32; 3] = [MAX_DRIFT_M, 0.02, 0.01];
/// Iterations at each of them, at most.
const ITERATIONS: usize = 8;
/// Largest angle between the normals of a pair: 40°.
const MIN_NORMAL_COSINE: f32 = 0.766;

/// Aligns one fragment to another from a first guess; `None` where they have no surface in common.
pub(super) fn align(
    source: &Fragment,
    target: &Fragment,
    guess: &Pose,
    eye: &Eye,
    margin_m: f32,
) -> Option<Alignment> {
    let mut target_from_source = *guess;
    let mut last = None;
    for max_distance_m in MAX_DISTANCE_M {
        for _ in 0..ITERATIONS {
            let target = Target {
                map: &target.map,
                lens: lens(eye),
                target_from_source: Rigid::new(&target_from_source),
                max_distance_squared: max_distance_m * max_distance_m,
            };
            let equations = point_to_plane(eye.arch, &source.points.lanes, &target);
            let step = equations.solve(&Vector3::zeros())?;
            target_from_source = step * target_from_source;
            last = Some(equations);
            if is_small(&step) {
                break;
            }
        }
    }
    Some(Alignment {
        target_from_source,
        curvature: last?.mean_curvature(),
        overlap: mutual_overlap(source, target, &target_from_source, eye, margin_m),
    })
}

/// Where moved points come to lie, metres, and in which pixels.
#[inline(always)]
fn places(motion: &Rigid, points: &PointLanes, lens: &Lens) -> ([Lane; 3], [u32; LANES]) {
    let (mut places, mut pixels) = ([[0.0; LANES]; 3], [0; LANES]);
    for i in 0..LANES {
        let [x, y, z] = &points.point;
        let place = motion.point([x[i], y[i], z[i]]);
        pixels[i] = lens.pixel_index(place);
        for axis in 0..3 {
            places[axis][i] = place[axis];
        }
    }
    (places, pixels)
}

/// What points are aligned to, and how far.
struct Target<'a> {
    map: &'a ModelMap,
    lens: &'a Lens,
    target_from_source: Rigid,
    max_distance_squared: f32,
}

/// Lanes of points that are summed in one go.
const TILE: usize = 64;

fn point_to_plane(arch: Arch, points: &[PointLanes], target: &Target) -> NormalEquations {
    NormalEquations::of_tiles(points.len().div_ceil(TILE), |tile| {
        let points = &points[tile * TILE..];
        let points = &points[..points.len().min(TILE)];
        arch.dispatch(SumTile { points, target })
    })
}

struct SumTile<'a> {
    points: &'a [PointLanes],
    target: &'a Target<'a>,
}

impl WithSimd for SumTile<'_> {
    type Output = TileSums;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> TileSums {
        let (mut sums, mut rows) = (TileSums::ZERO, Rows::EMPTY);
        for points in self.points {
            self.target.residuals(points, &mut rows);
            sums.add(&rows);
        }
        sums
    }
}

impl Target<'_> {
    /// Where moved points lie against the plane of the surface that is seen in their pixel; a weight of 0 where there is none.
    #[allow(
        clippy::needless_range_loop,
        reason = "one index runs through all the lanes, which is what becomes vector code"
    )]
    #[inline(always)]
    fn residuals(&self, points: &PointLanes, rows: &mut Rows) {
        let motion = &self.target_from_source;
        let pixels;
        (rows.lever, pixels) = places(motion, points, self.lens);
        let plane;
        [plane, rows.normal] = self.map.planes(&pixels);
        for i in 0..LANES {
            let [x, y, z] = &points.normal;
            let normal = motion.turn([x[i], y[i], z[i]]);
            let (mut cosine, mut residual, mut squared) = (0.0, 0.0, 0.0);
            let (mut towards, mut far_squared) = (0.0, 0.0);
            for axis in 0..3 {
                let offset = rows.lever[axis][i] - plane[axis][i];
                cosine += normal[axis] * rows.normal[axis][i];
                residual += offset * rows.normal[axis][i];
                squared += offset * offset;
                towards -= plane[axis][i] * rows.normal[axis][i];
                far_squared += plane[axis][i] * plane[axis][i];
            }
            // Without a normal of either the cosine is 0.
            let counts = (cosine >= MIN_NORMAL_COSINE)
                & (squared <= self.max_distance_squared)
                & (towards > 0.0);
            let incidence = points.incidence[i] * (towards / far_squared.sqrt());
            rows.residual[i] = residual;
            rows.weight[i] = if counts {
                incidence * huber_weight(residual, points.sigma_m[i])
            } else {
                0.0
            };
        }
    }
}

/// Points of a fragment, anchor frame.
#[derive(Clone, Debug)]
struct PointLanes {
    /// Metres.
    point: [Lane; 3],
    /// Zero where there is no point.
    normal: [Lane; 3],
    /// Cosine of the angle at which the point was seen.
    incidence: Lane,
    /// Standard deviation of its depth, metres.
    sigma_m: Lane,
}

impl PointLanes {
    const EMPTY: PointLanes = PointLanes {
        point: [[0.0; LANES]; 3],
        normal: [[0.0; LANES]; 3],
        incidence: [0.0; LANES],
        // No divisor is zero.
        sigma_m: [1.0; LANES],
    };
}

/// The points by which a fragment is aligned to others: of one row in two and one column, since averaged surfaces have little noise left that
/// more points would take off.
#[derive(Clone, Debug)]
pub(super) struct AlignedPoints {
    /// Those of one row in four and one column first.
    lanes: Vec<PointLanes>,
    n_few: usize,
}

impl AlignedPoints {
    /// The points of a fragment as its anchor sees it.
    pub(super) fn of(map: &ModelMap, noise: &DepthNoise) -> Self {
        let (width, height) = (map.points.width(), map.points.height());
        let is_few = |u: usize, v: usize| u.is_multiple_of(4) && v.is_multiple_of(4);
        let mut lanes = Vec::new();
        let mut take = |wanted: bool| {
            let mut n_taken = 0;
            for v in (0..height).step_by(2) {
                for u in (0..width).step_by(2).filter(|&u| is_few(u, v) == wanted) {
                    let (point, normal) = (map.points.at(u, v), map.normals.at(u, v));
                    if *normal == Vector3::zeros() {
                        continue;
                    }
                    let lane = n_taken % LANES;
                    if lane == 0 {
                        lanes.push(PointLanes::EMPTY);
                    }
                    let last = lanes
                        .last_mut()
                        .expect("there is one since the first point");
                    for axis in 0..3 {
                        last.point[axis][lane] = point[axis];
                        last.normal[axis][lane] = normal[axis];
                    }
                    last.incidence[lane] = cosine(point, normal);
                    last.sigma_m[lane] = noise.sigma_m(point.z);
                    n_taken += 1;
                }
            }
            lanes.len()
        };
        let n_few = take(true);
        take(false);
        AlignedPoints { lanes, n_few }
    }

    /// Those of one row in four and one column.
    fn few(&self) -> &[PointLanes] {
        &self.lanes[..self.n_few]
    }
}

fn lens(eye: &Eye) -> &Lens {
    &eye.level(FRAGMENT_LEVEL).lens
}

/// Cosine of the incidence at which a point was seen.
fn cosine(point: &Vector3<f32>, normal: &Vector3<f32>) -> f32 {
    (-normal.dot(point) / point.norm()).max(0.0)
}

/// What two fragments see of one another at a relative pose, both ways. Points within `margin_m` of what the other one
/// measured are shared, points farther in front of it were looked through; what is hidden behind it tells nothing.
pub(super) fn mutual_overlap(
    source: &Fragment,
    target: &Fragment,
    target_from_source: &Pose,
    eye: &Eye,
    margin_m: f32,
) -> Overlap {
    let seen_by = |points: &AlignedPoints, map, map_from_points: &Pose| {
        eye.arch.dispatch(SumOverlap {
            points: points.few(),
            map,
            lens: lens(eye),
            map_from_points: Rigid::new(map_from_points),
            margin_m,
        })
    };
    let forth = seen_by(&source.points, &target.map, target_from_source);
    let back = seen_by(&target.points, &source.map, &target_from_source.inverse());
    forth.plus(back)
}

/// What a map shows of moved points.
struct SumOverlap<'a> {
    points: &'a [PointLanes],
    map: &'a ModelMap,
    lens: &'a Lens,
    map_from_points: Rigid,
    margin_m: f32,
}

impl WithSimd for SumOverlap<'_> {
    type Output = Overlap;

    #[allow(
        clippy::needless_range_loop,
        reason = "one index runs through all the lanes, which is what becomes vector code"
    )]
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Overlap {
        let (map_points, map_normals) = (self.map.points.data(), self.map.normals.data());
        let mut counts = [[0u32; LANES]; 3];
        for points in self.points {
            let (places, pixels) = places(&self.map_from_points, points, self.lens);
            let mut surface_z = [f32::INFINITY; LANES];
            for i in 0..LANES {
                let pixel = pixels[i] as usize;
                let found = map_points.get(pixel).zip(map_normals.get(pixel));
                let seen = found.filter(|(_, normal)| **normal != Vector3::zeros());
                surface_z[i] = seen.map_or(f32::NAN, |(point, _)| point.z);
            }
            for i in 0..LANES {
                let [x, y, z] = &points.normal;
                let is_point = (x[i] != 0.0) | (y[i] != 0.0) | (z[i] != 0.0);
                // Without a surface neither is true.
                let in_front_m = surface_z[i] - places[2][i];
                counts[0][i] += u32::from(is_point);
                counts[1][i] += u32::from(is_point & (in_front_m.abs() <= self.margin_m));
                counts[2][i] += u32::from(is_point & (in_front_m > self.margin_m));
            }
        }
        let [n_points, n_shared, n_looked_through] =
            counts.map(|lanes| lanes.iter().sum::<u32>() as usize);
        Overlap {
            n_points,
            n_shared,
            n_looked_through,
        }
    }
}
