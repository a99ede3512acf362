//! A mixture of Gaussians and of outliers spread evenly, on the line, by expectation and maximisation, with as many Gaussians as
//! the Bayesian information criterion (Schwarz 1978) asks for.

/// Components in ascending order of their means.
#[derive(Clone, Debug)]
pub struct Mixture {
    components: Vec<Component>,
}

#[derive(Clone, Copy, Debug)]
struct Component {
    share: f64,
    mean: f64,
    sigma: f64,
}

/// Values are grouped into so many bins first: a scan has hundreds of thousands.
const BINS: usize = 400;
/// Places that a further component may begin at.
const N_SEEDS: usize = 12;
/// Steps of expectation and maximisation at most, and the step of the means at which they end.
const MAX_ITERATIONS: usize = 100;
const SETTLED: f64 = 1e-4;
/// Components nearer than this many sigmas are one material.
const MIN_SEPARATION: f64 = 2.0;
/// A material's values spread no wider than this, times the smallest deviation; what does is outliers.
const MAX_SPREAD: f64 = 2.5;
/// Share of values that belong to no material: rims, shadows, highlights; arbitrary.
const OUTLIER_SHARE: f64 = 0.1;
/// Smaller components are outliers: shadow rims and highlights.
const MIN_SHARE: f64 = 0.03;

impl Mixture {
    /// Fits 1 to `max_components` components of a standard deviation of at least `min_sigma` and keeps the best count; so many
    /// values as are correlated tell what one does, and NaN are left out. `None` without any value.
    ///
    /// Each count begins with what the one before found and one component more, which is tried at places all over the values: a
    /// material of a tenth of the surface lies beside the quantiles that any one start would have.
    pub fn fit(
        values: &[f64],
        n_correlated: f64,
        max_components: usize,
        min_sigma: f64,
    ) -> Option<Mixture> {
        let histogram = Histogram::new(values)?;
        let n = histogram.total() / n_correlated;
        let informed = |components| {
            let mixture = histogram.maximised(components, min_sigma);
            (mixture.information(&histogram, n), mixture)
        };
        let start = |mean, k: usize| Component {
            share: (1.0 - OUTLIER_SHARE) / k as f64,
            mean,
            sigma: MAX_SPREAD * min_sigma,
        };
        let mut current = informed(vec![start(histogram.median(), 1)]);
        let mut best = current.clone();
        for k in 2..=max_components {
            let with_one_more = histogram.seeds().map(|seed| {
                let rest = (k - 1) as f64 / k as f64;
                let mut components = current.1.components.clone();
                components.iter_mut().for_each(|c| c.share *= rest);
                components.push(start(seed, k));
                informed(components)
            });
            let separated = with_one_more.filter(|(_, mixture)| mixture.is_separated());
            let Some(next) = separated.min_by(|a, b| a.0.total_cmp(&b.0)) else {
                break;
            };
            current = next;
            if current.0 < best.0 {
                best = current.clone();
            }
        }
        Some(best.1)
    }

    /// Number of components.
    pub fn len(&self) -> usize {
        self.components.len()
    }

    /// Negative log likelihood of a value in a component; grows with the distance, not the square, beyond three sigmas.
    pub fn cost(&self, component: usize, value: f64) -> f64 {
        let Component { mean, sigma, .. } = self.components[component];
        let t = (value - mean).abs() / sigma;
        let squared = if t < 3.0 { 0.5 * t * t } else { 3.0 * t - 4.5 };
        squared + sigma.ln()
    }

