//! What a sensor makes of a picture: response, noise, quantisation and the pixels that it loses.
//!
//! Figures are of the order that the literature gives for the two Kinects (Khoshelham and Elberink 2012, Fankhauser et al.
//! 2015, Sarbolandi et al. 2015); where it gives none they are arbitrary. Not modelled: interreflection, warm-up, wiggling
//! over range, flicker of the lamp, a rolling shutter.

use depth_camera::{Image, Intrinsics, LightKind, Sensor};

use crate::{
    infrared::Infrared,
    noise::{Noise, Stream},
    render::{NearLight, Sample},
};

/// Baseline between the Kinect I's camera and its projector, metres; the projector is to the right.
const PROJECTOR_BASELINE_M: f64 = 0.075;

/// A dot of the Kinect I's projector outshines the lamp by up to so much.
const DOT_GAIN: f64 = 1.8;

/// Share of the image that is dots.
const DOT_SHARE: f64 = 0.15;

/// An albedo of 0.75 seen head-on from 0.6 m is exposed to this share of full scale.
const EXPOSED_TO: f64 = 0.7;

/// Full-size lens of the simulated sensors.
pub(crate) fn intrinsics(sensor: Sensor) -> Intrinsics {
    match sensor {
        Sensor::Kinect1 => Intrinsics {
            width: 640,
            height: 480,
            fx: 580.0,
            fy: 580.0,
            cx: 319.5,
            cy: 239.5,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
        },
        Sensor::Kinect2 => Intrinsics {
            width: 512,
            height: 424,
            fx: 365.6,
            fy: 365.6,
            cx: 256.8,
            cy: 205.3,
            k1: 0.0905,
            k2: -0.2675,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0949,
        },
    }
}

/// Where the light of shading images is, camera frame, metres.
pub(crate) fn light_position_m(sensor: Sensor) -> [f64; 3] {
    match sensor {
        Sensor::Kinect1 => [0.12, -0.07, 0.02],
        Sensor::Kinect2 => [0.052, 0.0, 0.004],
    }
}

/// What lights the shading images.
pub(crate) fn light_kind(sensor: Sensor) -> LightKind {
    match sensor {
        Sensor::Kinect1 => LightKind::Lamp,
        Sensor::Kinect2 => LightKind::Emitter,
    }
}

/// The Kinect I's projector as a light; it shines evenly.
pub(crate) fn projector(infrared: &Infrared) -> NearLight {
    NearLight {
        position_m: [PROJECTOR_BASELINE_M, 0.0, 0.0],
        lobe_power: 0.0,
        ..infrared.near_light()
    }
}

/// IR counts at full scale.
pub(crate) fn full_scale(sensor: Sensor) -> f64 {
    match sensor {
        Sensor::Kinect1 => 1023.0,
        Sensor::Kinect2 => 65535.0,
    }
}

/// One exposure: which sensor, and what its noise hangs on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Exposure {
    pub(crate) sensor: Sensor,
    /// Exponent of the response.
    pub(crate) gamma: f64,
    /// The sensor's own: fixed patterns depend on nothing else.
    pub(crate) seed: u64,
    pub(crate) frame: u64,
    /// Pixels are so many times larger than the real sensor's.
    pub(crate) reduction: usize,
}

impl Exposure {
    fn noise(&self, stream: Stream) -> Noise {
        Noise::new(self.seed, self.frame, stream)
    }

    /// Counts under the shading light.
    pub(crate) fn shading_image(&self, picture: &Image<Sample>) -> Image<u16> {
        let noise = self.noise(Stream::Infrared);
        let pixels = picture.data().iter().zip(0..);
        let counts = pixels
            .map(|(sample, pixel)| self.counts(self.exposed(sample.radiance), noise.normal(pixel)));
        Image::from_vec(picture.width(), picture.height(), counts.collect())
    }

