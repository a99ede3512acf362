//! The refinement thread: one scan in, its meshes and shading images on the disk.

use super::{
    deliver::Outbox,
    fusion_stage::FusedScan,
    status::{Phase, StatusSlot, StopToken},
    timing::StageClock,
};
use crate::{
    export::{BaseMesh, StageTiming},
    geometry::{CameraModel, RayGrid, TriMesh, close_holes},
    refine::{ObjectParams, Optics, RefineParams, Refinement, Roi, Subject, refine},
    shading::Calibration,
    snapshot::{ShadingSnapshot, SnapshotSelection},
};
use crossbeam::channel::Receiver;
use depth_camera::CameraInfo;
use rayon::ThreadPool;
use std::sync::Arc;

/// Why a run that was not asked to refine has no refined mesh; its shading images are kept for one that is.
const SWITCHED_OFF: &str = "refinement was switched off";

/// Why a run of which nothing could be fused has no refined mesh.
const NO_SCAN: &str = "there is no scan to refine";

/// Why images cannot be understood.
const NO_OPTICS: &str = "the session does not say where its light is, or what full scale is";

/// What the refinement thread needs to know.
pub struct RefineSetup {
    /// The camera.
    pub info: CameraInfo,
    /// Refinement; `None` if it is switched off.
    pub refine: Option<RefineParams>,
    /// Response, flat field and noise of the camera's IR.
    pub calibration: Calibration,
    /// Which part of the scan becomes meshes.
    pub object: ObjectParams,
    /// The box of what is refined; without one the object is taken.
    pub roi: Option<Roi>,
    /// Whether what was fused is kept beside a base mesh that is not all of it: it is not written down yet.
    pub keeps_scene: bool,
    /// Where refinement computes.
    pub pool: ThreadPool,
    /// Where the status goes.
    pub status: StatusSlot,
    /// Ends refinement early.
    pub stop: StopToken,
}

/// What became of the scan.
#[derive(Debug, Default)]
pub struct RefineSummary {
    /// The base mesh as it was delivered, but for its path.
    pub base_mesh: Option<BaseMesh>,
    /// Why the base mesh was delivered whole although the object alone was asked for.
    pub not_cropped_reason: Option<String>,
    /// The part of the base mesh that is the object.
    pub object: Option<TriMesh>,
    /// The refined surface.
    pub refinement: Option<Refinement>,
    /// Why there is none.
    pub not_refined_reason: Option<String>,
    /// Times of the steps that ran.
    pub timings: Vec<StageTiming>,
}

/// What a refinement that is wanted has to go by.
#[derive(Clone, Copy)]
struct Wanted<'a> {
    params: &'a RefineParams,
    snapshots: &'a [ShadingSnapshot],
}

/// Waits for the scan, exports its base mesh, refines and exports the rest.
pub fn run(
    setup: &RefineSetup,
    scans: &Receiver<Arc<FusedScan>>,
    outbox: &Outbox,
) -> RefineSummary {
    let mut summary = RefineSummary::default();
    // Why it never comes is told of by the fusion thread.
    let Ok(scan) = scans.recv() else {
        summary.not_refined_reason = Some(NO_SCAN.to_owned());
        return summary;
    };
    let mut export_clock = StageClock::new("export");
    let mut object_clock = StageClock::new("selection of the object");
    let mut refine_clock = StageClock::new("refinement");

    let mut find = || object_clock.time(|| setup.pool.install(|| object_of(setup, &scan)));
    if setup.object.crop.is_for_delivery() {
        match find() {
            Ok(object) => summary.object = Some(object),
            Err(reason) => summary.not_cropped_reason = Some(reason),
        }
    }
    let images = shading_images(setup, &scan);
    let is_missing = summary.object.is_none() && wanted(setup, &images).is_ok();
    let object = summary.object.as_ref();
    // The base mesh first, then the shading images: whatever becomes of the object, they are there.
    let deliver = || {
        export_clock.time(|| {
            let base_mesh = deliver_fused(setup, &scan, object, outbox);
            if let Ok(snapshots) = &images {
                outbox.snapshots(snapshots, &camera_of(setup, &scan));
            }
            base_mesh
        })
    };
    let (base_mesh, found) = setup.pool.join(deliver, || is_missing.then(find));
    summary.base_mesh = Some(base_mesh);
    // Asked anew: somebody may have stopped the run meanwhile.
    let refined = wanted(setup, &images).and_then(|wanted| {
        if let Some(found) = found {
            summary.object = Some(found?);
        }
        let object = summary.object.as_ref();
        let object = object.expect("looked for where refinement is wanted");
        setup.status.update(|status| status.phase = Phase::Refining);
        let refine = || run_refine(setup, wanted, &scan, object);
        refine_clock.time(|| setup.pool.install(refine))
    });
    setup
        .status
        .update(|status| status.phase = Phase::Exporting);
    match refined {
        Ok(mut refinement) => {
            export_clock.time(|| deliver_refined(setup, &mut refinement, outbox));
            summary.refinement = Some(refinement);
        }
        Err(reason) => {
            // Where nobody asked for refinement nothing is wrong.
            if setup.refine.is_some() {
                tracing::warn!(reason, "not refined");
            }
            summary.not_refined_reason = Some(reason);
        }
    }
    summary.timings = [object_clock, refine_clock, export_clock]
        .iter()
        .filter_map(StageClock::timing)
        .collect();
    summary
}

