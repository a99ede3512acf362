//! From the sensor's 11-bit disparity to metres, by the zero plane that the device reports of itself.
//!
//! The sensor compares the speckle with a picture of it that was taken of a plane at a known distance, the zero plane. What
//! it reports is by how far a spot has moved, in eighths of a pixel of the IR camera at its full size, with an offset. libfreenect's
//! own millimetres are the same formula cut down to whole numbers, which overflow from 1085 on.

use depth_camera::{CameraError, Image};

/// What the sensor reports where it sees no pattern.
pub const NO_DISPARITY: u16 = 2047;

/// How many values 11 bits have.
const N_VALUES: usize = 2048;

/// A step is many metres wide out here; with the usual constants 1083 is the last value below.
const MAX_DEPTH_M: f64 = 60.0;

/// The device's own constants of triangulation, in the units in which it reports them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ZeroPlane {
    /// Baseline between IR camera and projector, centimetres.
    pub emitter_distance_cm: f64,
    /// Distance of the zero plane, millimetres in the sense of the pixel size below.
    pub reference_distance_mm: f64,
    /// Size of a pixel on the zero plane, millimetres.
    pub reference_pixel_size_mm: f64,
    /// Offset of the reported disparity, whole pixels.
    pub const_shift: f64,
}

impl ZeroPlane {
    /// What most devices report.
    pub const TYPICAL: ZeroPlane = ZeroPlane {
        emitter_distance_cm: 7.5,
        reference_distance_mm: 120.0,
        reference_pixel_size_mm: 0.1042,
        const_shift: 200.0,
    };

    /// Checks every constant.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] naming the constant, its value and the bound.
    pub fn validate(&self) -> Result<(), CameraError> {
        for (name, value, low, high) in [
            ("emitter_distance_cm", self.emitter_distance_cm, 1.0, 50.0),
            (
                "reference_distance_mm",
                self.reference_distance_mm,
                1.0,
                1e4,
            ),
            (
                "reference_pixel_size_mm",
                self.reference_pixel_size_mm,
                1e-3,
                10.0,
            ),
            ("const_shift", self.const_shift, 0.0, 2048.0),
        ] {
            if !(value >= low && value <= high) {
                return Err(CameraError::Invalid(format!(
                    "zero plane of the device: {name} is {value}, must be {low} to {high}"
                )));
            }
        }
        Ok(())
    }

    /// Focal length of the IR camera at 640 columns, pixels; the usual constants give 575.8.
    pub fn focal_px(&self) -> f64 {
        // The zero plane's figures are those of the sensor's full width of 1280 columns.
        self.reference_distance_mm / (2.0 * self.reference_pixel_size_mm)
    }

    /// Depth of a disparity, metres; `None` for what the sensor does not see and beyond 60 m.
    pub fn depth_m(&self, disparity: u16) -> Option<f64> {
        if disparity >= NO_DISPARITY {
            return None;
        }
        let pixels = (f64::from(disparity) - 4.0 * self.const_shift) / 4.0 - 0.375;
        let moved = pixels * self.reference_pixel_size_mm;
        let remaining = self.emitter_distance_cm - moved;
        let depth_cm = moved * self.reference_distance_mm / remaining + self.reference_distance_mm;
        let depth_m = depth_cm / 100.0;
        (remaining > 0.0 && depth_m > 0.0 && depth_m <= MAX_DEPTH_M).then_some(depth_m)
    }

    /// The disparity nearest to a depth in metres: the inverse of [`ZeroPlane::depth_m`]; [`NO_DISPARITY`] for a depth that
    /// has none.
    pub fn disparity(&self, depth_m: f64) -> u16 {
        let depth_cm = depth_m * 100.0;
        let moved = self.emitter_distance_cm * (depth_cm - self.reference_distance_mm) / depth_cm;
        let pixels = moved / self.reference_pixel_size_mm;
        let disparity = (4.0 * (pixels + 0.375 + self.const_shift)).round();
        match disparity >= 0.0 && disparity < f64::from(NO_DISPARITY) {
            true => disparity as u16,
            false => NO_DISPARITY,
        }
    }
}

/// Depth of every disparity.
#[derive(Clone, Debug, PartialEq)]
pub struct DisparityTable {
    metres: Box<[f32; N_VALUES]>,
}