    /// A component that is none: its values turned out to lie nearer to another one, or nowhere. Of several the one that is farthest
    /// off. Between two materials lies a third if sites of either go to it. Given what is typical of each, NaN of one without values.
    pub fn stray(&self, typical: &[f64]) -> Option<usize> {
        let apart = |of: usize, to: usize| (typical[of] - self.components[to].mean).abs();
        let is_stray = |&of: &usize| {
            let is_nearer_to = |to| apart(of, to) < apart(of, of);
            typical[of].is_nan() || (0..self.len()).any(is_nearer_to)
        };
        let strays = (0..self.len()).filter(|of| self.len() > 1 && is_stray(of));
        // No number is the farthest of all.
        strays.max_by(|&a, &b| apart(a, a).total_cmp(&apart(b, b)))
    }

    /// The other components.
    pub fn without(mut self, component: usize) -> Mixture {
        self.components.remove(component);
        self
    }

    fn is_separated(&self) -> bool {
        self.components.iter().all(|c| c.share >= MIN_SHARE)
            && self.components.windows(2).all(|pair| {
                pair[1].mean - pair[0].mean > MIN_SEPARATION * 0.5 * (pair[0].sigma + pair[1].sigma)
            })
    }

    /// The criterion: `parameters · ln n − 2 ln likelihood`, the likelihood scaled to `n` independent values.
    fn information(&self, histogram: &Histogram, n: f64) -> f64 {
        let log_likelihood: f64 = histogram
            .bins()
            .map(|(value, count)| {
                let gaussians: f64 = self.components.iter().map(|c| c.density(value)).sum();
                count * (gaussians + histogram.outliers()).ln()
            })
            .sum();
        let parameters = 3 * self.components.len() - 1;
        parameters as f64 * n.max(2.0).ln() - 2.0 * log_likelihood * n / histogram.total()
    }
}

impl Component {
    fn density(&self, value: f64) -> f64 {
        let t = (value - self.mean) / self.sigma;
        self.share * (-0.5 * t * t).exp() / (self.sigma * (2.0 * std::f64::consts::PI).sqrt())
    }
}

struct Histogram {
    low: f64,
    width: f64,
    counts: Vec<f64>,
}

impl Histogram {
    /// Counts between the first and the last percentile's neighbourhoods, which outliers cannot stretch.
    fn new(values: &[f64]) -> Option<Histogram> {
        let finite = values.iter().copied().filter(|value| value.is_finite());
        let mut values: Vec<f64> = finite.collect();
        let last = values.len().checked_sub(1)?;
        let mut ranked = |rank: usize| *values.select_nth_unstable_by(rank, f64::total_cmp).1;
        let (low, high) = (ranked(last / 100) - 0.2, ranked(last - last / 100) + 0.2);
        let width = (high - low) / BINS as f64;
        let mut counts = vec![0.0; BINS];
        for value in values {
            if (low..high).contains(&value) {
                counts[(((value - low) / width) as usize).min(BINS - 1)] += 1.0;
            }
        }
        Some(Histogram { low, width, counts })
    }

    /// Density of the outliers.
    fn outliers(&self) -> f64 {
        OUTLIER_SHARE / (self.width * BINS as f64)
    }

    fn total(&self) -> f64 {
        self.counts.iter().sum()
    }

