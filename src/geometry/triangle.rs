//! A single triangle against a point or a ray.

use nalgebra::{Point3, Vector3};

/// Squared sine of the angle between two edges below which a triangle counts as its three edges only.
const MIN_SINE_SQUARED: f64 = 1e-12;

/// The point of a triangle closest to `query`, and its barycentric weights.
pub(super) fn closest_on_triangle(
    corners: &[Point3<f64>; 3],
    query: &Point3<f64>,
) -> (Point3<f64>, [f64; 3]) {
    let [a, b, c] = corners;
    let (ab, ac, aq) = (b - a, c - a, query - a);
    // Normal equations of |aq − u·ab − v·ac|².
    let (bb, bc, cc) = (ab.norm_squared(), ab.dot(&ac), ac.norm_squared());
    let (qb, qc) = (aq.dot(&ab), aq.dot(&ac));
    let determinant = bb * cc - bc * bc;
    if determinant > MIN_SINE_SQUARED * bb * cc {
        let u = (qb * cc - qc * bc) / determinant;
        let v = (qc * bb - qb * bc) / determinant;
        if u >= 0.0 && v >= 0.0 && u + v <= 1.0 {
            return (a + ab * u + ac * v, [1.0 - u - v, u, v]);
        }
    }
    let mut closest = (*a, [1.0, 0.0, 0.0]);
    let mut least = f64::INFINITY;
    for (start, end) in [(0, 1), (1, 2), (2, 0)] {
        let along = corners[end] - corners[start];
        let length_squared = along.norm_squared();
        let s = if length_squared > 0.0 {
            ((query - corners[start]).dot(&along) / length_squared).clamp(0.0, 1.0)
        } else {
            0.0
        };
        let point = corners[start] + along * s;
        let distance = (query - point).norm_squared();
        if distance < least {
            least = distance;
            let mut weights = [0.0; 3];
            weights[start] = 1.0 - s;
            weights[end] = s;
            closest = (point, weights);
        }
    }
    closest
}

/// Where a ray meets a triangle, in lengths of its direction; `None` where it misses or runs parallel.
pub(super) fn ray_meets(
    corners: &[Point3<f64>; 3],
    origin: &Point3<f64>,
    direction: &Vector3<f64>,
) -> Option<f64> {
    let [a, b, c] = corners.map(|corner| corner - origin);
    // Signed volumes of the ray with the edges: all of one sign where the ray passes between them.
    let (wa, wb, wc) = (
        direction.dot(&b.cross(&c)),
        direction.dot(&c.cross(&a)),
        direction.dot(&a.cross(&b)),
    );
    let sum = wa + wb + wc;
    let inside = (wa >= 0.0 && wb >= 0.0 && wc >= 0.0) || (wa <= 0.0 && wb <= 0.0 && wc <= 0.0);
    (inside && sum != 0.0).then(|| a.dot(&(b - a).cross(&(c - a))) / sum)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A seeded generator of numbers in [0, 1): an LCG with the multiplier of Knuth's MMIX.
    pub(crate) fn uniform(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        move || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        }
    }

    /// A point of the unit cube.
    pub(crate) fn point(random: &mut impl FnMut() -> f64) -> Point3<f64> {
        Point3::new(random(), random(), random())
    }

    #[test]
    fn the_closest_point_of_a_triangle_beats_a_sampling_of_it() {
        let mut random = uniform(11);
        for _ in 0..200 {
            let corners = [point(&mut random), point(&mut random), point(&mut random)];
            let query = point(&mut random);
            let (closest, weights) = closest_on_triangle(&corners, &query);
            assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
            for _ in 0..200 {
                let (u, v) = (random(), random());
                let (u, v) = if u + v > 1.0 {
                    (1.0 - u, 1.0 - v)
                } else {
                    (u, v)
                };
                let sample =
                    corners[0] + (corners[1] - corners[0]) * u + (corners[2] - corners[0]) * v;
                assert!((closest - query).norm() <= (sample - query).norm() + 1e-12);
            }
        }
    }
}
