//! Vectors and pieces of surface, as many at once as there are lanes.

use crate::geometry::lanes::{LANES, Lane};
use crate::shading::Gloss;
use nalgebra::Vector3;

/// Points or vectors, by axis.
pub type Lanes3 = [Lane; 3];

/// Pieces of a surface: places with normals and gloss.
pub struct Surfels {
    /// Places, world frame, metres.
    pub points: Lanes3,
    /// Unit normals, world frame; zero where there is none.
    pub normals: Lanes3,
    /// How glossy they are; `None` where all are matte.
    pub gloss: Option<[Gloss; LANES]>,
}

impl Surfels {
    /// Of nothing yet; matte ones are never glossy.
    pub fn new(is_matte: bool) -> Self {
        Surfels {
            points: [[0.0; LANES]; 3],
            normals: [[0.0; LANES]; 3],
            gloss: (!is_matte).then_some([Gloss::default(); LANES]),
        }
    }
}

/// Writes a vector into a lane.
#[inline]
pub fn set_lane(lanes: &mut Lanes3, lane: usize, value: &Vector3<f64>) {
    for axis in 0..3 {
        lanes[axis][lane] = value[axis] as f32;
    }
}

/// Vectors one by one as a function has them.
#[inline(always)]
pub fn by_lane(vectors: &Lanes3, of: impl Fn([f32; 3]) -> [f32; 3]) -> Lanes3 {
    let mut out = [[0.0; LANES]; 3];
    for i in 0..LANES {
        let vector = of([0, 1, 2].map(|axis| vectors[axis][i]));
        for axis in 0..3 {
            out[axis][i] = vector[axis];
        }
    }
    out
}

/// Scalar products of vectors.
#[inline(always)]
pub fn dots(a: &Lanes3, b: &Lanes3) -> Lane {
    let mut products = [0.0; LANES];
    for i in 0..LANES {
        products[i] = a[0][i] * b[0][i] + a[1][i] * b[1][i] + a[2][i] * b[2][i];
    }
    products
}

/// The scalar product of two vectors.
#[inline(always)]
pub fn dot(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
