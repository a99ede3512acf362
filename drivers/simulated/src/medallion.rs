//! The relief of the plaque: how far its front stands out, in closed form.

use std::f64::consts::TAU;

/// Half width and half height of the plaque, metres.
pub(crate) const HALF_SIZE: [f64; 2] = [0.10, 0.12];

/// The relief lies between these heights, metres.
pub(crate) const HEIGHT_RANGE: [f64; 2] = [-0.001, 0.004];

/// Middle of the medallion, metres above the middle of the plaque.
const CENTRE_Y: f64 = 0.018;

/// Height of the middle of the lettering, and half the height of its band.
const LETTERS_Y: f64 = -0.093;
const LETTERS_HALF_BAND: f64 = 0.014;

/// Strokes of the lettering, in units of a letter's width and height: from x, y to x, y.
const LETTERS: [&[[f64; 4]]; 6] = [
    &[
        [0.0, 0.0, 0.0, 1.0],
        [0.0, 1.0, 0.9, 0.9],
        [0.9, 0.9, 0.9, 0.6],
        [0.9, 0.6, 0.0, 0.5],
        [0.3, 0.5, 1.0, 0.0],
    ],
    &[
        [0.0, 0.0, 0.0, 1.0],
        [0.0, 1.0, 0.9, 1.0],
        [0.0, 0.5, 0.7, 0.5],
        [0.0, 0.0, 0.9, 0.0],
    ],
    &[[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.9, 0.0]],
    &[[0.45, 0.0, 0.45, 1.0]],
    &[
        [0.0, 0.0, 0.0, 1.0],
        [0.0, 1.0, 0.9, 1.0],
        [0.0, 0.5, 0.7, 0.5],
        [0.0, 0.0, 0.9, 0.0],
    ],
    &[
        [0.0, 0.0, 0.0, 1.0],
        [0.0, 1.0, 0.9, 1.0],
        [0.0, 0.5, 0.7, 0.5],
    ],
];

/// Height of the relief over the plaque's flat front at (x, y), metres; slopes stay below 0.6.
pub(crate) fn height(x: f64, y: f64) -> f64 {
    let to_edge = (HALF_SIZE[0] - x.abs()).min(HALF_SIZE[1] - y.abs());
    let border = 1.0e-3 * bell((to_edge - 0.007) / 2.5e-3);
    let r = x.hypot(y - CENTRE_Y);
    if r < 0.095 {
        return border + medallion(r, x, y - CENTRE_Y);
    }
    if (y - LETTERS_Y).abs() < LETTERS_HALF_BAND {
        return border + 0.8e-3 * bell(distance_to_letters(x, y - LETTERS_Y) / 1.7e-3);
    }
    let corner = (x.abs() - 0.083).hypot(y - 0.103);
    border + 1.2e-3 * bell(corner / 4.0e-3)
}

/// A boss of five lobes, rings of 9 mm, a wreath of 32 spiral petals about 9 mm wide, and a raised rim.
fn medallion(r: f64, x: f64, y: f64) -> f64 {
    let rim = 1.6e-3 * bell((r - 0.083) / 3.5e-3);
    if r > 0.077 {
        return rim;
    }
    if r > 0.036 {
        let turn = 32.0 * y.atan2(x) + 20.0 * (r / 0.05).ln();
        let window = smooth_step(0.036, 0.043, r) * (1.0 - smooth_step(0.070, 0.077, r));
        return rim + 0.6e-3 * window * turn.cos();
    }
    let q = r / 9.0e-3;
    let lobes = 1.0 + 0.3 * (q * q).min(1.0) * (5.0 * y.atan2(x)).cos();
    let boss = 2.0e-3 * bell(q) * lobes;
    let window = smooth_step(0.013, 0.017, r) * (1.0 - smooth_step(0.031, 0.036, r));
    rim + boss + 0.5e-3 * window * (TAU * r / 9.0e-3).cos()
}

/// Distance to the nearest stroke, metres; `y` from the middle of the lettering.
fn distance_to_letters(x: f64, y: f64) -> f64 {
    const PITCH: f64 = 0.024;
    const WIDTH: f64 = 0.014;
    const HEIGHT: f64 = 0.017;
    let left = -0.5 * PITCH * LETTERS.len() as f64;
    let slot = ((x - left) / PITCH).floor();
    if slot < 0.0 || slot >= LETTERS.len() as f64 {
        return f64::INFINITY;
    }
    let x = x - left - slot * PITCH - 0.5 * (PITCH - WIDTH);
    let y = y + 0.5 * HEIGHT;
    LETTERS[slot as usize]
        .iter()
        .map(|[x0, y0, x1, y1]| {
            let (x0, y0) = (x0 * WIDTH, y0 * HEIGHT);
            let (dx, dy) = (x1 * WIDTH - x0, y1 * HEIGHT - y0);
            let along = ((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy);
            let along = along.clamp(0.0, 1.0);
            (x - x0 - along * dx).hypot(y - y0 - along * dy)
        })
        .fold(f64::INFINITY, f64::min)
}

fn bell(q: f64) -> f64 {
    (-q * q).exp()
}

fn smooth_step(from: f64, to: f64, x: f64) -> f64 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relief_stays_within_its_range_and_slope() {
        const STEP: f64 = 1e-4;
        let grid =
            |half: f64| (0..=(2.0 * half / STEP) as usize).map(move |i| i as f64 * STEP - half);
        for y in grid(HALF_SIZE[1]) {
            for x in grid(HALF_SIZE[0]) {
                let h = height(x, y);
                assert!((HEIGHT_RANGE[0]..=HEIGHT_RANGE[1]).contains(&h));
                let slope = (height(x + 1e-6, y) - h).hypot(height(x, y + 1e-6) - h) / 1e-6;
                // The tracer takes 0.85 of the distance: right up to a slope of 0.62.
                assert!(slope < 0.6, "slope {slope} at {x}, {y}");
            }
        }
    }
}
