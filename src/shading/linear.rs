//! From observed IR to linear intensity: the response and the flat field removed, the pixel's own blur undone.

use super::Calibration;
use crate::geometry::Bilinear;
use crate::geometry::lanes::{LANES, Lane, floor};
use depth_camera::Image;
use nalgebra::Vector2;

/// From this share of full scale a pixel counts as saturated. Where exposures or finer pixels are averaged, one that was clipped in
/// most of them comes out a little below full scale.
pub const SATURATION: f64 = 0.985;

/// Linear intensity with its standard deviation, both as shares of full scale on the optical axis.
#[derive(Clone, Debug)]
pub struct LinearImage {
    /// Linear intensity with the pixel's own blur taken off; NaN where the pixel was saturated, black, or has no ray.
    pub value: Image<f32>,
    /// The same as the pixel integrated it, blur and all.
    pub integrated: Image<f32>,
    /// Standard deviation of `integrated`. That [`sharpen`], by which `value` comes from it, makes noise half as large again is not in it.
    pub sigma: Image<f32>,
}

/// Variance that a pixel's box (1/12) and bilinear sampling (1/6) add on each axis, square pixels.
const FOOTPRINT_VARIANCE_PX2: f32 = 0.25;

/// Inverts Eq. (1) for a whole image: `L = (I / full scale)^(1/gamma) / flat`, then takes the footprint's blur off with
/// `L − (var/2) ∇²L`. The noise goes with it: `sigma_L = sigma_I · (1/gamma) · I^(1/gamma − 1) / flat`.
///
/// `saturation` is the share of full scale from which a pixel counts as saturated, `flat` the flat field's [image](super::FlatField::image).
pub fn linearise(
    counts: &Image<f32>,
    full_scale: f64,
    saturation: f64,
    calibration: &Calibration,
    flat: &Image<f64>,
) -> LinearImage {
    let inv_gamma = 1.0 / calibration.gamma;
    let (mut value, mut sigma) = (Vec::new(), Vec::new());
    for (&counts, &flat) in counts.data().iter().zip(flat.data()) {
        let observed = counts as f64 / full_scale;
        if observed >= saturation || observed <= calibration.noise.read || flat.is_nan() {
            value.push(f32::NAN);
            sigma.push(f32::NAN);
            continue;
        }
        // In single precision, as it is kept: powers are most of the time.
        let linear = f64::from((observed as f32).powf(inv_gamma as f32));
        value.push((linear / flat) as f32);
        sigma.push(
            (calibration.noise.sigma(observed) * inv_gamma * linear / observed / flat) as f32,
        );
    }
    let (width, height) = (counts.width(), counts.height());
    let integrated = Image::from_vec(width, height, value);
    LinearImage {
        value: sharpen(&integrated),
        integrated,
        sigma: Image::from_vec(width, height, sigma),
    }
}

/// Counts that the lamp alone makes where `unlit` are those without it: light adds up before the response,
/// `I_lamp = (I^(1/gamma) − I_unlit^(1/gamma))^gamma`. Pixels from `saturated` counts on stay as they are.
pub fn without_ambient(
    counts: &Image<f32>,
    unlit: &Image<f32>,
    saturated: f64,
    gamma: f64,
) -> Image<f32> {
    let linear = |counts: f32| f64::from(counts.max(0.0)).powf(1.0 / gamma);
    let pixels = counts.data().iter().zip(unlit.data());
    let pixels = pixels.map(|(&counts, &unlit)| match f64::from(counts) >= saturated {
        true => counts,
        false => (linear(counts) - linear(unlit)).max(0.0).powf(gamma) as f32,
    });
    Image::from_vec(counts.width(), counts.height(), pixels.collect())
}

/// Takes the footprint's blur off an image as its pixels integrated it; pixels beside a NaN or the border become NaN.
pub fn sharpen(image: &Image<f32>) -> Image<f32> {
    let (width, height) = (image.width(), image.height());
    let mut out = Image::filled(width, height, f32::NAN);
    for v in 1..height - 1 {
        let (above, row, below) = (image.row(v - 1), image.row(v), image.row(v + 1));
        for u in 1..width - 1 {
            let laplacian = row[u - 1] + row[u + 1] + above[u] + below[u] - 4.0 * row[u];
            out.data_mut()[v * width + u] = row[u] - 0.5 * FOOTPRINT_VARIANCE_PX2 * laplacian;
        }
    }
    out
}

impl LinearImage {
    /// Value, its gradient (per pixel) and its sigma between pixels, bilinear; `None` where a pixel is missing.
    #[inline]
    pub fn sample(&self, u: f64, v: f64) -> Option<(f64, [f64; 2], f64)> {
        let place = Bilinear::within(&self.value, &Vector2::new(u, v))?;
        let corners = place.corners.map(|at| f64::from(self.value.data()[at]));
        if corners.iter().any(|value| value.is_nan()) {
            return None;
        }
        let (value, gradient) = place.between(corners);
        let sigma = *self.sigma.at((u + 0.5) as usize, (v + 0.5) as usize);
        Some((value, gradient, f64::from(sigma)))
    }
}

/// What an image shows between pixels, at many places.
pub struct LinearSamples {
    /// Value; NaN where a pixel is missing.
    pub value: Lane,
    /// Its gradient, per pixel.
    pub gradient: [Lane; 2],
    /// Its sigma.
    pub sigma: Lane,
}

