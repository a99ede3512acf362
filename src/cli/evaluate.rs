//! `relief evaluate`: how well refinement of a scan explains images that it was not made from, as in Section 5 of the paper.
//!
//! Views are left out in folds; each is rendered from the base and from the refined surface and compared with what the sensor
//! saw. With `--ablations` the same is done with something changed (`ablations`), all judged by the same views. With `--truth` both surfaces are compared with a mesh measured by something better, which nothing else is
//! given. The report is Markdown with pictures beside it.

mod ablations;

use super::{
    EvaluateArgs,
    run::{self, FoundScan, Verdict},
};
use anyhow::{Context, ensure};
use depth_camera::CameraInfo;
use relief::{
    evaluate::{Cameras, SurfaceError, Truth, surface_error},
    export::{
        AgainstTruth, EvaluationPictures, EvaluationReport, LeftOutView, MeanView, PhongParams,
        PictureSize, TruthFigures, phong, read_ply, three_views, write_evaluation,
    },
    geometry::{CameraModel, Pose, RayGrid, TriMesh},
    pipeline::{OutputFolder, RecordedScan},
    refine::{
        Crop, HeldOut, JudgedView, Judgement, Optics, RefineParams, Subject, cross_validate, refine,
    },
    shading::Calibration,
    snapshot::ShadingSnapshot,
};

/// `relief evaluate`.
pub fn evaluate(args: &EvaluateArgs) -> anyhow::Result<Verdict> {
    let FoundScan {
        config,
        recorded,
        found,
    } = FoundScan::read(&args.scan)?;
    let out = OutputFolder::claim(&args.out)?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.scan.threads.unwrap_or_else(run::all_processors).get())
        .build()?;
    let truth = args.truth.as_deref().map(read_ply).transpose()?;
    let scan = Scan::new(recorded, args, config.object.crop)?;
    let truth = truth.map(|mesh| {
        let bounds = args.truth_box.map(|bounds| [bounds.0.min, bounds.0.max]);
        Truth::new(mesh, bounds)
    });
    let report =
        pool.install(|| scan.evaluate(args, truth.as_ref(), &found.calibration, &config.refine))?;
    write_evaluation(out.path(), &report)?;
    match args.json {
        true => println!("{}", serde_json::to_string(&report)?),
        false => println!("evaluation: {}", out.path().join("evaluation.md").display()),
    }
    Ok(Verdict::Done)
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
        truth: Option<&Truth>,
        calibration: &Calibration,
        params: &RefineParams,
    ) -> anyhow::Result<EvaluationReport> {
        let rays = RayGrid::new(CameraModel::new(self.info.intrinsics));
        let optics = self.optics(&rays, calibration)?;
        let subject = self.subject(&optics);
        let n_folds = args.folds.min(self.snapshots.len());
        let folded = |fold| {
            tracing::info!(fold = fold + 1, of = n_folds, "fold judged");
            true
        };
        let judged = match n_folds {
            0 => Vec::new(),
            _ => cross_validate(&subject, params, n_folds, folded)?,
        };
        let ablations = match args.ablations {
            true => ablations::judged(self, &rays, calibration, params)?,
            false => Vec::new(),
        };
        let refined = refine(&subject, params, |_| true);
        let refined_mesh = refined.as_ref().ok().map(|refined| &refined.mesh);
        let truth_from_world = args.truth_pose.map_or(Pose::identity(), |pose| pose.0);
        let against = |truth| self.against(truth, truth_from_world, refined_mesh);
        Ok(EvaluationReport {
            truth: truth.map(against).transpose()?,
            session: self.session.clone(),
            n_folds,
            overall: figures(None, &Judgement::of(&judged).overall),
            views: judged.iter().map(|view| self.left_out(view)).collect(),
            ablations,
            not_refined_reason: refined.as_ref().err().map(ToString::to_string),
            pictures: self.pictures(&judged, refined_mesh),
        })
    }

    /// Both surfaces against the truth.
    fn against(
        &self,
        truth: &Truth,
        truth_from_world: Pose,
        refined: Option<&TriMesh>,
    ) -> anyhow::Result<AgainstTruth> {
        let cameras = Cameras {
            model: &CameraModel::new(self.info.intrinsics),
            world_from_cameras: &self.world_from_cameras,
            truth_from_world,
        };
        let figures = |mesh| anyhow::Ok(truth_figures(&surface_error(truth, mesh, &cameras)?));
        Ok(AgainstTruth {
            base: figures(&self.object)?,
            refined: refined.map(figures).transpose()?,
        })
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
    } = held_out;
    LeftOutView {
        frame_id,
        n_pixels: *n_pixels,
        intensity: [base.intensity, refined.intensity, noise.intensity],
        gradient: [base.gradient, refined.gradient, noise.gradient],
    }
}
