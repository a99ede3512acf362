use super::*;
use crate::refine::scenes::{RippledPlane, calibration, optics, poses_all_round, rays, views_of};
use crate::refine::sites::{SiteKind, ViewSet};
use crate::snapshot::ShadingSnapshot;

const RIPPLED: RippledPlane = RippledPlane {
    amplitude_m: 0.0004,
};
const FLAT: RippledPlane = RippledPlane { amplitude_m: 0.0 };

/// What images of a rippled surface, taken with the shipped calibration, say against another one on a flat base.
fn told(
    params: &SelfCalibrationParams,
    believe: impl Fn(&mut Calibration),
) -> Option<Contradiction> {
    told_by(params, believe, |_, _| ()).contradiction
}

/// The same, and of gloss, by images of which each was changed.
fn told_by(
    params: &SelfCalibrationParams,
    believe: impl Fn(&mut Calibration),
    change: impl Fn(usize, &mut ShadingSnapshot),
) -> Told {
    let (rays, truth) = (rays(), calibration());
    let true_optics = optics(&rays, &truth);
    let poses = poses_all_round();
    let rendered = poses.iter().enumerate().map(|(k, pose)| {
        let mut snapshot = RIPPLED.snapshot(&true_optics, pose);
        change(k, &mut snapshot);
        snapshot
    });
    let mut believed = truth.clone();
    believe(&mut believed);
    let believed_optics = true_optics.with(&believed);
    let base = FLAT.mesh(0.0015);
    let views = views_of(&rendered.collect::<Vec<_>>(), &base, &believed_optics);
    told_by_images(
        &Sites::new(SiteKind::Face, &base, &views, ViewSet::MAX),
        &views,
        &believed_optics,
        params,
    )
}

#[test]
fn a_wrong_gamma_is_found_on_a_surface_that_lacks_the_detail() {
    let truth = calibration().gamma;
    for believed in [0.65, 1.1, 1.4] {
        let params = SelfCalibrationParams::default();
        let told = told(&params, |calibration| calibration.gamma = believed).expect("contradicted");
        let found = told.calibration.gamma;
        assert!((found / truth - 1.0).abs() < 0.03, "{believed}: {found}");
        assert_eq!(told.believed_gamma, believed);
        let text = told.to_string();
        assert!(
            text.contains(&format!("a gamma of {found:.2}, not {believed:.2}")),
            "{text}"
        );
    }
}

#[test]
fn a_part_of_what_is_told_lies_between() {
    let (rays, believed) = (rays(), calibration());
    let optics = optics(&rays, &believed);
    let mut calibration = believed.with_gamma(1.25 * believed.gamma);
    let stands_m = optics.light.position;
    calibration.light.position_m = Some([stands_m.x + 0.02, stands_m.y, stands_m.z]);
    calibration.light.lobe_power = believed.light.lobe_power + 2.0;
    let told = Contradiction::of(&optics, calibration.clone());
    assert!((told.light_moved_m - 0.02).abs() < 1e-12);
    for share in [0.0, 0.5, 1.0] {
        let part = told.part(&optics, share).expect("between");
        let inv_gamma = (1.0 - 0.2 * share) / believed.gamma;
        assert!((part.gamma * inv_gamma - 1.0).abs() < 1e-12, "{share}");
        let [x, ..] = part.light.position_m.expect("stated");
        assert!((x - stands_m.x - 0.02 * share).abs() < 1e-12, "{share}");
        let lobe_power = believed.light.lobe_power + 2.0 * share;
        assert!((part.light.lobe_power - lobe_power).abs() < 1e-12);
    }
    // Beyond a response that there is.
    assert!(told.part(&optics, 6.0).is_none());
}

