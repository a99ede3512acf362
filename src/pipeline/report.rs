//! The report of a run, put together from what every thread says at its end.

use super::{
    accounts::FrameAccounts,
    deliver::{Account, BASE_PLY, REFINED_PLY},
    edges::DropCounts,
    fusion_stage::FusionSummary,
    refine_stage::RefineSummary,
    timing,
};
use crate::{
    capture::CaptureSummary,
    export::{
        AlbedoShare, BaseMesh, Evidence, FrameCounts, HeldOut, Iteration, RefinedMesh, RefinedView,
        Remeshing, Report, SurfaceDistance, ToldLight, Tracking, tum_numbers,
    },
    refine::{
        Contradiction, Judgement, MAX_MISFIT, Material, RefineStatus, Refinement,
        remesh::{Distances, RemeshDistance},
    },
    shading::Calibration,
    snapshot::ShadingSnapshot,
};
use depth_camera::CameraInfo;
use std::sync::atomic::Ordering;

/// What a run is about, known from its start.
#[derive(Clone, Debug)]
pub struct Subject {
    /// Name of the recording or scan.
    pub session: String,
    /// The camera.
    pub info: CameraInfo,
    /// Where the calibration of the IR image comes from.
    pub calibration: String,
    /// What the operator should know from the start.
    pub warnings: Vec<String>,
    /// Where the outputs go, as the operator named it.
    pub folder: std::path::PathBuf,
}

/// What every thread says at its end.
pub struct Endings<'a> {
    /// The device thread.
    pub capture: &'a CaptureSummary,
    /// What became of the frames.
    pub frames: &'a FrameAccounts,
    /// What was not recorded.
    pub drops: &'a DropCounts,
    /// The fusion thread.
    pub fusion: &'a FusionSummary,
    /// The refinement thread.
    pub refined: &'a RefineSummary,
    /// Whether somebody asked to stop.
    pub stopped_early: bool,
}

/// Puts the report together, but for its list of outputs.
pub fn compose(subject: &Subject, endings: &Endings, account: &Account) -> Report {
    let Endings {
        fusion, refined, ..
    } = endings;
    let path = |name: &str| subject.folder.join(name).display().to_string();
    let refined_mesh = refined.refinement.as_ref().map(|refinement| {
        let snapshots = fusion.scan.iter().flat_map(|scan| &scan.snapshots);
        let snapshots: Vec<&ShadingSnapshot> = snapshots.flat_map(|s| &s.accepted).collect();
        refined_mesh(refinement, &snapshots, path(REFINED_PLY))
    });
    let mut warnings = warnings(subject, endings, account);
    warnings.extend(refined.refinement.as_ref().and_then(unjudged));
    warnings.extend(refined.refinement.as_ref().and_then(contradicted));
    warnings.extend(refined.refinement.as_ref().and_then(hardly_fitting));
    warnings.extend(
        refined
            .refinement
            .as_ref()
            .and_then(|refinement| one_for_all(&refinement.materials, refinement.albedo_spread)),
    );
    Report {
        session: subject.session.clone(),
        sensor: subject.info.sensor.name().to_owned(),
        serial: subject.info.serial.clone(),
        relief_version: env!("CARGO_PKG_VERSION").to_owned(),
        calibration: subject.calibration.clone(),
        stopped_early: endings.stopped_early,
        frames: frame_counts(endings),
        tracking: Tracking {
            path_length_m: fusion.path_length_m,
            n_relocalised: fusion.n_relocalised,
            n_unpolished: fusion.n_unpolished,
            lost_spans: fusion.losses.spans().to_vec(),
        },
        base_mesh: match &refined.base_mesh {
            Some(mesh) => BaseMesh {
                path: path(BASE_PLY),
                ..mesh.clone()
            },
            None => BaseMesh::default(),
        },
        refined_mesh,
        not_refined_reason: refined.not_refined_reason.clone(),
        warnings,
        timings: [fusion.timings.as_slice(), refined.timings.as_slice()].concat(),
        peak_memory_bytes: timing::peak_memory_bytes(),
        outputs: account
            .outputs
            .iter()
            .map(|path| path.display().to_string())
            .collect(),
    }
}

/// What became of the frames: every frame that the device delivered is counted once.
pub fn frame_counts(endings: &Endings) -> FrameCounts {
    let frames = endings.frames;
    let scan = endings.fusion.scan.as_ref();
    FrameCounts {
        total: frames.produced,
        fused: frames.fused,
        in_model: scan.map_or(0, |scan| scan.world_from_cameras.len() as u64),
        lost: frames.lost,
        damaged: frames.damaged,
        dropped: frames.dropped,
        without_depth: frames.without_depth,
        paused: frames.paused,
        // Nobody holds a frame any more: one that is still on its way is one that nobody accounts for.
        unaccounted: frames.unaccounted() + frames.in_flight as i64,
        missed: endings.capture.n_missed,
    }
}

