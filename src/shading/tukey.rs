//! The robust loss of shading residuals.

/// Tukey's biweight: residuals beyond `cutoff · scale` do not count at all.
#[derive(Clone, Copy, Debug)]
pub struct Tukey {
    /// Robust standard deviation of the residuals.
    pub scale: f64,
    /// Cut-off in scales; 4.685 is 95 % efficient on Gaussian residuals.
    pub cutoff: f64,
}

impl Tukey {
    /// Loss of a residual: `c²/6 · (1 − (1 − (r/c)²)³)`, in squared scales.
    #[inline]
    pub fn loss(&self, residual: f64) -> f64 {
        let t = self.within(residual);
        self.cutoff * self.cutoff / 6.0 * (1.0 - t * t * t)
    }

    /// Weight of a squared residual in scales: `(1 − (r/c)²)²`, over the squared scale.
    #[inline]
    pub fn weight(&self, residual: f64) -> f64 {
        let t = self.within(residual) * (1.0 / self.scale);
        t * t
    }

    /// `1 − (r/c)²`, 0 beyond the cut-off. Reciprocals are taken once where many residuals have one loss.
    #[inline]
    fn within(&self, residual: f64) -> f64 {
        let share = residual * (1.0 / (self.scale * self.cutoff));
        (1.0 - share * share).max(0.0)
    }
}

/// Robust standard deviation: the median of the absolute values times 1.4826, which is exact for Gaussian residuals. 0
/// without values; their order changes.
pub fn median_absolute_deviation(residuals: &mut [f64]) -> f64 {
    for residual in residuals.iter_mut() {
        *residual = residual.abs();
    }
    1.4826 * median(residuals).unwrap_or(0.0)
}

/// The value in the middle, the upper one of two; `None` without values, whose order changes.
pub fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}
