//! Edge-aware filter of depth: takes out what lies on no surface.
//!
//! A pixel on an object's edge sees both it and the background, and its depth lies somewhere between: a *flying pixel*. It is
//! recognised by what is on opposite sides of it: a surface in front on one, behind on the other, both further away than
//! a slant can explain. A pixel that hardly any neighbour agrees with is taken out too. Depth is never changed.

use pulp::{Simd, WithSimd};

use crate::{WIDTH, options::EdgeAwareOptions};

/// Pixels of a row that have neighbours on both sides.
const INNER: usize = WIDTH - 2;

/// Opposite neighbours: row and column of one, of the other.
const OPPOSITE: [[(usize, usize); 2]; 4] = [
    [(0, 0), (2, 2)],
    [(0, 1), (2, 1)],
    [(0, 2), (2, 0)],
    [(1, 0), (1, 2)],
];

/// One row to be filtered, with the rows above and below; beyond the image's edge they are zero.
pub(crate) struct EdgeRow<'a> {
    pub(crate) options: &'a EdgeAwareOptions,
    /// Angle between neighbouring pixels, radians.
    pub(crate) pixel_rad: f32,
    pub(crate) rows: [&'a [f32]; 3],
    pub(crate) depth: &'a mut [f32],
    /// Metres; becomes infinite where depth is taken out.
    pub(crate) sigma_m: &'a mut [f32],
}

impl WithSimd for EdgeRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let rows = self.rows.map(|row| &row[..WIDTH]);
        let centre = &rows[1][1..=INNER];
        let sigma_m = &mut self.sigma_m[1..=INNER];
        let slope = self.options.max_slope * self.pixel_rad;
        let mut tolerance_m = [0.0; INNER];
        for u in 0..INNER {
            tolerance_m[u] = slope * centre[u] + self.options.sigmas * sigma_m[u];
        }
        let mut agreeing = [0u32; INNER];
        let mut flying = [0u32; INNER];
        for line in OPPOSITE {
            let [one, other] = line.map(|(row, column)| &rows[row][column..column + INNER]);
            for u in 0..INNER {
                // No measurement is at depth 0: neither near any depth nor behind one.
                let there = [one[u], other[u]].map(|depth| depth > 0.0);
                let [step, other_step] = [one[u] - centre[u], other[u] - centre[u]];
                let (tolerance, both) = (tolerance_m[u], there[0] & there[1]);
                let falls = (step > tolerance) & (other_step < -tolerance);
                let rises = (step < -tolerance) & (other_step > tolerance);
                flying[u] |= u32::from(both & (falls | rises));
                agreeing[u] += u32::from(there[0] & (step.abs() <= tolerance));
                agreeing[u] += u32::from(there[1] & (other_step.abs() <= tolerance));
            }
        }
        let enough = u32::from(self.options.min_neighbours);
        self.depth[0] = 0.0;
        self.depth[WIDTH - 1] = 0.0;
        let depth = &mut self.depth[1..=INNER];
        for u in 0..INNER {
            let stays = (centre[u] > 0.0) & (flying[u] == 0) & (agreeing[u] >= enough);
            depth[u] = if stays { centre[u] } else { 0.0 };
            sigma_m[u] = if stays { sigma_m[u] } else { f32::INFINITY };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn filter(rows: [&[f32]; 3]) -> (Vec<f32>, Vec<f32>) {
        let (mut depth, mut sigma_m) = (vec![0.0; WIDTH], vec![0.001; WIDTH]);
        pulp::Arch::Scalar.dispatch(EdgeRow {
            options: &EdgeAwareOptions::default(),
            pixel_rad: 1.0 / 365.0,
            rows,
            depth: &mut depth,
            sigma_m: &mut sigma_m,
        });
        (depth, sigma_m)
    }

    #[test]
    fn pixels_between_two_surfaces_go() {
        let mut row = vec![1.0; WIDTH];
        row[200..].fill(1.5);
        row[200] = 1.2;
        let (depth, sigma_m) = filter([&row, &row, &row]);
        assert_eq!((depth[200], sigma_m[200]), (0.0, f32::INFINITY));
        assert_eq!((depth[199], depth[201]), (1.0, 1.5));
        assert_eq!(depth.iter().filter(|&&z| z > 0.0).count(), WIDTH - 3);
    }

    #[test]
    fn wires_stay_and_lone_pixels_go() {
        let plane = vec![2.0; WIDTH];
        let mut wire = plane.clone();
        wire[300] = 1.0;
        let (depth, _) = filter([&wire, &wire, &wire]);
        assert_eq!(depth[300], 1.0);
        let (depth, _) = filter([&plane, &wire, &plane]);
        assert_eq!(depth[300], 0.0);
        assert_eq!(depth[301], 2.0);
    }

    #[test]
    fn steep_surfaces_stay() {
        let row: Vec<f32> = (0..WIDTH).map(|u| 1.0 + 0.01 * u as f32).collect();
        let (depth, _) = filter([&row, &row, &row]);
        assert!(depth[1..WIDTH - 1].iter().all(|&z| z > 0.0));
    }
}