/// The warning about a refined mesh that nothing could judge.
fn unjudged(refinement: &Refinement) -> Option<String> {
    (refinement.judgement.overall.n_pixels == 0).then(|| {
        "no shading image could be held out that shows the object: nothing says whether the refined mesh is better than the base mesh"
            .to_owned()
    })
}

/// The warning about a calibration that the images contradict.
fn contradicted(refinement: &Refinement) -> Option<String> {
    let told = refinement.contradiction.as_ref()?;
    Some(format!(
        "{told}; refined.ply is made by what they tell (report.json has it as `told`); measure the device with `relief calibrate`"
    ))
}

/// The warning about images that may not be of this surface from these poses.
fn hardly_fitting(refinement: &Refinement) -> Option<String> {
    (refinement.misfit > MAX_MISFIT).then(|| {
        format!(
            "the images hardly fit the surface: patches of it are {:.1} standard deviations from as bright as the light would make them, \
             1 on most scans and above {MAX_MISFIT} on very rough surfaces; where ir_offset_px, the poses or the depth is wrong \
             refined.ply is worse than base.ply",
            refinement.misfit
        )
    })
}

/// The warning about one label where facets differ more than a material does.
fn one_for_all(materials: &[Material], spread: f64) -> Option<String> {
    /// From this share on a label has swallowed the rest; arbitrary.
    const SWALLOWED: f64 = 0.98;
    /// Spread of the facets' own log albedos about their groups': 0.05 to 0.15 where the groups are right.
    const MAX_SPREAD: f64 = 0.25;
    let largest = materials
        .iter()
        .map(|material| material.share)
        .fold(0.0, f64::max);
    (largest >= SWALLOWED && spread > MAX_SPREAD).then(|| {
        format!(
            "one albedo was taken for {:.0} % of the surface, whose own albedos spread by {:.0} % about it: more materials than \
             could be told apart; their borders may stand out as relief",
            100.0 * largest,
            100.0 * spread
        )
    })
}

fn warnings(subject: &Subject, endings: &Endings, account: &Account) -> Vec<String> {
    let mut warnings = subject.warnings.clone();
    let capture = endings.capture;
    if endings.stopped_early {
        let after = match (capture.n_frames, subject.info.n_frames) {
            // Nothing was captured to begin with.
            (0, _) => String::new(),
            (n_frames, Some(of)) => format!(", after {n_frames} of {of} frames"),
            (n_frames, None) => format!(", after {n_frames} frames"),
        };
        warnings.push(format!("the run was stopped early{after}"));
    }
    if let Some(first) = &capture.first_damage {
        warnings.push(format!(
            "{} frames came damaged and were skipped; the first: {first}",
            capture.n_damaged
        ));
    }
    if capture.n_missed > 0 {
        warnings.push(format!(
            "{} frames or infrared images were missed by the driver, beside those that came: this machine or its USB bus was too busy, or the cable is bad",
            capture.n_missed
        ));
    }
    let unrecorded = endings.drops.recorded_frames.load(Ordering::Relaxed);
    let without_ir = endings.drops.recorded_ir.load(Ordering::Relaxed);
    if unrecorded + without_ir > 0 {
        warnings.push(format!(
            "the disk was too slow: {unrecorded} frames were not recorded, {without_ir} without infrared"
        ));
    }
    let n_unpolished = endings.fusion.n_unpolished;
    if n_unpolished > 0 {
        warnings.push(format!(
            "{n_unpolished} frames were fused at their given pose as it is: no pose within the bounds of fusion.polish fits \
             the model"
        ));
    }
    let unaccounted = frame_counts(endings).unaccounted;
    if unaccounted != 0 {
        warnings.push(format!("{unaccounted} frames are unaccounted for"));
    }
    warnings.extend_from_slice(&endings.fusion.put_right);
    warnings.extend(endings.fusion.refusal.clone());
    let unimproved = endings.fusion.unimproved_reason.as_ref();
    warnings.extend(unimproved.map(|reason| format!("base.ply is not improved: {reason}")));
    let whole = endings.refined.not_cropped_reason.as_ref();
    warnings.extend(whole.map(|reason| format!("base.ply is of the whole scene: {reason}")));
    warnings.extend_from_slice(&account.warnings);
    warnings.extend_from_slice(&account.failures);
    warnings
}

