//! What a decoder can be told.

/// Smooths the measured phasors before unwrapping, across pixels whose phases agree within their noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BilateralOptions {
    /// Neighbours whose phases differ by so many standard deviations do not count at all. The three frequencies are judged
    /// together: of neighbours on the same flat surface, the default leaves out 1 in 6000.
    pub cutoff_sigmas: f32,
    /// Difference of the light's way between neighbouring pixels that counts as one standard deviation, beside noise, metres.
    /// The default is that of a surface at 1 m, tilted by 48°.
    pub same_surface_m: f32,
}

impl Default for BilateralOptions {
    fn default() -> Self {
        BilateralOptions {
            cutoff_sigmas: 4.5,
            same_surface_m: 0.006,
        }
    }
}

/// Takes out pixels that mix the depths of two surfaces, and pixels that stand alone.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EdgeAwareOptions {
    /// Steepest surface that is believed: tangent of its tilt against the image plane. The default is 80°.
    pub max_slope: f32,
    /// Standard deviations of a pixel's own depth that are no edge.
    pub sigmas: f32,
    /// Neighbours, of eight, on the same surface that a pixel needs.
    pub min_neighbours: u8,
}

impl Default for EdgeAwareOptions {
    fn default() -> Self {
        EdgeAwareOptions {
            max_slope: 5.67,
            sigmas: 3.0,
            min_neighbours: 2,
        }
    }
}

/// What decides how a packet is decoded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DecoderOptions {
    /// Nearer depth is no measurement, metres. The sensor's optics are not made for less than about half a metre.
    pub near_m: f32,
    /// Farther depth is no measurement, metres; the frequencies repeat after 18.7 m.
    pub far_m: f32,
    /// Pixels with a weaker signal at any frequency are no measurement, linear counts. Arbitrary: three times the assumed
    /// noise.
    pub min_amplitude: f32,
    /// How badly the three phases may fit one travel: share, 0 to 1, of the misfit that would already suit another one.
    /// Phases without meaning pass with the square of this. Arbitrary.
    pub max_misfit: f32,
    /// Noise of one exposure of a pixel, linear counts, from which the depth's standard deviation is predicted, beside that
    /// of the logarithmic code. Arbitrary: not measured on a device.
    pub read_noise: f32,
    /// Added to every depth, metres; some devices are said to measure 0.024 m too much.
    pub depth_offset_m: f32,
    /// For packets synthesised for the ray order of libfreenect2's CPU decoder, which is upside down.
    pub legacy_row_order: bool,
    /// Turns the mirrored image round, so that columns go to the right as the camera sees it.
    pub unmirrored: bool,
    /// The filter of phasors.
    pub bilateral: Option<BilateralOptions>,
    /// The filter of depth.
    pub edge_aware: Option<EdgeAwareOptions>,
}

impl Default for DecoderOptions {
    fn default() -> Self {
        DecoderOptions {
            near_m: 0.3,
            far_m: 8.0,
            min_amplitude: 3.0,
            max_misfit: 0.6,
            read_noise: 1.0,
            depth_offset_m: 0.0,
            legacy_row_order: false,
            unmirrored: false,
            bilateral: None,
            edge_aware: None,
        }
    }
}

/// Largest value of an exposure, linear counts.
const MAX_COUNTS: f32 = 16_320.0;

/// An option outside its bounds.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("decoder option {key} is {value}, must be {bound}")]
pub struct OptionError {
    /// Which one.
    pub key: &'static str,
    /// What it is.
    pub value: f32,
    /// What it must be.
    pub bound: &'static str,
}

impl DecoderOptions {
    /// The same options with both filters as they are by default.
    pub fn with_filters(self) -> Self {
        DecoderOptions {
            bilateral: Some(BilateralOptions::default()),
            edge_aware: Some(EdgeAwareOptions::default()),
            ..self
        }
    }

    /// Refuses values that make no sense.
    ///
    /// # Errors
    /// [`OptionError`] naming option, value and bound.
    pub fn validate(&self) -> Result<(), OptionError> {
        let positive = "positive and finite";
        check("near_m", self.near_m, self.near_m > 0.0, positive)?;
        let far = self.far_m > self.near_m && self.far_m < 18.0;
        check("far_m", self.far_m, far, "above near_m and below 18")?;
        let counts = |value: f32| value > 0.0 && value <= MAX_COUNTS;
        let bound = "above 0 and at most 16320";
        let (amplitude, noise) = (self.min_amplitude, self.read_noise);
        check("min_amplitude", amplitude, counts(amplitude), bound)?;
        check("read_noise", noise, counts(noise), bound)?;
        let misfit = self.max_misfit > 0.0 && self.max_misfit <= 1.0;
        check(
            "max_misfit",
            self.max_misfit,
            misfit,
            "above 0 and at most 1",
        )?;
        let offset = self.depth_offset_m.abs() < self.near_m;
        let bound = "less than near_m in magnitude";
        check("depth_offset_m", self.depth_offset_m, offset, bound)?;
        if let Some(bilateral) = &self.bilateral {
            let (cutoff, same) = (bilateral.cutoff_sigmas, bilateral.same_surface_m);
            check("bilateral.cutoff_sigmas", cutoff, cutoff > 0.0, positive)?;
            check("bilateral.same_surface_m", same, same > 0.0, positive)?;
        }
        if let Some(edges) = &self.edge_aware {
            let (slope, sigmas) = (edges.max_slope, edges.sigmas);
            check("edge_aware.max_slope", slope, slope > 0.0, positive)?;
            check("edge_aware.sigmas", sigmas, sigmas >= 0.0, "0 or more")?;
            let n = f32::from(edges.min_neighbours);
            check("edge_aware.min_neighbours", n, n <= 8.0, "at most 8")?;
        }
        Ok(())
    }
}

fn check(
    key: &'static str,
    value: f32,
    holds: bool,
    bound: &'static str,
) -> Result<(), OptionError> {
    if holds && value.is_finite() {
        return Ok(());
    }
    Err(OptionError { key, value, bound })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_out_of_bounds_are_named() {
        assert!(DecoderOptions::default().with_filters().validate().is_ok());
        let refused = |options: DecoderOptions| options.validate().unwrap_err().to_string();
        let default = DecoderOptions::default;
        assert_eq!(
            refused(DecoderOptions {
                far_m: 0.2,
                ..default()
            }),
            "decoder option far_m is 0.2, must be above near_m and below 18"
        );
        assert_eq!(
            refused(DecoderOptions {
                max_misfit: f32::NAN,
                ..default()
            }),
            "decoder option max_misfit is NaN, must be above 0 and at most 1"
        );
    }
}
