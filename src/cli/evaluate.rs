//! `relief evaluate`: how well refinement of a scan explains images that it was not made from, as in Section 5 of the paper.
//!
//! Views are left out in folds; each is rendered from the base and from the refined surface and compared with what the sensor
//! saw. With `--ablations` the same is done with something changed (`ablations`), all judged by the same views. With `--truth` both
//! surfaces are compared with a mesh measured by something better, which nothing else is given. The report is Markdown with pictures
//! beside it. A wrong truth ends it before the long work; what else comes to nothing stands in the report with its reason. A signal ends it
//! after the refinement that it is at, of the first one at its next step, and nothing is written.

mod ablations;

use super::{
    EvaluateArgs,
    found_scan::FoundScan,
    run::{self, Verdict},
    stdout::Stdout,
    stopping::check_wanted,
};
use anyhow::{Context, ensure};
use depth_camera::CameraInfo;
use relief::{
    control,
    evaluate::{Cameras, SurfaceError, SurfaceErrorFailure, Truth, surface_error},
    export::{
        AgainstTruth, EvaluationPictures, EvaluationReport, LeftOutView, MeanView, PhongParams,
        PictureSize, TruthFigures, phong, read_ply, three_views, write_evaluation,
    },
    geometry::{CameraModel, Pose, RayGrid, TriMesh},
    pipeline::{OutputFolder, RecordedScan},
    refine::{
        Crop, HeldOut, JudgedView, Judgement, Optics, RefineError, RefineParams, Subject,
        cross_validate, refine,
    },
    shading::Calibration,
    snapshot::ShadingSnapshot,
};
use std::{io::Write, path::Path, sync::atomic::AtomicBool};

/// `relief evaluate`; a signal ends it before it writes.
///
/// # Errors
/// For a scan that cannot be read or refined from, a truth that cannot be compared, and a folder that cannot be written;
/// [`Stopped`](super::stopping::Stopped).
pub fn evaluate(args: &EvaluateArgs) -> anyhow::Result<Verdict> {
    let args = args.clone();
    control::until_stopped(move |stop| evaluate_unless(stop, &args))?
}

fn evaluate_unless(stop: &AtomicBool, args: &EvaluateArgs) -> anyhow::Result<Verdict> {
    let FoundScan {
        config,
        recorded,
        found,
        ..
    } = FoundScan::read(&args.scan)?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.scan.threads.unwrap_or_else(run::all_processors).get())
        .build()?;
    let truth = args.truth.as_deref().map(|path| read_truth(path, args));
    let truth = truth.transpose()?;
    let scan = Scan::new(recorded, args, config.object.crop)?;
    // Before the long work, since a truth that lies elsewhere is an error.
    let truth = truth.map(|truth| pool.install(|| scan.compared(truth, args)));
    let truth = truth.transpose()?;
    check_wanted(stop)?;
    // What cannot be read or compared leaves no folder behind.
    let out = OutputFolder::claim(&args.out)?;
    let (calibration, params) = (&found.calibration, &config.refine);
    let report =
        pool.install(|| scan.evaluate(args, truth.as_ref(), (calibration, params), stop))?;
    write_evaluation(out.path(), &report)?;
    match args.json {
        true => writeln!(Stdout, "{}", serde_json::to_string(&report)?)?,
        false => writeln!(
            Stdout,
            "evaluation: {}",
            out.path().join("evaluation.md").display()
        )?,
    }
    Ok(Verdict::Done)
}

/// A mesh that was measured by something better.
fn read_truth(path: &Path, args: &EvaluateArgs) -> anyhow::Result<Truth> {
    let mesh = read_ply(path)?;
    ensure!(
        !mesh.faces.is_empty(),
        "{} has no faces: a mesh is needed, not points",
        path.display()
    );
    let bounds = args.truth_box.map(|bounds| [bounds.0.min, bounds.0.max]);
    Ok(Truth::new(mesh, bounds))
}

/// A truth that the scan's base mesh was compared with.
struct ComparedTruth {
    truth: Truth,
    truth_from_world: Pose,
    base: TruthFigures,
}

/// What is evaluated.
struct Scan {
    session: String,
    info: CameraInfo,
    base: TriMesh,
    object: TriMesh,
    mean_view: MeanView,
    world_from_cameras: Vec<Pose>,
    snapshots: Vec<ShadingSnapshot>,
}

impl Scan {
    fn new(recorded: RecordedScan, args: &EvaluateArgs, crop: Crop) -> anyhow::Result<Self> {
        let RecordedScan { info, scan } = recorded;
        let roi = args.scan.roi.as_ref().map(|roi| &roi.0);
        let object = scan.object(roi, crop).map_err(anyhow::Error::msg)?;
        let snapshots = scan.snapshots.context("no shading images")?.accepted;
        let leaves_out = args.folds > 0 || args.ablations;
        ensure!(
            snapshots.len() > 1 || !leaves_out,
            "{} shading images, at least 2 are needed to leave one out",
            snapshots.len()
        );
        Ok(Scan {
            session: run::session_name(&args.scan.output),
            info,
            object,
            mean_view: MeanView::from_poses(&scan.world_from_cameras),
            world_from_cameras: scan.world_from_cameras,
            base: scan.base,
            snapshots,
        })
    }

