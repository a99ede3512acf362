//! Whether light falls with the square of distance (Fig. 5): the exponent on a wall, over the whole image and by region.

use super::Sensor;
use super::estimate::{Estimate, Measured};
use super::gather::{Scan, Target};
use super::model::log_linear;
use super::refusal::Refusal;
use super::samples::{Place, Sample, wall_intensities};
use super::state::State;
use crate::robust::median;

/// How light falls with distance on one wall.
#[derive(Clone, Debug)]
pub struct InverseSquare {
    /// What is measured without knowing the response: γ times the exponent of distance.
    pub product: Measured,
    /// The same in 3 × 3 regions of the image, row by row; `None` where too few images reach.
    pub region_products: [[Option<Measured>; N_REGIONS]; N_REGIONS],
    /// Distance from the light (m) and linear intensity freed of everything else, relative to that at 1 m; one an image.
    pub curve: Vec<[f64; 2]>,
    /// Nearest and farthest distance, metres.
    pub range_m: [f64; 2],
}

impl InverseSquare {
    /// The exponent of distance, given the exponent of the response; −2 by theory.
    pub fn exponent(product: &Measured, gamma: &Measured) -> Measured {
        let value = product.value / gamma.value;
        let relative = (product.sigma / product.value).hypot(gamma.sigma / gamma.value);
        Measured {
            value,
            sigma: value.abs() * relative,
        }
    }
}

/// Regions on each axis.
pub const N_REGIONS: usize = 3;
/// The farthest image must be this many times as far as the nearest.
const MIN_RATIO: f64 = 1.4;
/// The whole image, and a region by itself, needs this many images.
const MIN_IMAGES: usize = 4;

/// Measures the inverse square law on the wall of a session.
///
/// # Errors
/// If the session shows no wall, or in too few images, or only at one distance.
pub fn inverse_square(
    scans: &[Scan],
    session: usize,
    sensor: &Sensor,
    estimate: &Estimate,
) -> Result<InverseSquare, Refusal> {
    let (scan, state) = (&scans[session], &estimate.state);
    debug_assert_eq!(scan.target, Target::Wall);
    let points: Vec<Point> = wall_intensities(scan, session, sensor)
        .iter()
        .filter_map(|sample| point(sample, state))
        .collect();
    let whole = by_image(&points, state.gamma, |_| true);
    let product = slope(&whole).ok_or_else(|| Refusal::FewImages {
        session: scan.name.clone(),
        n_images: whole.len(),
        required: MIN_IMAGES,
    })?;
    let range_m = whole
        .iter()
        .fold([f64::MAX, 0.0f64], |[near, far], [log_d, _]| {
            [near.min(log_d.exp()), far.max(log_d.exp())]
        });
    if range_m[1] < MIN_RATIO * range_m[0] {
        return Err(Refusal::OneDistance {
            session: scan.name.clone(),
            range_m,
            ratio: MIN_RATIO,
        });
    }
    let region_products = std::array::from_fn(|row| {
        std::array::from_fn(|column| {
            slope(&by_image(&points, state.gamma, |p| {
                p.region == [column, row]
            }))
        })
    });
    let curve = whole
        .iter()
        .map(|[log_d, value]| [log_d.exp(), (value / state.gamma).exp()])
        .collect();
    Ok(InverseSquare {
        product,
        region_products,
        curve,
        range_m,
    })
}

/// One sample: the logarithm of its distance, and what the model leaves of the logarithm of its observed intensity.
struct Point {
    image_number: usize,
    region: [usize; 2],
    log_distance: f64,
    residual: f64,
}

fn point(sample: &Sample, state: &State) -> Option<Point> {
    let Place::Wall { point, .. } = sample.place else {
        return None;
    };
    let log_distance = (state.light.position - point).norm().ln();
    let (log_linear, _) = log_linear(sample, state)?;
    // The flat field's own extent is the image's.
    let (x, y) = (state.flat.grid.x, state.flat.grid.y);
    let region = |at: f64, [first, last]: [f64; 2]| {
        (((at - first) / (last - first) * N_REGIONS as f64) as usize).min(N_REGIONS - 1)
    };
    Some(Point {
        image_number: sample.image_number,
        region: [region(sample.ray[0], x), region(sample.ray[1], y)],
        log_distance,
        residual: sample.log_observed - state.gamma * log_linear,
    })
}

/// Of each image the mean log distance, and the log intensity there freed of all but the distance.
fn by_image(points: &[Point], gamma: f64, keep: impl Fn(&Point) -> bool) -> Vec<[f64; 2]> {
    /// Fewer samples do not stand for an image.
    const MIN_SAMPLES: usize = 20;
    let kept: Vec<&Point> = points.iter().filter(|p| keep(p)).collect();
    kept.chunk_by(|a, b| a.image_number == b.image_number)
        .filter(|image| image.len() >= MIN_SAMPLES)
        .filter_map(|image| {
            let n = image.len() as f64;
            let log_distance = image.iter().map(|p| p.log_distance).sum::<f64>() / n;
            let mut residuals: Vec<f64> = image.iter().map(|p| p.residual).collect();
            let residual = median(&mut residuals)?;
            Some([log_distance, residual - 2.0 * gamma * log_distance])
        })
        .collect()
}

/// Slope of a line through the images' points, with its standard deviation from their scatter.
fn slope(points: &[[f64; 2]]) -> Option<Measured> {
    let n = points.len() as f64;
    if points.len() < MIN_IMAGES {
        return None;
    }
    let mean = |axis: usize| points.iter().map(|p| p[axis]).sum::<f64>() / n;
    let (mx, my) = (mean(0), mean(1));
    let sxx: f64 = points.iter().map(|p| (p[0] - mx).powi(2)).sum();
    let sxy: f64 = points.iter().map(|p| (p[0] - mx) * (p[1] - my)).sum();
    let value = sxy / sxx;
    let squares: f64 = points
        .iter()
        .map(|p| (p[1] - my - value * (p[0] - mx)).powi(2))
        .sum();
    Some(Measured {
        value,
        sigma: (squares / (n - 2.0) / sxx).sqrt(),
    })
}
