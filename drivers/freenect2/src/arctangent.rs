//! The angle of a vector, as a loop over it can be vectorised.

/// Odd polynomial for the angle of a slope of 0 to 1, turns; off by 6·10⁻⁹ at most before rounding, fitted for the smallest
/// largest error.
const ARCTANGENT: [f32; 8] = [
    0.159_154_83,
    -0.053_046_122,
    0.031_745_944,
    -0.022_136_271,
    0.015_346_033,
    -0.008_898_723,
    0.003_479_597_9,
    -0.000_645_304_4,
];

/// The angle of (x, y) from the x axis towards the y axis, turns, 0 to 1; 0 for the zero vector.
#[inline(always)]
pub(crate) fn turns(y: f32, x: f32) -> f32 {
    let (width, height) = (x.abs(), y.abs());
    let longer = width.max(height).max(f32::MIN_POSITIVE);
    let slope = width.min(height) / longer;
    let square = slope * slope;
    let mut sum = ARCTANGENT[7];
    for i in (0..7).rev() {
        sum = sum * square + ARCTANGENT[i];
    }
    let octant = sum * slope;
    let quadrant = if height > width {
        0.25 - octant
    } else {
        octant
    };
    let half = if x < 0.0 { 0.5 - quadrant } else { quadrant };
    if y < 0.0 { 1.0 - half } else { half }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn angles_are_those_of_the_standard_library() {
        for i in 0..100_000 {
            let angle = TAU * f64::from(i) / 100_000.0;
            let length = 1.0 + f64::from(i % 97) * 100.0;
            let (x, y) = ((length * angle.cos()) as f32, (length * angle.sin()) as f32);
            let expected = f64::from(y).atan2(f64::from(x)).rem_euclid(TAU) / TAU;
            let apart = (f64::from(turns(y, x)) - expected).abs();
            assert!(apart.min(1.0 - apart) < 1e-7, "{x}, {y}: {apart} turns");
        }
        assert_eq!(turns(0.0, 0.0), 0.0);
    }
}