#[test]
fn a_light_elsewhere_is_found() {
    let stated = [0.05, 0.04, 0.004];
    let by_eye = SelfCalibrationParams {
        light_sigma_m: 0.03,
        ..SelfCalibrationParams::default()
    };
    let told = told(&by_eye, |calibration| {
        calibration.light.position_m = Some(stated)
    });
    let told = told.expect("contradicted");
    let [x, y, z] = told.calibration.light.position_m.expect("found");
    let off = [x - 0.05, y, z - 0.004].map(|d: f64| 1e3 * d);
    assert!(off.iter().all(|mm| mm.abs() < 15.0), "{off:?} mm");
    let moved_m = ((x - stated[0]).powi(2) + (y - stated[1]).powi(2)).sqrt();
    assert!((told.light_moved_m - moved_m).abs() < 1e-12);
}

#[test]
fn the_right_calibration_is_left_alone() {
    assert_eq!(told(&SelfCalibrationParams::default(), |_| ()), None);
}

#[test]
fn images_that_no_calibration_explains_tell_nothing() {
    let params = SelfCalibrationParams::default();
    let wrong = |calibration: &mut Calibration| calibration.gamma = 1.4;
    assert!(told(&params, wrong).is_some());
    // As if another lamp were on in each, far brighter on one side of the image than on the other.
    let told = told_by(&params, wrong, |k, snapshot| {
        let width = snapshot.ir_counts.width();
        let turn = 2.0 * k as f32;
        for (pixel, counts) in snapshot.ir_counts.data_mut().iter_mut().enumerate() {
            let (u, v) = ((pixel % width) as f32, (pixel / width) as f32);
            let along = (u / 100.0 - 1.0) * turn.cos() + (v / 80.0 - 1.0) * turn.sin();
            *counts *= (0.7 * along).exp();
        }
    });
    assert_eq!(told.contradiction, None);
}

#[test]
fn gloss_is_told_from_gamma() {
    let (rays, truth) = (rays(), calibration());
    let optics = optics(&rays, &truth);
    let free = SelfCalibrationParams::default();
    for (strength, power) in [(0.0, 20.0), (0.15, 20.0), (0.5, 20.0)] {
        let gloss = Gloss { strength, power };
        let told_with = |params: &SelfCalibrationParams| {
            told_by(
                params,
                |_| (),
                |_, snapshot| RIPPLED.polish(snapshot, gloss, &optics),
            )
        };
        let told = told_with(&free);
        assert_eq!(told.contradiction, None, "{strength}");
        let found = told.gloss.strength;
        assert!(
            (found - strength).abs() <= 0.4 * strength,
            "{found} of {strength}"
        );
        // Held at the calibration, which is right, no fit ends before gloss is found.
        let held = told_with(&free.held()).gloss;
        let found = held.strength;
        assert!(
            (found - strength).abs() <= 0.4 * strength,
            "{found} of {strength}"
        );
        let has_power = strength == 0.0 || (held.power / power - 1.0).abs() < 0.3;
        assert!(has_power, "{} of {power}", held.power);
    }
}

#[test]
fn no_number_of_patches_tells_better_than_the_model_holds() {
    let (rays, truth) = (rays(), calibration());
    let optics = optics(&rays, &truth);
    let poses = poses_all_round();
    let rendered = poses.iter().map(|pose| RIPPLED.snapshot(&optics, pose));
    let base = FLAT.mesh(0.0015);
    let views = views_of(&rendered.collect::<Vec<_>>(), &base, &optics);
    let sites = Sites::new(SiteKind::Face, &base, &views, ViewSet::MAX);
    let start = start(&optics, views.len(), &[Gloss::default()]);
    let sigmas = |times: f64| {
        let mut patches = LitPatch::all(&sites, &views, &optics, &[]);
        patches.iter_mut().for_each(|patch| patch.share *= times);
        let params = SelfCalibrationParams::default();
        let fit = fit(&mut patches, &start, &params, &[MATTE_SIGMA]).expect("it fits");
        (fit.sigmas[0], fit.sigmas_with_model[0])
    };
    let (many, many_with_model) = sigmas(1e3);
    let (more, more_with_model) = sigmas(1e4);
    assert!(more < 0.7 * many, "{more} after {many}");
    let left = more_with_model / many_with_model;
    assert!(left > 0.95, "{more_with_model} after {many_with_model}");
}
