//! Raw Kinect II packets made from depth and IR: the decoder's inverse, in closed form.
//!
//! For tests of the decoder and of what lies behind it. Nothing is shared with the decoder, not even a constant, so that a
//! mistake cannot cancel against itself; arithmetic is in `f64` and takes its time.
//!
//! For each pixel, depth z and the undistorted ray give the way d of the light, and with it the three phases; IR gives the
//! amplitudes. Nine exposures follow, which are rounded to the sensor's logarithmic 11-bit code and packed.

use std::f64::consts::{PI, TAU};

/// Columns of every image.
pub const WIDTH: usize = 512;
/// Rows of every image.
pub const HEIGHT: usize = 424;

/// Light's way after which each frequency repeats, metres.
const REPEAT_M: [f64; 3] = [3.75, 18.75, 2.5];
/// Mean amplitude of the equalised frequencies per IR count.
const AMPLITUDE_PER_IR: f64 = 1.0 / 16.0;
/// What the amplitudes are multiplied by to be equal.
const EQUALISER: [f64; 3] = [1.322581, 1.0, 1.612903];
/// Twice the distance from camera to emitter, metres. The square of the distance is left out of the light's way, as the ranging of
/// libfreenect2 leaves it out.
const EMITTER_TERM_M: f64 = 0.090;
/// Radians per unit of a phase table.
const RADIANS_PER_UNIT: f64 = 0.000031 * PI;

/// The IR camera: Brown–Conrady, pixels of the mirrored image, pixel centres at halves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Focal lengths: fx, fy.
    pub focal: [f64; 2],
    /// Principal point: cx, cy.
    pub centre: [f64; 2],
    /// Radial distortion: k1, k2, k3.
    pub radial: [f64; 3],
    /// Tangential distortion: p1, p2.
    pub tangential: [f64; 2],
}

impl Camera {
    /// The undistorted ray of a pixel at unit depth, by fixed-point iteration.
    pub fn ray(&self, u: usize, v: usize) -> [f64; 2] {
        let distorted = [
            (u as f64 + 0.5 - self.centre[0]) / self.focal[0],
            (v as f64 + 0.5 - self.centre[1]) / self.focal[1],
        ];
        let [k1, k2, k3] = self.radial;
        let [p1, p2] = self.tangential;
        let [mut x, mut y] = distorted;
        for _ in 0..500 {
            let r2 = x * x + y * y;
            let radial = 1.0 + k1 * r2 + k2 * r2.powi(2) + k3 * r2.powi(3);
            let shift_x = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
            let shift_y = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
            x = (distorted[0] - shift_x) / radial;
            y = (distorted[1] - shift_y) / radial;
        }
        [x, y]
    }
}

/// The phase tables of a device: three of 424 rows of 512 units.
#[derive(Clone, Debug, PartialEq)]
pub struct PhaseTables(pub [Vec<u16>; 3]);

impl PhaseTables {
    /// Tables that vary over rows, columns and frequencies, and wrap.
    pub fn varied() -> Self {
        let table = |k: usize| {
            (0..WIDTH * HEIGHT)
                .map(|i| {
                    let (u, v) = (i % WIDTH, i / WIDTH);
                    ((k + 1) * 9001 + u * (37 + k) + v * (53 - 7 * k) + u % 4 * 211) as u16
                })
                .collect()
        };
        PhaseTables([table(0), table(1), table(2)])
    }

    /// The device's answer that holds these tables.
    pub fn response(&self) -> Vec<u8> {
        let mut bytes = vec![0xA5; 32];
        for table in &self.0 {
            bytes.extend([0xB6; 2]);
            bytes.extend(table.iter().flat_map(|units| units.to_le_bytes()));
            bytes.extend([0xC7; 2]);
        }
        bytes
    }
}

/// What a packet is to show, row by row from the top, in the mirrored image.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// Metres; 0 is no signal at all.
    pub depth: &'a [f64],
    /// Counts, at most 65 535.
    pub ir: &'a [f64],
    /// Linear counts of the tenth sub-image; empty for none.
    pub ambient: &'a [f64],
}

/// Which row's rays the depth is measured along.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RayRows {
    /// The pixel's own.
    Own,
    /// Those of the image turned upside down, as libfreenect2's CPU decoder takes them.
    UpsideDown,
}

