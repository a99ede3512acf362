//! Depth as a recording stores it: whole steps of a fraction of a metre, in 16 bits.

/// How many steps of stored depth make one metre; the one place where metres and steps become each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthScale {
    /// Steps in a metre, positive.
    pub units_per_metre: f64,
}

impl DepthScale {
    /// Depth of a stored value, metres; 0 stays no measurement.
    pub fn metres(self, units: u16) -> f32 {
        (f64::from(units) / self.units_per_metre) as f32
    }

    /// The value that stores a depth in metres: the nearest step, or 0 for depth beyond 16 bits, negative or not finite.
    pub fn units(self, metres: f32) -> u16 {
        let units = (f64::from(metres) * self.units_per_metre).round();
        if (1.0..=f64::from(u16::MAX)).contains(&units) {
            units as u16
        } else {
            0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_stored_value_comes_back() {
        for units_per_metre in [1000.0, 1234.5, 5000.0, 50_000.0] {
            let scale = DepthScale { units_per_metre };
            for units in 0..=u16::MAX {
                assert_eq!(scale.units(scale.metres(units)), units);
            }
        }
    }

    #[test]
    fn what_cannot_be_stored_is_no_measurement() {
        let scale = DepthScale {
            units_per_metre: 5000.0,
        };
        for metres in [-1.0, 14.0, f32::NAN, f32::INFINITY, 0.00009] {
            assert_eq!(scale.units(metres), 0, "{metres}");
        }
    }
}