    /// Counts under the speckle of the Kinect I's projector; dots keep their place on the surface's disparity.
    pub(crate) fn speckle_image(&self, picture: &Image<Sample>, fx: f64) -> Image<u16> {
        let noise = self.noise(Stream::Infrared);
        let dots = Noise::new(self.seed, 0, Stream::Speckle);
        let width = picture.width() as u64;
        let pixels = picture.data().iter().zip(0..);
        let counts = pixels.map(|(sample, pixel)| {
            let shift = fx * PROJECTOR_BASELINE_M / sample.depth_m.max(0.3);
            let column = pixel % width + shift.round() as u64;
            let dot = dots.uniform((pixel / width) << 32 | column);
            // The rarest hashes are the brightest dots; between dots some light is left.
            let gain = match dot < DOT_SHARE {
                true => DOT_GAIN * (1.0 - 0.8 * dot / DOT_SHARE),
                false => 0.03,
            };
            self.counts(self.exposed(gain * sample.radiance), noise.normal(pixel))
        });
        Image::from_vec(picture.width(), picture.height(), counts.collect())
    }

    /// Radiance relative to full scale.
    fn exposed(&self, radiance: f64) -> f64 {
        let white = 0.75 / 0.6_f64.powi(2);
        radiance / white * EXPOSED_TO.powf(1.0 / self.gamma)
    }

    /// Response, shot and read noise, quantisation and clipping.
    fn counts(&self, relative: f64, normal: f64) -> u16 {
        let full_scale = full_scale(self.sensor);
        let signal = relative.powf(self.gamma) * full_scale;
        let (sigma, step) = match self.sensor {
            // Bits of 10: 1.5 of read noise, shot noise beside it.
            Sensor::Kinect1 => ((1.5 * 1.5 + 0.02 * signal).sqrt(), 1.0),
            // 0.75 % at half of full scale, 0.15 % in the dark.
            Sensor::Kinect2 => {
                let share = (2.25e-6 + 2.35e-5 * signal / full_scale).sqrt();
                (share * full_scale, 128.0)
            }
        };
        let quantised = ((signal + sigma * normal) / step).round() * step;
        quantised.clamp(0.0, full_scale) as u16
    }

    /// Depth as the sensor measures it, metres; 0 is no measurement.
    pub(crate) fn depth_image(&self, picture: &Image<Sample>, fx: f64) -> Image<f32> {
        match self.sensor {
            Sensor::Kinect1 => self.structured_light_depth(picture, fx),
            Sensor::Kinect2 => self.time_of_flight_depth(picture, fx),
        }
    }

    /// Kinect II: noise grows as the signal fades, the driver smooths over 3×3 pixels, edges and grazing views are dropped.
    fn time_of_flight_depth(&self, picture: &Image<Sample>, fx: f64) -> Image<f32> {
        // The kernel's root of summed squares: what it leaves of white noise.
        const KERNEL: [f64; 3] = [0.25, 0.5, 0.25];
        const KERNEL_GAIN: f64 = 0.375;
        const FIXED_PATTERN_M: f64 = 0.5e-3;
        let noise = self.noise(Stream::Depth);
        let dropout = self.noise(Stream::Dropout);
        let pattern = Noise::new(self.seed, 0, Stream::FixedPattern);

        let (width, height) = (picture.width(), picture.height());
        let pixels = picture.data().iter().zip(0..);
        let raw: Vec<f64> = pixels
            .map(|(s, pixel)| s.depth_m + flight_sigma_m(s) / KERNEL_GAIN * noise.normal(pixel))
            .collect();
        let mut depth = Image::filled(width, height, 0.0);
        for v in 1..height.saturating_sub(1) {
            for u in 1..width.saturating_sub(1) {
                let pixel = v * width + u;
                let sample = picture.at(u, v);
                let chance = dropout.uniform(pixel as u64);
                if flight_loses(sample, chance) || at_depth_edge(picture, u, v, fx) {
                    continue;
                }
                let mut smoothed = FIXED_PATTERN_M * pattern.normal(pixel as u64);
                for (dv, row_weight) in KERNEL.iter().enumerate() {
                    for (du, weight) in KERNEL.iter().enumerate() {
                        smoothed += row_weight * weight * raw[(v + dv - 1) * width + u + du - 1];
                    }
                }
                depth.data_mut()[pixel] = smoothed as f32;
            }
        }
        depth
    }