/// Makes packets for one device.
#[derive(Clone, Debug)]
pub struct Encoder {
    tables: PhaseTables,
    rays: Vec<[f64; 2]>,
    /// Sorted positive values of the code; the index is the code.
    code_values: Vec<f64>,
}

impl Encoder {
    /// An encoder for a device with these tables and this camera.
    pub fn new(tables: PhaseTables, camera: &Camera, ray_rows: RayRows) -> Self {
        let ray = |i: usize| {
            let (u, v) = (i % WIDTH, i / WIDTH);
            match ray_rows {
                RayRows::Own => camera.ray(u, v),
                RayRows::UpsideDown => camera.ray(u, 423 - v),
            }
        };
        Encoder {
            tables,
            rays: (0..WIDTH * HEIGHT).map(ray).collect(),
            code_values: positive_code_values(),
        }
    }

    /// The packet that shows `scene`, without noise.
    pub fn packet(&self, scene: Scene<'_>) -> Vec<u8> {
        self.packet_with_noise(scene, || 0.0)
    }

    /// The packet that shows `scene`, with a value of `noise` added to each exposure of each pixel, linear counts.
    pub fn packet_with_noise(&self, scene: Scene<'_>, mut noise: impl FnMut() -> f64) -> Vec<u8> {
        let mut packet = vec![0; 10 * HEIGHT * 704];
        for i in 0..WIDTH * HEIGHT {
            let (u, v) = (i % WIDTH, i / WIDTH);
            if scene.depth[i] > 0.0 {
                let samples = self.exposures(i, scene.depth[i], scene.ir[i]);
                for (sub_image, sample) in samples.into_iter().enumerate() {
                    put_code(&mut packet, sub_image, u, v, self.code(sample + noise()));
                }
            }
            if let Some(&ambient) = scene.ambient.get(i) {
                put_code(&mut packet, 9, u, v, self.code(ambient));
            }
        }
        packet
    }

    /// The nine exposures of a pixel, linear counts.
    fn exposures(&self, i: usize, z: f64, ir: f64) -> [f64; 9] {
        let [x, y] = self.rays[i];
        let along_ray = z * (x * x + y * y + 1.0).sqrt();
        let way_m = along_ray + (along_ray * along_ray - EMITTER_TERM_M * z * x).sqrt();
        std::array::from_fn(|sub_image| {
            let (k, j) = (sub_image / 3, sub_image % 3);
            let phase = TAU * way_m / REPEAT_M[k];
            let reference = -f64::from(self.tables.0[k][i]) * RADIANS_PER_UNIT;
            let amplitude = ir * AMPLITUDE_PER_IR / EQUALISER[k];
            amplitude * (phase + reference + j as f64 * TAU / 3.0).cos()
        })
    }

    /// The code nearest to a value; saturated beyond the largest.
    fn code(&self, value: f64) -> u16 {
        let magnitude = value.abs();
        if magnitude > 16_352.0 {
            return 1024;
        }
        let above = self.code_values.partition_point(|&code| code < magnitude);
        let below = above.saturating_sub(1);
        let nearer_below = match self.code_values.get(above) {
            Some(&high) => magnitude - self.code_values[below] < high - magnitude,
            None => true,
        };
        let code = if nearer_below { below } else { above } as u16;
        if value < 0.0 && code > 0 {
            code + 1024
        } else {
            code
        }
    }
}

/// Eight segments of 128 codes whose steps double from the third on.
fn positive_code_values() -> Vec<f64> {
    let mut values = Vec::with_capacity(1024);
    let mut value = 0.0;
    for step in [1.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0] {
        for _ in 0..128 {
            values.push(value);
            value += step;
        }
    }
    values
}

/// Writes the eleven bits of a pixel, one by one.
fn put_code(packet: &mut [u8], sub_image: usize, u: usize, v: usize, code: u16) {
    let stored_row = if v >= 212 { 635 - v } else { v };
    let slot = (u >> 2) + ((u & 3) << 7);
    for bit in 0..11 {
        let place = 8 * (sub_image * 298_496 + stored_row * 704) + 11 * slot + bit;
        let mask = 1 << (place % 8);
        packet[place / 8] &= !mask;
        if code >> bit & 1 == 1 {
            packet[place / 8] |= mask;
        }
    }
}

/// Puts the code of a flooded pixel into one exposure of a packet.
pub fn saturate(packet: &mut [u8], sub_image: usize, u: usize, v: usize) {
    put_code(packet, sub_image, u, v, 1024);
}