impl DisparityTable {
    /// The table of a device.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] for constants that make no sense.
    pub fn new(zero_plane: &ZeroPlane) -> Result<Self, CameraError> {
        zero_plane.validate()?;
        let mut metres = Box::new([0.0; N_VALUES]);
        for (disparity, metres) in (0..).zip(metres.iter_mut()) {
            *metres = zero_plane.depth_m(disparity).unwrap_or(0.0) as f32;
        }
        Ok(DisparityTable { metres })
    }

    /// Depth of one disparity, metres; 0 is no measurement.
    pub fn metres(&self, disparity: u16) -> f32 {
        self.metres[usize::from(disparity) % N_VALUES]
    }

    /// Writes the depth of every pixel, metres, 0 where there is none.
    ///
    /// # Panics
    /// If `metres` does not hold as many values as the image.
    pub fn convert(&self, disparity: &Image<u16>, metres: &mut [f32]) {
        assert_eq!(metres.len(), disparity.data().len(), "one depth a pixel");
        for (metres, &disparity) in metres.iter_mut().zip(disparity.data()) {
            *metres = self.metres(disparity);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Steps as users of the device report them for these distances.
    #[test]
    fn steps_grow_with_the_square_of_the_distance() {
        let plane = ZeroPlane::TYPICAL;
        for (distance_m, step_mm) in [(0.5, 0.7), (0.7, 1.5), (0.9, 2.3), (1.2, 4.1), (1.8, 9.7)] {
            let disparity = plane.disparity(distance_m);
            let near = plane.depth_m(disparity).unwrap();
            let far = plane.depth_m(disparity + 1).unwrap();
            let step = (far - near) * 1000.0;
            assert!((near - distance_m).abs() * 1000.0 <= step, "{near}");
            assert!(
                (step - step_mm).abs() < 0.15 * step_mm,
                "{step} at {distance_m}"
            );
        }
    }

    #[test]
    fn depth_grows_with_disparity_until_there_is_none() {
        let plane = ZeroPlane::TYPICAL;
        let table = DisparityTable::new(&plane).unwrap();
        let last = (0..2048).rposition(|d| table.metres(d) > 0.0);
        assert_eq!(last, Some(1083));
        let mut before = 0.0;
        for disparity in 0..=1083 {
            let metres = table.metres(disparity);
            assert!(metres > before, "{disparity}: {metres} m after {before} m");
            assert_eq!(plane.disparity(f64::from(metres)), disparity);
            before = metres;
        }
        assert!(before <= 60.0 && table.metres(1082) > 30.0);
        assert_eq!(table.metres(NO_DISPARITY), 0.0);
    }

    #[test]
    fn the_zero_plane_lies_where_it_was_pictured() {
        let plane = ZeroPlane {
            const_shift: 200.09375,
            ..ZeroPlane::TYPICAL
        };
        // 4 (200.09375 + 0.375) = 801.875: a quarter of an eighth off a whole value on either side.
        let around = [801, 802].map(|d| plane.depth_m(d).unwrap());
        assert!(around[0] < 1.2 && around[1] > 1.2, "{around:?}");
        assert!((plane.focal_px() - 575.8).abs() < 0.05);
    }

    #[test]
    fn constants_that_make_no_sense_are_refused() {
        let plane = ZeroPlane {
            reference_pixel_size_mm: 0.0,
            ..ZeroPlane::TYPICAL
        };
        let message = DisparityTable::new(&plane).unwrap_err().to_string();
        assert!(
            message.contains("reference_pixel_size_mm is 0"),
            "{message}"
        );
        let plane = ZeroPlane {
            emitter_distance_cm: f64::NAN,
            ..ZeroPlane::TYPICAL
        };
        assert!(plane.validate().is_err());
    }

    #[test]
    fn an_image_is_converted_pixel_by_pixel() {
        let table = DisparityTable::new(&ZeroPlane::TYPICAL).unwrap();
        let disparity = Image::from_vec(2, 2, vec![700, NO_DISPARITY, 1084, 0]);
        let mut metres = [9.0; 4];
        table.convert(&disparity, &mut metres);
        assert_eq!(metres[1..3], [0.0, 0.0]);
        assert_eq!([metres[0], metres[3]], [table.metres(700), table.metres(0)]);
    }
}