impl LinearImage {
    /// [`Self::sample`] of many places at once (columns and rows), of which those outside the image are to lie on its first pixel.
    #[inline(always)]
    pub fn samples(&self, u: &Lane, v: &Lane) -> LinearSamples {
        let (value, gradient) = between_pixels(&self.value, u, v);
        let (sigmas, width) = (self.sigma.data(), self.sigma.width() as i32);
        let mut nearest = [0; LANES];
        for i in 0..LANES {
            nearest[i] = floor(v[i] + 0.5) * width + floor(u[i] + 0.5);
        }
        let mut sigma = [0.0; LANES];
        for i in 0..LANES {
            sigma[i] = sigmas[nearest[i] as usize];
        }
        LinearSamples {
            value,
            gradient,
            sigma,
        }
    }
}

/// An image and its gradient (per pixel) at many places between its pixels (columns and rows), bilinear; NaN where a pixel is. Places
/// outside the image are to lie on its first pixel.
#[inline(always)]
pub fn between_pixels(image: &Image<f32>, u: &Lane, v: &Lane) -> (Lane, [Lane; 2]) {
    let width = image.width();
    let mut first = [0; LANES];
    let (mut along, mut down) = ([0.0; LANES], [0.0; LANES]);
    for i in 0..LANES {
        let (column, row) = (floor(u[i]), floor(v[i]));
        along[i] = u[i] - column as f32;
        down[i] = v[i] - row as f32;
        first[i] = row * width as i32 + column;
    }
    let mut corners = [[0.0; LANES]; 4];
    let pixels = image.data();
    for i in 0..LANES {
        let first = first[i] as usize;
        let below = first + width;
        corners[0][i] = pixels[first];
        corners[1][i] = pixels[first + 1];
        corners[2][i] = pixels[below];
        corners[3][i] = pixels[below + 1];
    }
    let [a, b, c, d] = &corners;
    let (mut value, mut gradient) = ([0.0; LANES], [[0.0; LANES]; 2]);
    for i in 0..LANES {
        let (across, across_below) = (b[i] - a[i], d[i] - c[i]);
        let (top, bottom) = (a[i] + across * along[i], c[i] + across_below * along[i]);
        value[i] = top + (bottom - top) * down[i];
        gradient[0][i] = across + (across_below - across) * down[i];
        gradient[1][i] = bottom - top;
    }
    (value, gradient)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CameraModel, RayGrid};
    use depth_camera::{Intrinsics, Sensor};

    #[test]
    fn ambient_light_is_taken_off_before_the_response() {
        let (lamp, ambient, gamma) = (0.3f64, 0.08f64, 0.8);
        let counts = |linear: f64| (1023.0 * linear.powf(gamma)) as f32;
        let seen = Image::from_vec(3, 1, vec![counts(lamp + ambient), counts(ambient), 1020.0]);
        let unlit = Image::filled(3, 1, counts(ambient));
        let alone = without_ambient(&seen, &unlit, SATURATION * 1023.0, gamma);
        assert!((alone.at(0, 0) - counts(lamp)).abs() < 0.01);
        assert!(*alone.at(1, 0) < 0.1, "{}", alone.at(1, 0));
        assert_eq!(*alone.at(2, 0), 1020.0);
    }

    #[test]
    fn linearising_undoes_response_and_flat_field() {
        let camera = CameraModel::new(Intrinsics {
            width: 64,
            height: 48,
            fx: 60.0,
            fy: 60.0,
            cx: 31.5,
            cy: 23.5,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
        });
        let calibration = Calibration::shipped(Sensor::Kinect2).expect("shipped");
        let truth = 0.3f64;
        let flat = calibration.flat_field.image(&RayGrid::new(camera));
        let counts = flat.map(|flat| (65535.0 * (truth * flat).powf(calibration.gamma)) as f32);
        let linear = linearise(&counts, 65535.0, 0.99, &calibration, &flat);
        let (value, gradient, sigma) = linear.sample(12.3, 40.7).expect("inside");
        assert!((value - truth).abs() < 1e-5);
        assert!(gradient[0].abs() < 1e-5 && gradient[1].abs() < 1e-5);
        assert!(sigma > 0.0 && sigma < 0.05);
        assert!(linear.sample(63.5, 3.0).is_none());
    }

    #[test]
    fn many_places_show_what_each_does() {
        let value = Image::from_vec(4, 3, (0..12).map(|k| (k * k) as f32).collect());
        let mut value_with_hole = value.clone();
        value_with_hole.data_mut()[10] = f32::NAN;
        let image = LinearImage {
            integrated: value.clone(),
            sigma: value,
            value: value_with_hole,
        };
        let line = |by: f32| std::array::from_fn(|lane| by * lane as f32);
        let (columns, rows): (Lane, Lane) = (line(0.18), line(0.12));
        let many = image.samples(&columns, &rows);
        for (lane, (&u, &v)) in columns.iter().zip(&rows).enumerate() {
            let one = image.sample(f64::from(u), f64::from(v));
            let Some((value, gradient, sigma)) = one else {
                assert!(many.value[lane].is_nan());
                continue;
            };
            let close = |many: f32, one: f64| (f64::from(many) - one).abs() < 1e-4;
            assert!(close(many.value[lane], value) && close(many.sigma[lane], sigma));
            assert!((0..2).all(|axis| close(many.gradient[axis][lane], gradient[axis])));
        }
        assert!(many.value[0] == 0.0 && many.value[LANES - 1].is_nan());
    }
}