    fn evaluate(
        &self,
        args: &EvaluateArgs,
        truth: Option<&ComparedTruth>,
        (calibration, params): (&Calibration, &RefineParams),
        stop: &AtomicBool,
    ) -> anyhow::Result<EvaluationReport> {
        let rays = RayGrid::new(CameraModel::new(self.info.intrinsics));
        let optics = self.optics(&rays, calibration)?;
        let subject = self.subject(&optics);
        let against = |mesh: &TriMesh| {
            truth.map(|truth| self.against(&truth.truth, truth.truth_from_world, mesh))
        };
        let goes_on = || check_wanted(stop).is_ok();
        let refined = refine(&subject, params, |_| goes_on()).map(|refined| refined.mesh);
        let refined_mesh = refined.as_ref().ok();
        let refined_truth = refined_mesh.and_then(against).transpose()?;
        let n_folds = args.folds.min(self.snapshots.len());
        check_wanted(stop)?;
        let (judged, not_judged_reason) = match judged_in_folds(&subject, params, n_folds, &goes_on)
        {
            Ok(judged) => (judged, None),
            Err(error) => (Vec::new(), Some(error.to_string())),
        };
        let ablations = match args.ablations {
            true => ablations::judged(self, &rays, calibration, params, stop)?,
            false => Vec::new(),
        };
        check_wanted(stop)?;
        Ok(EvaluationReport {
            session: self.session.clone(),
            truth: truth.map(|truth| AgainstTruth {
                base: truth.base,
                refined: refined_truth,
            }),
            n_folds,
            overall: figures(None, &Judgement::of(&judged).overall),
            views: judged.iter().map(|view| self.left_out(view)).collect(),
            not_judged_reason,
            ablations,
            not_refined_reason: refined.as_ref().err().map(ToString::to_string),
            pictures: self.pictures(&judged, refined_mesh),
        })
    }

    /// A truth with what the base mesh is against it.
    fn compared(
        &self,
        truth: Truth,
        args: &EvaluateArgs,
    ) -> Result<ComparedTruth, SurfaceErrorFailure> {
        let truth_from_world = args.truth_pose.map_or(Pose::identity(), |pose| pose.0);
        let base = self.against(&truth, truth_from_world, &self.object)?;
        Ok(ComparedTruth {
            truth,
            truth_from_world,
            base,
        })
    }

    /// A surface of the scan against the truth.
    fn against(
        &self,
        truth: &Truth,
        truth_from_world: Pose,
        mesh: &TriMesh,
    ) -> Result<TruthFigures, SurfaceErrorFailure> {
        let cameras = Cameras {
            model: &CameraModel::new(self.info.intrinsics),
            world_from_cameras: &self.world_from_cameras,
            truth_from_world,
        };
        surface_error(truth, mesh, &cameras).map(|error| truth_figures(&error))
    }

    fn optics<'a>(
        &self,
        rays: &'a RayGrid,
        calibration: &'a Calibration,
    ) -> anyhow::Result<Optics<'a>> {
        Optics::of(&self.info, rays, calibration)
            .context("the scan does not say where its light is, or what full scale is")
    }

    fn subject<'a>(&'a self, optics: &'a Optics<'a>) -> Subject<'a> {
        Subject {
            scene: &self.base,
            object: &self.object,
            snapshots: &self.snapshots,
            optics,
        }
    }

    fn left_out(&self, view: &JudgedView) -> LeftOutView {
        let frame_id = self.snapshots[view.index].frame_id;
        figures(Some(frame_id), &view.figures())
    }

    fn pictures(&self, judged: &[JudgedView], refined: Option<&TriMesh>) -> EvaluationPictures {
        let size = PictureSize {
            width: 480,
            height: 360,
        };
        let front = three_views(&self.object, &self.mean_view, size).map(|[front, ..]| front);
        let draw = |mesh: &TriMesh| {
            let view = front.as_ref()?;
            Some(phong(
                mesh,
                &mesh.vertex_normals(),
                view,
                &PhongParams::default(),
            ))
        };
        // The view in the middle of the order of refined errors stands for all.
        let mut order: Vec<&JudgedView> = judged.iter().collect();
        let refined_error = |view: &JudgedView| view.figures().refined.intensity;
        order.sort_by(|a, b| refined_error(a).total_cmp(&refined_error(b)));
        let middle = order.get(order.len() / 2);
        EvaluationPictures {
            base: draw(&self.object),
            refined: refined.and_then(draw),
            error_maps: middle.map(|view| [view.base_error.clone(), view.refined_error.clone()]),
            error_frame_id: middle.map(|view| self.snapshots[view.index].frame_id),
        }
    }
}