/// What there is to refine by, or why there is to be no refinement.
fn wanted<'a>(
    setup: &'a RefineSetup,
    images: &Result<&'a [ShadingSnapshot], String>,
) -> Result<Wanted<'a>, String> {
    let snapshots = images.clone()?;
    let params = setup.refine.as_ref().ok_or(SWITCHED_OFF)?;
    match setup.stop.is_stopped() {
        true => Err("the run was stopped before refinement began".to_owned()),
        false => Ok(Wanted { params, snapshots }),
    }
}

/// The shading images to refine from, or why there are none.
fn shading_images<'a>(
    setup: &RefineSetup,
    scan: &'a FusedScan,
) -> Result<&'a [ShadingSnapshot], String> {
    if setup.info.ir_full_scale.is_none() || setup.info.light.is_none() {
        return Err("the session has no infrared images".to_owned());
    }
    let none = || "the camera gives no shading images".to_owned();
    let selection = scan.snapshots.as_ref().ok_or_else(none)?;
    if selection.accepted.is_empty() {
        return Err(why_none_accepted(selection));
    }
    Ok(&selection.accepted)
}

/// The reasons of the rejections, the most frequent first.
fn why_none_accepted(selection: &SnapshotSelection) -> String {
    let reasons = selection.reasons();
    match reasons.is_empty() {
        true => "no frame could serve as a shading image".to_owned(),
        false => format!(
            "no frame could serve as a shading image ({})",
            reasons.join("; ")
        ),
    }
}

/// Writes the base mesh, which is the object where that is delivered, and then what was fused beside it.
fn deliver_fused(
    setup: &RefineSetup,
    scan: &FusedScan,
    object: Option<&TriMesh>,
    outbox: &Outbox,
) -> BaseMesh {
    let is_changed = object.is_some() || setup.object.watertight;
    if is_changed && setup.keeps_scene {
        outbox.scene_mesh(&scan.base);
    }
    deliver_base(setup, object.unwrap_or(&scan.base), outbox)
}

/// Writes a refined mesh, its holes filled if that is asked for, and what of the images it was made from.
fn deliver_refined(setup: &RefineSetup, refinement: &mut Refinement, outbox: &Outbox) {
    if setup.object.watertight {
        close(refinement);
    }
    tracing::info!(
        faces = refinement.mesh.faces.len(),
        status = ?refinement.status,
        steps = refinement.iterations.len(),
        remeshing_hausdorff_m = refinement.remeshing.hausdorff_m(),
        "surface refined"
    );
    let refinement: &Refinement = refinement;
    let mesh = || outbox.refined_mesh(refinement);
    let masks = || outbox.masks(&refinement.masks);
    setup.pool.join(mesh, masks);
}

/// Writes the base mesh, its holes filled if that is asked for; returns what was written.
fn deliver_base(setup: &RefineSetup, base: &TriMesh, outbox: &Outbox) -> BaseMesh {
    let figures = |mesh: &TriMesh| BaseMesh {
        vertices: mesh.vertices.len(),
        faces: mesh.faces.len(),
        area_m2: mesh.area_m2(),
        ..BaseMesh::default()
    };
    if !setup.object.watertight {
        outbox.base_mesh(base);
        return figures(base);
    }
    let closed = close_holes(base);
    outbox.base_mesh(&closed.mesh);
    BaseMesh {
        n_holes_filled: closed.n_holes,
        filled_m2: closed.filled_m2,
        ..figures(&closed.mesh)
    }
}

/// Fills the holes of a refined mesh; what fills them has the albedo and the evidence of its rim.
fn close(refinement: &mut Refinement) {
    let closed = close_holes(&refinement.mesh);
    let albedo = |&vertex: &u32| refinement.albedo[vertex as usize];
    let label = |&vertex: &u32| refinement.labels[vertex as usize];
    refinement.albedo = closed.from.iter().map(albedo).collect();
    refinement.labels = closed.from.iter().map(label).collect();
    refinement.evidence = refinement.evidence.of_vertices(&closed.from);
    refinement.mesh = closed.mesh;
}

/// The part of the base mesh to refine, or why there is none.
fn object_of(setup: &RefineSetup, scan: &FusedScan) -> Result<TriMesh, String> {
    let object = scan.object(setup.roi.as_ref(), setup.object.crop)?;
    tracing::info!(
        faces = object.faces.len(),
        area_m2 = object.area_m2(),
        "object selected"
    );
    Ok(object)
}

/// The camera as the scan was fused in the end.
fn camera_of(setup: &RefineSetup, scan: &FusedScan) -> CameraInfo {
    CameraInfo {
        intrinsics: scan.intrinsics,
        ..setup.info.clone()
    }
}

fn run_refine(
    setup: &RefineSetup,
    wanted: Wanted,
    scan: &FusedScan,
    object: &TriMesh,
) -> Result<Refinement, String> {
    let Wanted { params, snapshots } = wanted;
    let info = camera_of(setup, scan);
    let rays = RayGrid::new(CameraModel::new(info.intrinsics));
    let optics = Optics::of(&info, &rays, &setup.calibration).ok_or(NO_OPTICS)?;
    let mut first_energy = None;
    setup
        .status
        .update(|status| status.refinement.rounds = (0, params.n_rounds + 1));
    let progress = |iteration: &crate::refine::Iteration| {
        let first = *first_energy.get_or_insert(iteration.energy_before);
        setup.status.update(|status| {
            let refinement = &mut status.refinement;
            refinement.rounds.0 = iteration.round + 1;
            refinement.n_steps += 1;
            refinement.energy_share = iteration.energy_after / first;
        });
        !setup.stop.is_stopped()
    };
    let subject = Subject {
        scene: &scan.base,
        object,
        snapshots,
        optics: &optics,
    };
    refine(&subject, params, progress).map_err(|error| error.to_string())
}
