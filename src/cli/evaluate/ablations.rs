//! `relief evaluate --ablations`: the same with something changed, judged by every fourth view and made from the rest. One that comes
//! to nothing, as where its views do not show the object, leaves the others their figures.

use super::{
    super::{
        processor_time::process_cpu_secs,
        stopping::{Stopped, check_wanted},
    },
    Scan, figures,
};
use relief::{
    export::{Ablation, AblationOutcome},
    geometry::RayGrid,
    refine::{
        AlbedoMode, AlbedoParams, JacobianMode, Judgement, Linearisation, RefineParams, SiteKind,
        validate,
    },
    shading::Calibration,
};
use std::sync::atomic::AtomicBool;

/// What one variation is made with.
struct Variation {
    what: String,
    calibration: Calibration,
    params: RefineParams,
    /// Numbers of the views to learn from.
    learning: Vec<usize>,
}

/// Every variation, unless somebody asks to stop.
pub fn judged(
    scan: &Scan,
    rays: &RayGrid,
    calibration: &Calibration,
    params: &RefineParams,
    stop: &AtomicBool,
) -> Result<Vec<Ablation>, Stopped> {
    let n_views = scan.snapshots.len();
    let judges: Vec<usize> = (1..n_views).step_by(4).collect();
    let rest: Vec<usize> = (0..n_views).filter(|view| !judges.contains(view)).collect();
    let ablation = |variation: Variation| {
        check_wanted(stop)?;
        let outcome = judge(scan, rays, &variation, &judges);
        Ok(Ablation {
            what: variation.what,
            outcome: outcome.unwrap_or_else(|error| AblationOutcome::Failed {
                not_judged_reason: format!("{error:#}"),
            }),
        })
    };
    let variations = variations(calibration, params, &rest);
    variations.into_iter().map(ablation).collect()
}

fn judge(
    scan: &Scan,
    rays: &RayGrid,
    variation: &Variation,
    judges: &[usize],
) -> anyhow::Result<AblationOutcome> {
    let Variation {
        what,
        calibration,
        params,
        learning,
    } = variation;
    let optics = scan.optics(rays, calibration)?;
    let start_secs = process_cpu_secs();
    let views = validate(&scan.subject(&optics), params, learning, judges)?;
    let cpu_secs = process_cpu_secs() - start_secs;
    let overall = Judgement::of(&views).overall.reported();
    tracing::info!(what, cpu_secs, "ablation judged");
    Ok(AblationOutcome::Judged {
        figures: figures(None, &overall),
        slow_gain: overall.slow_gain,
        cpu_secs,
    })
}

fn views_in_words(n_views: usize) -> String {
    match n_views {
        1 => "1 view".to_owned(),
        _ => format!("{n_views} views"),
    }
}