    fn bins(&self) -> impl Iterator<Item = (f64, f64)> + '_ {
        let centre = |bin: usize| self.low + (bin as f64 + 0.5) * self.width;
        self.counts
            .iter()
            .enumerate()
            .map(move |(bin, &count)| (centre(bin), count))
    }

    /// Places that a further component may begin at, evenly over the values.
    fn seeds(&self) -> impl Iterator<Item = f64> + '_ {
        let apart = self.width * BINS as f64 / N_SEEDS as f64;
        (0..N_SEEDS).map(move |k| self.low + (k as f64 + 0.5) * apart)
    }

    /// Expectation and maximisation until the means stand still.
    fn maximised(&self, mut components: Vec<Component>, min_sigma: f64) -> Mixture {
        for _ in 0..MAX_ITERATIONS {
            let mut sums = vec![(0.0, 0.0, 0.0); components.len()];
            for (value, count) in self.bins().filter(|(_, count)| *count > 0.0) {
                let densities: Vec<f64> = components.iter().map(|c| c.density(value)).collect();
                let total = densities.iter().sum::<f64>() + self.outliers();
                for (sum, density) in sums.iter_mut().zip(densities) {
                    let share = count * density / total;
                    *sum = (
                        sum.0 + share,
                        sum.1 + share * value,
                        sum.2 + share * value * value,
                    );
                }
            }
            let mut moved = 0.0f64;
            for (component, (n, first, second)) in components.iter_mut().zip(sums) {
                if n > 0.0 {
                    let mean = first / n;
                    let sigma = (second / n - mean * mean).max(0.0).sqrt();
                    moved = moved.max((mean - component.mean).abs());
                    *component = Component {
                        share: n / self.total() * (1.0 - OUTLIER_SHARE),
                        mean,
                        sigma: sigma.clamp(min_sigma, MAX_SPREAD * min_sigma),
                    };
                }
            }
            if moved < SETTLED {
                break;
            }
        }
        components.sort_by(|a, b| a.mean.total_cmp(&b.mean));
        Mixture { components }
    }

    fn median(&self) -> f64 {
        let target = 0.5 * self.total();
        let mut sum = 0.0;
        self.bins()
            .find(|(_, count)| {
                sum += count;
                sum >= target
            })
            .map_or(self.low, |(value, _)| value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Triangular noise of a standard deviation of about 0.08 about each centre, from a golden-ratio sequence.
    fn around(centres: &[f64], each: usize) -> Vec<f64> {
        let golden = |i: usize, step: f64| (i as f64 * step).fract() - 0.5;
        centres
            .iter()
            .flat_map(|centre| {
                (0..each).map(move |i| centre + 0.2 * (golden(i, 0.618_034) + golden(i, 0.754_878)))
            })
            .collect()
    }

    #[test]
    fn one_material_is_one_component() {
        let mixture = Mixture::fit(&around(&[-1.8], 40_000), 50.0, 4, 0.06).expect("values");
        assert_eq!(mixture.len(), 1);
    }

    #[test]
    fn two_materials_are_found_with_their_albedos() {
        let mixture = Mixture::fit(&around(&[-1.8, -1.0], 40_000), 50.0, 4, 0.06).expect("values");
        assert_eq!(mixture.len(), 2);
        assert!((mixture.components[0].mean + 1.8).abs() < 0.02);
        assert!((mixture.components[1].mean + 1.0).abs() < 0.02);
    }

    #[test]
    fn a_painted_band_of_a_tenth_of_the_surface_is_a_material() {
        let bright = around(&[-1.0], 90_000);
        let dark = around(&[-1.8], 10_000);
        let mixture = Mixture::fit(&[bright, dark].concat(), 50.0, 6, 0.06).expect("values");
        assert_eq!(mixture.len(), 2);
        assert!((mixture.components[0].mean + 1.8).abs() < 0.02);
    }

    #[test]
    fn a_component_whose_values_lie_elsewhere_or_nowhere_is_let_go() {
        let at = |mean: f64| Component {
            share: 0.3,
            mean,
            sigma: 0.1,
        };
        let mixture = Mixture {
            components: vec![at(-2.3), at(-1.75), at(-1.55)],
        };
        assert_eq!(mixture.stray(&[-2.6, -1.72, -1.56]), None);
        assert_eq!(mixture.stray(&[-2.19, -1.57, -1.56]), Some(1));
        assert_eq!(mixture.stray(&[f64::NAN, -1.57, -1.56]), Some(0));
        let rest = mixture.without(1);
        assert_eq!((rest.len(), rest.stray(&[-2.3, -1.6])), (2, None));
        assert_eq!(rest.without(1).stray(&[-1.9]), None, "the last");
    }

    #[test]
    fn nothing_seen_is_no_mixture() {
        assert!(Mixture::fit(&[f64::NAN; 3], 50.0, 4, 0.06).is_none());
    }
}
