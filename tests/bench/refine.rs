//! What each step of refinement takes, processor time on one thread.
//!
//! ```sh
//! relief replay tests/data/demo --out out/demo
//! RELIEF_SCAN=out/demo cargo bench --bench refine
//! ```
//!
//! Without `RELIEF_SCAN` the demo is fused first.

#[path = "../../src/cli/processor_time.rs"]
mod processor_time;
#[path = "scan.rs"]
mod scan;

use criterion::{
    Criterion, SamplingMode,
    measurement::{Measurement, ValueFormatter, WallTime},
};
use processor_time::process_cpu_secs;
use relief::{
    config::Config,
    devices::open_recording,
    geometry::{CameraModel, coarsened, rasterise},
    pipeline::{OutputFolder, Pipeline, PipelineParams, WhenFull},
    refine::{
        JacobianMode, RefineParams, SiteKind, Subject,
        remesh::{RemeshParams, remesh},
        stages::Stages,
    },
    shading::Calibration,
};
use replay::Pacing;
use scan::Scan;
use std::{hint::black_box, num::NonZeroUsize, path::Path, time::Duration};

fn main() -> anyhow::Result<()> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build_global()?;
    let scan = match std::env::var_os("RELIEF_SCAN") {
        Some(folder) => Scan::read(Path::new(&folder))?,
        None => fused_demo()?,
    };
    let mut criterion = Criterion::default()
        .with_measurement(ProcessorTime)
        .configure_from_args();
    scan.with_subject(|subject| steps(&scan, subject, &mut criterion))?;
    criterion.final_summary();
    Ok(())
}

/// Processor time of this process, which other work on the machine disturbs less than wall time.
struct ProcessorTime;

impl Measurement for ProcessorTime {
    type Intermediate = f64;
    type Value = f64;

    fn start(&self) -> f64 {
        process_cpu_secs()
    }

    fn end(&self, start_secs: f64) -> f64 {
        process_cpu_secs() - start_secs
    }

    fn add(&self, a: &f64, b: &f64) -> f64 {
        a + b
    }

    fn zero(&self) -> f64 {
        0.0
    }

    /// Nanoseconds, as the formatter has them.
    fn to_f64(&self, secs: &f64) -> f64 {
        1e9 * secs
    }

    fn formatter(&self) -> &dyn ValueFormatter {
        const WALL_TIME: &WallTime = &WallTime;
        WALL_TIME.formatter()
    }
}

/// The recorded demo, fused into a temporary folder and read back.
fn fused_demo() -> anyhow::Result<Scan> {
    let folder = tempfile::tempdir()?;
    let session = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/demo");
    let config = Config::default();
    let camera = open_recording(&session, &config.devices, Pacing::AsFastAsPossible)?;
    let params = PipelineParams {
        session: "demo".to_owned(),
        capture: config.capture,
        multipath: config.multipath,
        fusion: config.fusion,
        snapshot: config.snapshot,
        object: config.object,
        refine: config.refine,
        is_refined: false,
        calibration: Calibration::shipped(camera.info().sensor).map_err(anyhow::Error::msg)?,
        calibration_source: "shipped".to_owned(),
        roi: None,
        poses: None,
        n_threads: NonZeroUsize::MIN,
        when_full: WhenFull::Block,
        record: false,
        warnings: Vec::new(),
    };
    let out = folder.path().join("out");
    Pipeline::spawn(camera, params, OutputFolder::claim(&out)?)?.join();
    Scan::read(&out)
}

fn steps(
    scan: &Scan,
    subject: &Subject,
    criterion: &mut Criterion<ProcessorTime>,
) -> anyhow::Result<()> {
    let params = RefineParams::default().for_object(subject.object, subject.footprint_m());
    let stages = Stages::after_rounds(subject, &params, 1)?;
    let at_facets = |jacobian| {
        let params = RefineParams {
            sites: SiteKind::Face,
            jacobian,
            ..params.clone()
        };
        Stages::after_rounds(subject, &params, 1)
    };
    let analytic = at_facets(JacobianMode::Analytic)?;
    let numeric = at_facets(JacobianMode::Numeric)?;
    let matrix = stages.linearise();
    let (n_vertices, n_views) = (stages.n_vertices(), subject.snapshots.len());
    let mut group = criterion.benchmark_group(format!("refine/{n_vertices}/{n_views}"));
    group
        .sampling_mode(SamplingMode::Flat)
        .sample_size(20)
        .warm_up_time(Duration::from_secs(1))
        .measurement_time(Duration::from_secs(4));
    let remeshing = RemeshParams::new(params.edge_length_m);
    group.bench_function("remesh", |b| b.iter(|| remesh(&scan.object, &remeshing)));
    let hider = coarsened(&scan.base, relief::refine::HIDING_CELL_M);
    let camera = CameraModel::new(scan.info.intrinsics);
    let camera_from_world = subject.snapshots[0].world_from_camera.inverse();
    group.bench_function("depth buffer of one view", |b| {
        b.iter(|| rasterise(&hider, &camera, black_box(&camera_from_world)));
    });
    group.bench_function("hiding", |b| b.iter(|| stages.hide()));
    group.bench_function("sampling", |b| b.iter(|| stages.observe()));
    group.bench_function("albedo", |b| b.iter(|| stages.estimate_albedo()));
    group.bench_function("residuals", |b| b.iter(|| stages.energy()));
    group.bench_function("residuals and Jacobian", |b| b.iter(|| stages.linearise()));
    group.bench_function("residuals and Jacobian at facets", |b| {
        b.iter(|| analytic.linearise());
    });
    group.bench_function("residuals and numeric Jacobian at facets", |b| {
        b.iter(|| numeric.linearise());
    });
    group.bench_function("solve", |b| b.iter(|| stages.solve(&matrix, 1e-4)));
    group.finish();
    Ok(())
}