fn variations(calibration: &Calibration, params: &RefineParams, rest: &[usize]) -> Vec<Variation> {
    /// Shares of gamma that are tried.
    const GAMMAS: [f64; 2] = [0.85, 1.15];
    /// Numbers of views that are tried.
    const N_VIEWS: [usize; 6] = [1, 3, 6, 12, 24, 36];
    /// Deviations of poses that are held, radians and metres: the least that the parameters may have.
    const HELD: f64 = 1e-6;
    let with = |what: &str, change: &dyn Fn(&mut RefineParams)| {
        let mut changed = params.clone();
        change(&mut changed);
        Variation {
            what: what.to_owned(),
            calibration: calibration.clone(),
            params: changed,
            learning: rest.to_vec(),
        }
    };
    let mut variations = vec![
        with(
            &format!("as configured, {}", views_in_words(rest.len())),
            &|_| {},
        ),
        with("residuals at the facets", &|params| {
            params.sites = SiteKind::Face;
        }),
        with("the same, derivatives by differences", &|params| {
            params.sites = SiteKind::Face;
            params.jacobian = JacobianMode::Numeric;
        }),
        with("pixel, distance and light held", &|params| {
            params.linearisation = Linearisation::Detail;
        }),
        with(
            "blur of pixels taken off by its variance alone",
            &|params| {
                params.integrate_pixels = false;
            },
        ),
    ];
    for n_learning in N_VIEWS.into_iter().filter(|&n| n < rest.len()) {
        let spread = (0..n_learning).map(|k| rest[k * rest.len() / n_learning]);
        variations.push(Variation {
            learning: spread.collect(),
            ..with(&views_in_words(n_learning), &|_| {})
        });
    }
    variations.extend([
        with("poses as tracked", &|params| {
            // Not by taking no steps, which find the gains as well.
            params.alignment.rotation_sigma_rad = HELD;
            params.alignment.translation_sigma_m = HELD;
        }),
        with("one gain a view, no field", &|params| {
            params.trust.gain_cell_m = 10.0;
        }),
        with("light of the lamp alone", &|params| {
            params.interreflection = false;
            // Otherwise the images tell another lamp in its place.
            params.self_calibration.enabled = false;
        }),
        with("one albedo", &|params| params.max_albedos = 1),
        with("albedo of groups alone", &|params| {
            params.albedo.tints = false
        }),
        with("albedo groups by the paper's rule", &|params| {
            params.albedo = AlbedoParams {
                mode: AlbedoMode::Paper,
                ..params.albedo
            };
        }),
    ]);
    for share in GAMMAS {
        let gamma = share * calibration.gamma;
        let calibration = calibration.with_gamma(gamma);
        let believed = |what: &str, enabled: bool| Variation {
            calibration: calibration.clone(),
            ..with(&format!("gamma {gamma:.2}{what}"), &|params| {
                params.self_calibration.enabled = enabled;
            })
        };
        variations.push(believed(", believed", false));
        variations.push(believed(", told by the images", true));
    }
    variations
}

#[cfg(test)]
mod tests {
    use super::*;
    use depth_camera::Sensor;

    #[test]
    fn every_variation_is_within_its_bounds() {
        let calibration = Calibration::shipped(Sensor::Kinect2).unwrap();
        let variations = variations(&calibration, &RefineParams::default(), &[0, 2, 3, 4]);
        for variation in &variations {
            let Variation { what, params, .. } = variation;
            assert_eq!(params.validate(), Ok(()), "{what}");
            assert_eq!(variation.calibration.validate(), Ok(()), "{what}");
        }
    }

    #[test]
    fn another_gamma_shows_the_white_level_by_itself() {
        let mut calibration = Calibration::shipped(Sensor::Kinect2).unwrap();
        calibration.light.white_level = Some(0.5);
        let variations = variations(&calibration, &RefineParams::default(), &[0, 2]);
        let counts = |calibration: &Calibration| {
            let white_level = calibration.light.white_level.unwrap();
            white_level.powf(calibration.gamma)
        };
        let changed = variations
            .iter()
            .filter(|variation| variation.what.starts_with("gamma"));
        let mut n_changed = 0;
        for variation in changed {
            assert!((counts(&variation.calibration) - counts(&calibration)).abs() < 1e-12);
            n_changed += 1;
        }
        assert_eq!(n_changed, 4);
    }

    #[test]
    fn tracked_poses_leave_the_gains_to_the_images() {
        let calibration = Calibration::shipped(Sensor::Kinect2).unwrap();
        let configured = RefineParams::default();
        let variations = variations(&calibration, &configured, &[0, 2]);
        let is_it = |variation: &&Variation| variation.what == "poses as tracked";
        let held = &variations.iter().find(is_it).unwrap().params.alignment;
        let free = &configured.alignment;
        assert_eq!(held.iterations, free.iterations);
        assert_eq!(held.gain_sigma, free.gain_sigma);
        assert!(held.rotation_sigma_rad < 1e-3 * free.rotation_sigma_rad);
        assert!(held.translation_sigma_m < 1e-3 * free.translation_sigma_m);
    }
}