fn refined_mesh(
    refinement: &Refinement,
    snapshots: &[&ShadingSnapshot],
    path: String,
) -> RefinedMesh {
    let mesh = &refinement.mesh;
    let views: Vec<RefinedView> = refinement
        .views
        .iter()
        .zip(snapshots)
        .map(|(view, snapshot)| RefinedView {
            frame_id: snapshot.frame_id,
            time_secs: snapshot.device_time_secs,
            gain: view.gain,
            world_from_camera: tum_numbers(&view.world_from_camera),
            shift_px: view.shift_px,
            rmse_before: view.rmse_before,
            rmse_after: view.rmse_after,
            n_sites: view.n_sites,
        })
        .collect();
    RefinedMesh {
        vertices: mesh.vertices.len(),
        faces: mesh.faces.len(),
        area_m2: mesh.area_m2(),
        path,
        status: status_name(refinement.status).to_owned(),
        iterations: refinement
            .iterations
            .iter()
            .map(|iteration| Iteration {
                energy_before: iteration.energy_before,
                energy_after: iteration.energy_after,
                max_step_m: iteration.max_step_m,
                damping: iteration.damping,
            })
            .collect(),
        edge_length_m: refinement.edge_length_m,
        remeshing: remeshing(&refinement.remeshing),
        albedo: refinement
            .materials
            .iter()
            .map(|material| AlbedoShare {
                albedo: material.albedo,
                area_share: material.share,
                gloss: material.gloss.strength,
            })
            .collect(),
        gloss: refinement
            .materials
            .iter()
            .map(|material| material.gloss.strength)
            .fold(0.0, f64::max),
        rmse_before: refinement.rmse_before,
        rmse_after: refinement.rmse_after,
        misfit: refinement.misfit,
        told: refinement.contradiction.as_ref().map(told_light),
        held_out: held_out(&refinement.judgement),
        evidence: evidence(refinement),
        views,
    }
}

fn told_light(told: &Contradiction) -> ToldLight {
    let Calibration { gamma, light, .. } = &told.calibration;
    ToldLight {
        gamma: *gamma,
        believed_gamma: told.believed_gamma,
        light_position_m: light.position_m,
        light_moved_m: told.light_moved_m,
        lobe_power: light.lobe_power,
        believed_lobe_power: told.believed_lobe_power,
        white_level: light.white_level,
    }
}

fn remeshing(distance: &RemeshDistance) -> Remeshing {
    let one_way = |distances: &Distances| SurfaceDistance {
        n_points: distances.n_points,
        max_m: distances.max_m,
        rms_m: distances.rms_m,
    };
    Remeshing {
        hausdorff_m: distance.hausdorff_m(),
        from_base: one_way(&distance.from_source),
        from_remeshed: one_way(&distance.from_mesh),
    }
}

fn held_out(judgement: &Judgement) -> HeldOut {
    let overall = judgement.overall.reported();
    HeldOut {
        n_views: judgement.n_comparing(),
        intensity_base: overall.base.intensity,
        intensity_refined: overall.refined.intensity,
        intensity_noise: overall.noise.intensity,
        gradient_base: overall.base.gradient,
        gradient_refined: overall.refined.gradient,
        gradient_noise: overall.noise.gradient,
        slow_gain: overall.slow_gain,
    }
}

fn evidence(refinement: &Refinement) -> Evidence {
    let summary = refinement.evidence.summary();
    Evidence {
        unseen_share: summary.unseen_share,
        weak_share: summary.weak_share,
        median_views: summary.median_views,
        median_sigma_m: summary.median_sigma_m,
        high_sigma_m: summary.high_sigma_m,
    }
}

fn status_name(status: RefineStatus) -> &'static str {
    match status {
        RefineStatus::Converged => "converged",
        RefineStatus::IterationLimit => "iteration limit",
        RefineStatus::Stalled => "stalled",
        RefineStatus::Cancelled => "cancelled",
        RefineStatus::Singular => "singular",
    }
}

#[cfg(test)]
mod tests {
    use super::{Material, one_for_all};
    use crate::shading::Gloss;

    #[test]
    fn one_label_for_what_differs_is_told() {
        let material = |share: f64| Material {
            albedo: 0.2,
            share,
            gloss: Gloss::default(),
        };
        let told = one_for_all(&[0.01, 0.99].map(material), 0.4).unwrap();
        assert!(
            told.contains("99 % of the surface") && told.contains("materials than could be told"),
            "{told}"
        );
        assert_eq!(one_for_all(&[1.0].map(material), 0.1), None);
        assert_eq!(one_for_all(&[0.4, 0.6].map(material), 0.4), None);
    }
}
