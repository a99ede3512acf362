//! A device, scenes with closed-form answers, and the figures of a decoded image against the truth.

#![allow(dead_code, reason = "each test file uses its part")]

use freenect2::{
    Decoded, Decoder, DecoderOptions, HEIGHT, IrParameters, P0Tables, RawPacket, WIDTH,
};
use freenect2_stand_in::{AnsweredCamera, Answers};
use freenect2_synth::{Camera, Encoder, PhaseTables, RayRows, Scene};

pub const CAMERA: Camera = Camera {
    focal: [365.4, 365.4],
    centre: [258.3, 204.9],
    radial: [0.092, -0.271, 0.096],
    tangential: [0.001, -0.0007],
};

pub fn parameters() -> IrParameters {
    let [k1, k2, k3] = CAMERA.radial;
    IrParameters {
        fx: CAMERA.focal[0],
        fy: CAMERA.focal[1],
        cx: CAMERA.centre[0],
        cy: CAMERA.centre[1],
        k1,
        k2,
        k3,
        p1: CAMERA.tangential[0],
        p2: CAMERA.tangential[1],
    }
}

/// What the device answers.
pub fn answers() -> Answers {
    let [fx, fy] = CAMERA.focal.map(|x| x as f32);
    let [cx, cy] = CAMERA.centre.map(|x| x as f32);
    let [k1, k2, k3] = CAMERA.radial.map(|x| x as f32);
    let [p1, p2] = CAMERA.tangential.map(|x| x as f32);
    Answers {
        firmware: "4.3.3912.0".to_owned(),
        p0_response: PhaseTables::varied().response(),
        ir_parameters: AnsweredCamera {
            fx,
            fy,
            cx,
            cy,
            k1,
            k2,
            k3,
            p1,
            p2,
        },
        open_error: String::new(),
        list_error: String::new(),
    }
}

pub fn encoder() -> Encoder {
    Encoder::new(PhaseTables::varied(), &CAMERA, RayRows::Own)
}

pub fn decoder(options: DecoderOptions) -> Decoder {
    let tables =
        P0Tables::from_response(&PhaseTables::varied().response()).expect("the answer is whole");
    Decoder::new(&tables, &parameters(), options).expect("camera and options are good")
}

pub fn decode(decoder: &Decoder, packet: &[u8]) -> Decoded {
    let mut decoded = Decoded::default();
    decoder.decode(
        RawPacket::new(packet).expect("the packet is whole"),
        &mut decoded,
    );
    decoded
}

/// Depth in metres and IR in counts.
pub struct Truth {
    pub depth: Vec<f64>,
    pub ir: Vec<f64>,
}

impl Truth {
    pub fn scene(&self) -> Scene<'_> {
        Scene {
            depth: &self.depth,
            ir: &self.ir,
            ambient: &[],
        }
    }
}

/// A slanted plane with a sphere before it, 0.84 m to 2.5 m away, IR from 12 000 counts down to 400.
pub fn plane_and_sphere() -> Truth {
    let mut truth = Truth {
        depth: Vec::new(),
        ir: Vec::new(),
    };
    for i in 0..WIDTH * HEIGHT {
        let [x, y] = CAMERA.ray(i % WIDTH, i / WIDTH);
        let plane = 1.55 / (1.0 - 0.35 * x + 0.25 * y);
        // A sphere of radius 0.25 m around (0.1, -0.05, 1.1) m.
        let square = x * x + y * y + 1.0;
        let towards = 0.1 * x - 0.05 * y + 1.1;
        let root = towards * towards - square * (1.2225 - 0.0625);
        let z = if root > 0.0 {
            (towards - root.sqrt()) / square
        } else {
            plane
        };
        let stripes = 0.65 + 0.35 * (40.0 * x + 13.0 * y).sin();
        truth.depth.push(z);
        truth.ir.push(8_500.0 * stripes / (z * z));
    }
    truth
}

/// What a decoded packet is worth.
#[derive(Debug)]
pub struct Figures {
    pub depth_rms_m: f64,
    pub depth_p99_m: f64,
    pub ir_relative_p50: f64,
    /// Share of the pixels with a truth that have depth.
    pub valid: f64,
}

impl Figures {
    pub fn of(decoded: &Decoded, truth: &Truth) -> Self {
        let (mut depth, mut ir) = (Vec::new(), Vec::new());
        let mut n_true = 0;
        for i in 0..WIDTH * HEIGHT {
            if truth.depth[i] <= 0.0 {
                continue;
            }
            n_true += 1;
            let z = f64::from(decoded.depth().data()[i]);
            if z > 0.0 {
                depth.push((z - truth.depth[i]).abs());
                let counts = f64::from(decoded.ir().data()[i]);
                ir.push((counts / truth.ir[i] - 1.0).abs());
            }
        }
        depth.sort_by(f64::total_cmp);
        ir.sort_by(f64::total_cmp);
        let squares: f64 = depth.iter().map(|error| error * error).sum();
        Figures {
            depth_rms_m: (squares / depth.len() as f64).sqrt(),
            depth_p99_m: depth[depth.len() * 99 / 100],
            ir_relative_p50: ir[ir.len() / 2],
            valid: depth.len() as f64 / f64::from(n_true),
        }
    }
}
