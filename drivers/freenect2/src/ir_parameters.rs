//! The IR camera as the device describes it.

use depth_camera::Intrinsics;
use serde::{Deserialize, Serialize};

use crate::{HEIGHT, WIDTH};

/// Newton's iterations from the distorted position; a lens that needs more folds the image over.
const MAX_ITERATIONS: usize = 20;
/// A solution is good when it is met to this distance, in normalised coordinates: 4·10⁻⁸ pixels.
const TOLERANCE: f64 = 1e-10;

/// A parameter that no camera has.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("IR parameter {key} is {value}, must be {bound}")]
pub struct IrParameterError {
    /// Which one.
    pub key: &'static str,
    /// What it is.
    pub value: f64,
    /// What it must be.
    pub bound: &'static str,
}

/// The IR camera of a Kinect II as its firmware and libfreenect2 give it: Brown–Conrady, in pixels of the mirrored image,
/// whose first pixel has its centre at (0.5, 0.5).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IrParameters {
    /// Horizontal focal length, pixels.
    pub fx: f64,
    /// Vertical focal length, pixels.
    pub fy: f64,
    /// Principal point, pixels from the image's left edge.
    pub cx: f64,
    /// Principal point, pixels from the image's top edge.
    pub cy: f64,
    /// Radial distortion, r² term.
    pub k1: f64,
    /// Radial distortion, r⁴ term.
    pub k2: f64,
    /// Radial distortion, r⁶ term.
    pub k3: f64,
    /// Tangential distortion, first term.
    pub p1: f64,
    /// Tangential distortion, second term.
    pub p2: f64,
}

impl IrParameters {
    /// Refuses what no camera has.
    ///
    /// # Errors
    /// [`IrParameterError`] for a focal length that is not positive, a principal point outside the image, and values that
    /// are not finite.
    pub fn validate(&self) -> Result<(), IrParameterError> {
        for (key, value) in [("fx", self.fx), ("fy", self.fy)] {
            check(key, value, value > 0.0, "positive and finite")?;
        }
        let within = |value: f64, side: usize| (0.5..=side as f64 - 0.5).contains(&value);
        check("cx", self.cx, within(self.cx, WIDTH), "from 0.5 to 511.5")?;
        check("cy", self.cy, within(self.cy, HEIGHT), "from 0.5 to 423.5")?;
        for (key, value) in [
            ("k1", self.k1),
            ("k2", self.k2),
            ("k3", self.k3),
            ("p1", self.p1),
            ("p2", self.p2),
        ] {
            check(key, value, true, "finite")?;
        }
        Ok(())
    }

    /// The camera of the image as it is without the mirror, with pixel centres at integers.
    pub fn intrinsics(&self) -> Intrinsics {
        let mirrored = self.mirrored_intrinsics();
        Intrinsics {
            cx: (WIDTH - 1) as f64 - mirrored.cx,
            p2: -mirrored.p2,
            ..mirrored
        }
    }

    /// The camera of the mirrored image, with pixel centres at integers.
    pub fn mirrored_intrinsics(&self) -> Intrinsics {
        Intrinsics {
            width: WIDTH,
            height: HEIGHT,
            fx: self.fx,
            fy: self.fy,
            cx: self.cx - 0.5,
            cy: self.cy - 0.5,
            k1: self.k1,
            k2: self.k2,
            p1: self.p1,
            p2: self.p2,
            k3: self.k3,
        }
    }

    /// Where the ray of pixel (u, v) of the mirrored image meets the plane at unit depth; `None` where the lens model has
    /// no such ray.
    pub(crate) fn ray(&self, u: usize, v: usize) -> Option<[f64; 2]> {
        let target = [
            (u as f64 + 0.5 - self.cx) / self.fx,
            (v as f64 + 0.5 - self.cy) / self.fy,
        ];
        let [mut x, mut y] = target;
        for _ in 0..MAX_ITERATIONS {
            let Distorted { at, dx, dy } = self.distort(x, y);
            let [ex, ey] = [at[0] - target[0], at[1] - target[1]];
            if ex.abs().max(ey.abs()) < TOLERANCE {
                return Some([x, y]);
            }
            let determinant = dx[0] * dy[1] - dy[0] * dx[1];
            // Where the determinant is not positive the lens has folded the image over.
            if determinant.is_nan() || determinant <= 0.0 {
                return None;
            }
            x -= (dy[1] * ex - dy[0] * ey) / determinant;
            y -= (dx[0] * ey - dx[1] * ex) / determinant;
        }
        None
    }