    /// Kinect I: disparity in eighths of a pixel from a correlation window, seen by camera and projector, in millimetres.
    fn structured_light_depth(&self, picture: &Image<Sample>, fx: f64) -> Image<f32> {
        const NOISE_PX: f64 = 0.1;
        const STEPS_PER_PX: f64 = 8.0;
        // Of the real sensor's pixels, whatever the size of ours: reduced images carry the same depth noise.
        let focal_px = fx * self.reduction as f64;
        let window = Window::of_reduction(self.reduction);
        let noise = self.noise(Stream::Depth);
        let raw_noise_px = NOISE_PX * (window.n_pixels() as f64).sqrt();

        let (width, height) = (picture.width(), picture.height());
        let true_px = picture.map(
            |s| match s.lit && s.cos_incidence > 0.15 && s.depth_m > 0.4 {
                true => focal_px * PROJECTOR_BASELINE_M / s.depth_m,
                false => 0.0,
            },
        );
        let noise_px: Vec<f64> = (0..(width * height) as u64)
            .map(|pixel| raw_noise_px * noise.normal(pixel))
            .collect();
        let depth = (0..width * height).map(|pixel| {
            let disparity = window.mean(&true_px, &noise_px, pixel % width, pixel / width);
            disparity.map_or(0.0, |px| {
                let steps = (px * STEPS_PER_PX).round();
                let metres = focal_px * PROJECTOR_BASELINE_M * STEPS_PER_PX / steps;
                ((metres * 1000.0).round() / 1000.0) as f32
            })
        });
        Image::from_vec(width, height, depth.collect())
    }
}

/// Deviation of the Kinect II's depth after its filter: a floor, and phase noise that grows as the returned light fades.
/// Together 1.2 mm for an albedo of 0.75 seen head-on from 0.6 m.
fn flight_sigma_m(sample: &Sample) -> f64 {
    const FLOOR_M: f64 = 1.14e-3;
    const PHASE_M: f64 = 0.38e-3;
    let returned = (sample.albedo * sample.cos_incidence.max(0.05) / 0.75).max(1e-3);
    FLOOR_M.hypot(PHASE_M * (sample.depth_m / 0.6).powi(2) / returned)
}

/// Out of range, too dark, or grazing: from 70° on ever more often, beyond 80° always.
fn flight_loses(sample: &Sample, chance: f64) -> bool {
    let out_of_range = !(0.4..=4.5).contains(&sample.depth_m);
    let grazing = (0.34 - sample.cos_incidence) / 0.17;
    out_of_range || chance < grazing || flight_sigma_m(sample) > 0.025
}

/// Whether the 3×3 pixels about this one hold a step in depth that the surface's own slope does not explain.
fn at_depth_edge(picture: &Image<Sample>, u: usize, v: usize, fx: f64) -> bool {
    let centre = picture.at(u, v);
    let cos = centre.cos_incidence.clamp(0.1, 1.0);
    let slope = (1.0 - cos * cos).sqrt() / cos;
    let limit_m = 0.008 + 3.0 * slope * centre.depth_m / fx;
    let rows = [v - 1, v, v + 1].into_iter();
    rows.flat_map(|row| &picture.row(row)[u - 1..=u + 1])
        .any(|s| s.depth_m == 0.0 || (s.depth_m - centre.depth_m).abs() > limit_m)
}

/// The Kinect I's correlation window, 9×7 pixels of the real sensor.
struct Window {
    half_width: usize,
    half_height: usize,
}

impl Window {
    fn of_reduction(reduction: usize) -> Self {
        Window {
            half_width: 4 / reduction,
            half_height: 3 / reduction,
        }
    }

    fn n_pixels(&self) -> usize {
        (2 * self.half_width + 1) * (2 * self.half_height + 1)
    }

    /// Mean disparity, noise included, over the pixels of the same surface; `None` if they fill less than half the window.
    fn mean(&self, true_px: &Image<f64>, noise_px: &[f64], u: usize, v: usize) -> Option<f64> {
        const SAME_SURFACE_PX: f64 = 2.0;
        let width = true_px.width();
        let centre = *true_px.at(u, v);
        let fits = u >= self.half_width
            && v >= self.half_height
            && u + self.half_width < width
            && v + self.half_height < true_px.height();
        if centre <= 0.0 || !fits {
            return None;
        }
        let (mut sum, mut count) = (0.0, 0);
        for row in v - self.half_height..=v + self.half_height {
            let columns = row * width + u - self.half_width..=row * width + u + self.half_width;
            for pixel in columns {
                let disparity = true_px.data()[pixel];
                if (disparity - centre).abs() < SAME_SURFACE_PX {
                    sum += disparity + noise_px[pixel];
                    count += 1;
                }
            }
        }
        (2 * count > self.n_pixels()).then(|| sum / f64::from(count as u32))
    }
}
