//! Statistics that outliers do not move: order statistics, and Tukey's loss with the scale that goes with it.

/// The median absolute deviation of Gaussian values times this is their standard deviation.
pub const SIGMAS_PER_DEVIATION: f64 = 1.4826;

/// Tukey's biweight: residuals beyond `cutoff · scale` do not count at all.
#[derive(Clone, Copy, Debug)]
pub struct Tukey {
    /// Robust standard deviation of the residuals.
    pub scale: f64,
    /// Cut-off in scales.
    pub cutoff: f64,
}

impl Tukey {
    /// The cut-off, in scales, that is 95 % efficient on Gaussian residuals.
    pub const EFFICIENT_CUTOFF: f64 = 4.685;

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

/// Robust standard deviation about zero: the median of the absolute values times 1.4826, which is exact for Gaussian
/// residuals. 0 without values; their order changes, and their signs go.
pub fn median_absolute_deviation(residuals: &mut [f64]) -> f64 {
    for residual in residuals.iter_mut() {
        *residual = residual.abs();
    }
    SIGMAS_PER_DEVIATION * median(residuals).unwrap_or(0.0)
}

/// The value in the middle, the upper one of two; `None` without values, whose order changes.
pub fn median(values: &mut [f64]) -> Option<f64> {
    quantile(values, 0.5)
}

/// The median of few values, where that matters: halfway between the two in the middle of an even number, NaN if one is NaN.
/// `None` without values, whose order changes.
pub fn median_between(values: &mut [f64]) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    let n = values.len();
    match values.last()? {
        last if last.is_nan() => Some(f64::NAN),
        _ => Some(0.5 * (values[(n - 1) / 2] + values[n / 2])),
    }
}

/// The value before which so large a share of all, below 1, lies in order: of n that of rank `⌊share · n⌋`, counted from 0.
/// `None` without values, whose order changes.
pub fn quantile(values: &mut [f64], share: f64) -> Option<f64> {
    let rank = (share * values.len() as f64) as usize;
    (rank < values.len()).then(|| *values.select_nth_unstable_by(rank, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_values_by_their_rank() {
        let mut values = [4.0, -1.0, 7.0, 2.0];
        assert_eq!(median(&mut values), Some(4.0));
        assert_eq!(median(&mut values[..3]), Some(2.0));
        assert_eq!(quantile(&mut values, 0.0), Some(-1.0));
        assert_eq!(quantile(&mut values, 0.24), Some(-1.0));
        assert_eq!(quantile(&mut values, 0.25), Some(2.0));
        assert_eq!(quantile(&mut values, 0.99), Some(7.0));
        assert_eq!(quantile(&mut [], 0.5), None);
        assert_eq!(median_between(&mut values), Some(3.0));
        assert_eq!(median_between(&mut values[..3]), Some(2.0));
        assert!(median_between(&mut [f64::NAN, 1.0, 2.0]).is_some_and(f64::is_nan));
        assert_eq!(median_between(&mut []), None);
    }

    #[test]
    fn what_lies_beyond_the_cut_off_neither_weighs_nor_costs_more() {
        let loss = Tukey {
            scale: 2.0,
            cutoff: Tukey::EFFICIENT_CUTOFF,
        };
        assert_eq!(loss.weight(0.0), 0.25);
        assert_eq!(loss.weight(9.5), 0.0);
        assert_eq!(loss.loss(9.5), loss.loss(1e6));
        let mut residuals = [-1.0, 2.0, -3.0, 1e6, 0.5];
        assert_eq!(median_absolute_deviation(&mut residuals), 2.0 * 1.4826);
    }
}