/// Every view, judged by a refinement from the other folds; none without folds, and not all if `goes_on` says no after one.
fn judged_in_folds(
    subject: &Subject,
    params: &RefineParams,
    n_folds: usize,
    goes_on: &impl Fn() -> bool,
) -> Result<Vec<JudgedView>, RefineError> {
    let folded = |fold| {
        tracing::info!(fold = fold + 1, of = n_folds, "fold judged");
        goes_on()
    };
    match n_folds {
        0 => Ok(Vec::new()),
        _ => cross_validate(subject, params, n_folds, folded),
    }
}

fn truth_figures(error: &SurfaceError) -> TruthFigures {
    TruthFigures {
        n_points: error.n_points,
        mean_mm: 1e3 * error.mean_m,
        median_mm: 1e3 * error.median_m,
        rms_mm: 1e3 * error.rms_m,
        detail_rms_mm: 1e3 * error.detail_rms_m,
        normal_mean_deg: error.normal_mean_rad.to_degrees(),
        normal_median_deg: error.normal_median_rad.to_degrees(),
        completeness: error.completeness,
    }
}

fn figures(frame_id: Option<u64>, held_out: &HeldOut) -> LeftOutView {
    let HeldOut {
        n_pixels,
        base,
        refined,
        noise,
        ..
    } = held_out.reported();
    LeftOutView {
        frame_id,
        n_pixels,
        intensity: [base.intensity, refined.intensity, noise.intensity],
        gradient: [base.gradient, refined.gradient, noise.gradient],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::{Cli, Command};
    use clap::Parser;
    use depth_camera::{Image, Intrinsics, Light, Sensor};
    use relief::{export::AblationOutcome, refine::MAX_VIEWS};

    fn arguments() -> EvaluateArgs {
        let line = ["relief", "evaluate", "scan", "--out", "out", "--ablations"];
        match Cli::try_parse_from(line).unwrap().command {
            Command::Evaluate(args) => args,
            other => panic!("{other:?}"),
        }
    }

    /// A scan of nothing, with one image more than refinement takes.
    fn scan() -> Scan {
        let snapshot = ShadingSnapshot {
            frame_id: 0,
            device_time_secs: 0.0,
            n_exposures: 1,
            ir_counts: Image::filled(1, 1, 0.0),
            unlit_counts: None,
            depth_m: Image::filled(1, 1, 0.0),
            world_from_camera: Pose::identity(),
            moved: None,
        };
        let intrinsics = Intrinsics {
            width: 32,
            height: 24,
            fx: 30.0,
            fy: 30.0,
            cx: 15.5,
            cy: 11.5,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
        };
        Scan {
            session: "nothing".into(),
            info: CameraInfo {
                sensor: Sensor::Kinect2,
                serial: "nothing".into(),
                driver: None,
                intrinsics,
                ir_full_scale: Some(65535.0),
                ir_gain: None,
                light: Some(Light::kinect2_emitter()),
                n_frames: None,
            },
            base: TriMesh::default(),
            object: TriMesh::default(),
            mean_view: MeanView::from_poses(&[]),
            world_from_cameras: Vec::new(),
            snapshots: vec![snapshot; MAX_VIEWS + 1],
        }
    }

    #[test]
    fn what_comes_to_nothing_stands_in_the_report() {
        let calibration = Calibration::shipped(Sensor::Kinect2).unwrap();
        let with = (&calibration, &RefineParams::default());
        let stop = AtomicBool::new(false);
        let report = scan().evaluate(&arguments(), None, with, &stop).unwrap();
        let n_views = MAX_VIEWS + 1;
        let reason = RefineError::TooManyViews { n_views }.to_string();
        assert_eq!(report.not_judged_reason.as_ref(), Some(&reason));
        assert_eq!(report.not_refined_reason.as_ref(), Some(&reason));
        let json = serde_json::to_value(report.overall).unwrap();
        for key in ["intensity", "gradient"] {
            assert_eq!(json[key], serde_json::json!([null, null, null]), "{key}");
        }
        assert!(!report.ablations.is_empty());
        for ablation in &report.ablations {
            let AblationOutcome::Failed { not_judged_reason } = &ablation.outcome else {
                panic!("{ablation:?}");
            };
            assert_eq!(*not_judged_reason, reason);
        }
    }

    #[test]
    fn a_truth_that_is_not_near_is_refused() {
        let truth = Truth::new(TriMesh::default(), None);
        let result = scan().compared(truth, &arguments());
        assert!(matches!(result, Err(SurfaceErrorFailure::Elsewhere { .. })));
    }
}