    /// The model of [`Intrinsics`], with its derivatives.
    fn distort(&self, x: f64, y: f64) -> Distorted {
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        let slope = self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3);
        let (p1, p2) = (self.p1, self.p2);
        let mixed = 2.0 * (x * y * slope + p1 * x + p2 * y);
        Distorted {
            at: [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            dx: [
                radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
                mixed,
            ],
            dy: [
                mixed,
                radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
            ],
        }
    }
}

/// A distorted position and its derivatives by x and by y.
struct Distorted {
    at: [f64; 2],
    dx: [f64; 2],
    dy: [f64; 2],
}

fn check(
    key: &'static str,
    value: f64,
    holds: bool,
    bound: &'static str,
) -> Result<(), IrParameterError> {
    if holds && value.is_finite() {
        return Ok(());
    }
    Err(IrParameterError { key, value, bound })
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A camera like a real one.
    pub(crate) fn typical() -> IrParameters {
        IrParameters {
            fx: 365.4,
            fy: 365.4,
            cx: 258.3,
            cy: 204.9,
            k1: 0.092,
            k2: -0.271,
            k3: 0.096,
            p1: 0.001,
            p2: -0.0007,
        }
    }

    #[test]
    fn rays_meet_their_pixels() {
        let camera = typical();
        for (u, v) in [
            (0, 0),
            (511, 0),
            (0, 423),
            (511, 423),
            (256, 212),
            (17, 300),
        ] {
            let [x, y] = camera.ray(u, v).unwrap();
            let at = camera.distort(x, y).at;
            let pixel = [
                at[0] * camera.fx + camera.cx - 0.5,
                at[1] * camera.fy + camera.cy - 0.5,
            ];
            assert!((pixel[0] - u as f64).abs() < 1e-6, "{pixel:?}");
            assert!((pixel[1] - v as f64).abs() < 1e-6, "{pixel:?}");
        }
    }

    #[test]
    fn the_derivatives_are_those_of_differences() {
        let (camera, step) = (typical(), 1e-6);
        let (x, y) = (0.31, -0.44);
        let Distorted { dx, dy, .. } = camera.distort(x, y);
        for i in 0..2 {
            let by_x = camera.distort(x + step, y).at[i] - camera.distort(x - step, y).at[i];
            let by_y = camera.distort(x, y + step).at[i] - camera.distort(x, y - step).at[i];
            assert!((by_x / (2.0 * step) - dx[i]).abs() < 1e-8);
            assert!((by_y / (2.0 * step) - dy[i]).abs() < 1e-8);
        }
    }

    #[test]
    fn the_mirror_moves_centre_and_tangential_term() {
        let (as_is, turned) = (typical().mirrored_intrinsics(), typical().intrinsics());
        assert!((as_is.cx + turned.cx - 511.0).abs() < 1e-12);
        assert!((as_is.cx - 257.8).abs() < 1e-12);
        assert_eq!(as_is.p2, -turned.p2);
        assert_eq!(as_is.cy, turned.cy);
    }

    #[test]
    fn values_no_camera_has_are_named() {
        let refused = |camera: IrParameters| camera.validate().unwrap_err().to_string();
        assert!(typical().validate().is_ok());
        assert_eq!(
            refused(IrParameters {
                fx: 0.0,
                ..typical()
            }),
            "IR parameter fx is 0, must be positive and finite"
        );
        assert_eq!(
            refused(IrParameters {
                cy: 424.0,
                ..typical()
            }),
            "IR parameter cy is 424, must be from 0.5 to 423.5"
        );
        assert_eq!(
            refused(IrParameters {
                k3: f64::NAN,
                ..typical()
            }),
            "IR parameter k3 is NaN, must be finite"
        );
    }

    #[test]
    fn a_lens_that_folds_the_image_has_no_ray_there() {
        let folding = IrParameters {
            k1: -0.9,
            k2: 0.0,
            k3: 0.0,
            ..typical()
        };
        assert_eq!(folding.ray(0, 0), None);
        assert!(folding.ray(256, 212).is_some());
    }
}
