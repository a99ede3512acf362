//! Why a calibration comes to nothing; what is refused, each with the figure that shows it.

use super::estimate::{Estimate, SessionFit};
use super::gather::{Scan, Shares, Target, WALL_SHARE};
use crate::shading::SATURATION;

/// Why a fit came to no estimate.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NoEstimate {
    /// There is nothing to be learnt from the sessions.
    #[error(transparent)]
    Refused(#[from] Refusal),
    /// It was not to go on.
    #[error("the fit was told to end")]
    Stopped,
}

/// A session, or all of them, from which nothing can be learnt.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// No session was given.
    #[error("no session is given")]
    NoScans,
    /// There is no depth image.
    #[error(
        "{session}: no depth image with at least 5 % of its pixels valid: nothing to find a sphere or a wall in"
    )]
    NoDepth {
        /// The session.
        session: String,
    },
    /// Neither target is in view.
    #[error(
        "{session}: neither a wall (a plane that holds {:.0} % of the depth) nor a sphere is in view: {shares}",
        100.0 * WALL_SHARE
    )]
    NoSphere {
        /// The session.
        session: String,
        /// What there is of both.
        shares: Shares,
    },
    /// No IR image is of use.
    #[error(
        "{session}: no IR image under the sensor's light with the target in view; {n_unused} IR images are of no use ({reasons})"
    )]
    NoImages {
        /// The session.
        session: String,
        /// Images looked at.
        n_unused: usize,
        /// Why, each reason with how often.
        reasons: String,
    },
    /// The light is too strong, or too near.
    #[error(
        "{session}: {:.0} % of the lit pixels are saturated, must be at most {:.0} %: move away, or lower the light",
        share * 100.0, MAX_SATURATED * 100.0
    )]
    Saturated {
        /// The session.
        session: String,
        /// Share of the lit pixels of all images.
        share: f64,
    },
    /// The sphere leaves the image.
    #[error(
        "{session}: the sphere is cut by the frame: at most {:.0} % of its outline lies within an image, must be at least \
         {:.0} %", inside_share * 100.0, required * 100.0
    )]
    SphereCut {
        /// The session.
        session: String,
        /// Largest share within an image.
        inside_share: f64,
        /// What is needed.
        required: f64,
    },
    /// The outline cannot be seen.
    #[error(
        "{session}: the sphere's outline shows in {:.0} % of the directions at most, must be at least {:.0} %: too dark, or \
         too little contrast", shown_share * 100.0, required * 100.0
    )]
    NoLimb {
        /// The session.
        session: String,
        /// Largest share of directions.
        shown_share: f64,
        /// What is needed.
        required: f64,
    },
    /// There is too little to fit.
    #[error(
        "{session}: {n_samples} usable samples, must be at least {required}: too dark, too small or too far away"
    )]
    FewSamples {
        /// The session.
        session: String,
        /// How many there are.
        n_samples: usize,
        /// What is needed.
        required: usize,
    },
    /// The surface is not of one albedo, or not Lambertian.
    #[error(
        "{session}: the {target} is not plain: brightness deviates by {:.1} % from one albedo ({:.1} % of it noise), {:.0} % of \
         the samples are outliers; must be at most {:.1} % and {:.0} %: texture, colour or gloss",
        deviation * 100.0, noise * 100.0, outlier_share * 100.0, max_deviation * 100.0, max_outliers * 100.0
    )]
    Textured {
        /// The session.
        session: String,
        /// "wall" or "sphere".
        target: &'static str,
        /// Robust relative deviation.
        deviation: f64,
        /// What noise makes of it.
        noise: f64,
        /// Share of outliers.
        outlier_share: f64,
        /// Largest deviation beyond noise.
        max_deviation: f64,
        /// Largest share of outliers.
        max_outliers: f64,
    },
    /// There are too few images for a line through them.
    #[error(
        "{session}: the wall is seen in {n_images} images, must be at least {required}, from near to far"
    )]
    FewImages {
        /// The session.
        session: String,
        /// How many show enough of it.
        n_images: usize,
        /// What is needed.
        required: usize,
    },
    /// The wall does not come from near and far.
    #[error(
        "{session}: the wall is seen from {:.2} m to {:.2} m, the farthest must be at least {ratio} times as far as the nearest",
        range_m[0], range_m[1]
    )]
    OneDistance {
        /// The session.
        session: String,
        /// Nearest and farthest, metres.
        range_m: [f64; 2],
        /// What is needed.
        ratio: f64,
    },
}

/// A white wall or sphere deviates by less than this beyond noise: 0.4 % on recorded ones, 3 % is a visible pattern.
const MAX_DEVIATION: f64 = 0.03;
/// And has fewer outliers than this.
const MAX_OUTLIERS: f64 = 0.15;
/// Fewer samples than this do not hold the unknowns.
const MIN_SAMPLES: usize = 1_500;

/// More saturated pixels than this share leave too little of a target; as for shading images.
const MAX_SATURATED: f64 = 0.2;

/// Refuses what is too bright to learn from.
pub(super) fn check_brightness(scans: &[Scan], full_scale: f64) -> Result<(), Refusal> {
    for scan in scans {
        let share = saturated_share(scan, full_scale);
        if share > MAX_SATURATED {
            return Err(Refusal::Saturated {
                session: scan.name.clone(),
                share,
            });
        }
    }
    Ok(())
}

/// Refuses what does not fit.
pub(super) fn check_fits(scans: &[Scan], estimate: &Estimate) -> Result<(), Refusal> {
    for (scan, fit) in scans.iter().zip(&estimate.fits) {
        check_fit(scan, fit)?;
    }
    Ok(())
}

fn check_fit(scan: &Scan, fit: &SessionFit) -> Result<(), Refusal> {
    if fit.n_samples < MIN_SAMPLES {
        return Err(Refusal::FewSamples {
            session: scan.name.clone(),
            n_samples: fit.n_samples,
            required: MIN_SAMPLES,
        });
    }
    let beyond_noise = (fit.deviation.powi(2) - fit.noise.powi(2)).max(0.0).sqrt();
    if beyond_noise > MAX_DEVIATION || fit.outlier_share > MAX_OUTLIERS {
        return Err(Refusal::Textured {
            session: scan.name.clone(),
            target: match scan.target {
                Target::Wall => "wall",
                Target::Sphere(_) => "sphere",
            },
            deviation: fit.deviation,
            noise: fit.noise,
            outlier_share: fit.outlier_share,
            max_deviation: MAX_DEVIATION,
            max_outliers: MAX_OUTLIERS,
        });
    }
    Ok(())
}

/// Share of the lit pixels of all images that are at full scale.
fn saturated_share(scan: &Scan, full_scale: f64) -> f64 {
    let (mut n_lit, mut n_saturated) = (0usize, 0usize);
    for counts in scan.images.iter().flat_map(|image| image.ir_counts.data()) {
        let share = f64::from(*counts) / full_scale;
        n_lit += usize::from(share > 0.02);
        n_saturated += usize::from(share >= SATURATION);
    }
    n_saturated as f64 / n_lit.max(1) as f64
}
