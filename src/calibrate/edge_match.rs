//! Silhouettes of a depth image in an IR image: where its brightness steps across them.

use super::depth_edges::DepthEdge;
use depth_camera::Image;
use nalgebra::{Vector2, Vector3};

/// The offset is looked for within this many pixels in either direction.
const MAX_OFFSET_PX: i32 = 12;
/// Distances along a normal at which the IR image is looked at, pixels.
const STEP_PX: f64 = 0.25;
/// Steps of IR brightness over two pixels below this share of their mean are noise or texture; arbitrary.
const MIN_CONTRAST: f64 = 0.1;
/// Contrasts above this count alike, so that a black background does not outvote all else; arbitrary.
const MAX_CONTRAST: f64 = 0.5;
/// Added to brightness, share of full scale, so that noise in the dark has no contrast.
const DARK: f64 = 0.02;

/// The logarithm of brightness, so that contrasts do not depend on the light.
pub(super) struct Brightness {
    log: Image<f64>,
}

impl Brightness {
    /// Of an IR image, counts that end at `full_scale`.
    pub(super) fn new(ir_counts: &Image<f32>, full_scale: f64) -> Self {
        Brightness {
            log: log_smoothed(ir_counts, full_scale),
        }
    }

    /// Step of the logarithm over two pixels along a direction; `None` at the image's border.
    fn contrast(&self, u: f64, v: f64, direction: &Vector2<f64>) -> Option<f64> {
        let ahead = self.at(u + direction.x, v + direction.y)?;
        let behind = self.at(u - direction.x, v - direction.y)?;
        Some((ahead - behind).abs())
    }

    /// Bilinear.
    fn at(&self, u: f64, v: f64) -> Option<f64> {
        let (width, height) = (self.log.width(), self.log.height());
        if !(u >= 0.0 && v >= 0.0 && u < (width - 1) as f64 && v < (height - 1) as f64) {
            return None;
        }
        let (u0, v0) = (u as usize, v as usize);
        let (fu, fv) = (u - u0 as f64, v - v0 as f64);
        let (above, below) = (self.log.row(v0), self.log.row(v0 + 1));
        let mixed = |row: &[f64]| row[u0] * (1.0 - fu) + row[u0 + 1] * fu;
        Some(mixed(above) * (1.0 - fv) + mixed(below) * fv)
    }

    /// Where the steepest edge of the IR image lies along a depth edge's normal, pixels from it, near where the fit
    /// (offset and erosion) has it.
    pub(super) fn edge_near(
        &self,
        edge: &DepthEdge,
        fit: &Vector3<f64>,
        reach_px: f64,
    ) -> Option<f64> {
        let expected = design(edge).dot(fit);
        let across = fit.xy() - edge.outward * edge.outward.dot(&fit.xy());
        let n_steps = (2.0 * reach_px / STEP_PX) as usize;
        let distance = |step: usize| expected - reach_px + STEP_PX * step as f64;
        let mut profile = Vec::with_capacity(n_steps + 1);
        for step in 0..=n_steps {
            let place = edge.place + across + edge.outward * distance(step);
            profile.push(self.contrast(place.x, place.y, &edge.outward)?);
        }
        let peak = (1..n_steps).max_by(|a, b| profile[*a].total_cmp(&profile[*b]))?;
        let [before, top, after] = [profile[peak - 1], profile[peak], profile[peak + 1]];
        if top < MIN_CONTRAST || before > top || after > top {
            return None;
        }
        let bend = before - 2.0 * top + after;
        let vertex = if bend < 0.0 {
            0.5 * (before - after) / bend
        } else {
            0.0
        };
        Some(distance(peak) + STEP_PX * vertex)
    }
}

/// The logarithm of the image after a kernel of (1, 2, 1) a side.
fn log_smoothed(counts: &Image<f32>, full_scale: f64) -> Image<f64> {
    let (width, height) = (counts.width(), counts.height());
    let at = |u: usize, v: usize| f64::from(*counts.at(u.min(width - 1), v.min(height - 1)));
    let row = |u: usize, v: usize| at(u.saturating_sub(1), v) + 2.0 * at(u, v) + at(u + 1, v);
    let smoothed = (0..width * height).map(|pixel| {
        let (u, v) = (pixel % width, pixel / width);
        let sum = row(u, v.saturating_sub(1)) + 2.0 * row(u, v) + row(u, v + 1);
        (sum / (16.0 * full_scale) + DARK).ln()
    });
    Image::from_vec(width, height, smoothed.collect())
}

/// The whole pixels at which the IR image has most contrast across the depth's edges.
pub(super) fn coarse(edges: &[DepthEdge], brightness: &Brightness) -> Vector2<f64> {
    let shifts = -MAX_OFFSET_PX..=MAX_OFFSET_PX;
    let candidates = shifts
        .clone()
        .flat_map(|dv| shifts.clone().map(move |du| (du, dv)));
    let energy = |(du, dv): (i32, i32)| -> f64 {
        let contrasts = edges.iter().filter_map(|edge| {
            let (u, v) = (edge.place.x + f64::from(du), edge.place.y + f64::from(dv));
            brightness.contrast(u, v, &edge.outward)
        });
        contrasts
            .map(|contrast| contrast.min(MAX_CONTRAST).powi(2))
            .sum()
    };
    let energies = candidates.map(|shift| (shift, energy(shift)));
    let best = energies.max_by(|(_, a), (_, b)| a.total_cmp(b));
    best.map_or_else(Vector2::zeros, |((du, dv), _)| {
        Vector2::new(f64::from(du), f64::from(dv))
    })
}

/// The row of an edge: distance along its normal by offset and erosion.
pub(super) fn design(edge: &DepthEdge) -> Vector3<f64> {
    Vector3::new(edge.outward.x, edge.outward.y, 1.0)
}
