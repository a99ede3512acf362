//! What other programs need to do a part of a scan's refinement: for `ceres.py` and `mitsuba.py` beside this file.
//!
//! ```sh
//! cargo run --release --example peer_inputs -- out/NAME out/peer-inputs [EDGE_LENGTH_M]
//! ```
//!
//! The folder then holds, after all rounds of Relief's own refinement,
//! - `step.json`: the Gauss-Newton step that comes next ([`LeastSquares`]), Relief's solution of it, and processor seconds on
//!   one thread: of summing residuals and derivatives of all views, and of factorising and solving;
//! - `base.ply`: the base surface as remeshed, from which refinement starts, with `albedo.f32`, the albedo of each of its
//!   vertices times the light's strength, m²;
//! - `views.json`: camera, light, and for every view its aligned pose, world from camera, row by row; `linear-NNN.f32` is its
//!   linear intensity with gains taken off, row by row, NaN where a pixel is not used.
//!
//! Numbers of the binary files are little-endian single precision.

#[path = "../../../src/cli/processor_time.rs"]
mod processor_time;
#[path = "../scan.rs"]
mod scan;

use anyhow::{Context, ensure};
use depth_camera::Intrinsics;
use processor_time::process_cpu_secs;
use relief::{
    export::write_ply,
    refine::{
        RefineParams, SiteKind, Step, Subject,
        remesh::{RemeshParams, remesh},
        stages::{LeastSquares, Stages},
    },
};
use scan::Scan;
use serde::Serialize;
use std::{
    fs::{self, File},
    io::BufWriter,
    path::Path,
};

#[derive(Serialize)]
struct Solved {
    problem: LeastSquares,
    step: Step,
    linearise_cpu_secs: f64,
    solve_cpu_secs: f64,
}

#[derive(Serialize)]
struct Views {
    camera: Intrinsics,
    light_position_m: [f64; 3],
    light_lobe_power: f64,
    world_from_cameras: Vec<[f64; 16]>,
}

fn main() -> anyhow::Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    ensure!(
        (2..=3).contains(&args.len()),
        "usage: peer_inputs SCAN OUT [EDGE_LENGTH_M]"
    );
    let edge_length_m = args.get(2).map(|text| text.parse()).transpose()?;
    let params = RefineParams {
        edge_length_m: edge_length_m.unwrap_or(RefineParams::default().edge_length_m),
        max_vertices: 5_000_000,
        // What couples by edges alone is what other solvers can be given.
        sites: SiteKind::Face,
        ..RefineParams::default()
    };
    let (scan, out) = (Scan::read(Path::new(&args[0]))?, Path::new(&args[1]));
    fs::create_dir_all(out)?;
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let edge_length_m = one_thread.install(|| {
        scan.with_subject(|subject| {
            let params = params.for_object(subject.object, subject.footprint_m());
            let stages = Stages::after_rounds(subject, &params, params.n_rounds)?;
            write_step(&stages, &out.join("step.json"))?;
            write_views(&scan, subject, &stages, out)?;
            Ok(params.edge_length_m)
        })
    })?;
    let base = remesh(&scan.object, &RemeshParams::new(edge_length_m));
    Ok(write_ply(
        &out.join("base.ply"),
        &base,
        &base.vertex_normals(),
        None,
    )?)
}

fn write_step(stages: &Stages, path: &Path) -> anyhow::Result<()> {
    let start_secs = process_cpu_secs();
    let matrix = stages.linearise();
    let linearised_secs = process_cpu_secs();
    let step = stages
        .solve(&matrix, 0.0)
        .context("the normal matrix is not positive definite")?;
    let solved = Solved {
        step,
        linearise_cpu_secs: linearised_secs - start_secs,
        solve_cpu_secs: process_cpu_secs() - linearised_secs,
        problem: stages.least_squares().context("sites are at vertices")?,
    };
    write_json(path, &solved)
}

fn write_views(scan: &Scan, subject: &Subject, stages: &Stages, out: &Path) -> anyhow::Result<()> {
    let views = stages.views();
    for (number, view) in views.iter().enumerate() {
        write_floats(
            &out.join(format!("linear-{number:03}.f32")),
            view.linear.data(),
        )?;
    }
    let albedo = stages.albedo_by_vertex();
    let albedo: Vec<f32> = albedo.iter().map(|&albedo| albedo as f32).collect();
    write_floats(&out.join("albedo.f32"), &albedo)?;
    let light = &subject.optics.light;
    let poses = views.iter().map(|view| view.world_from_camera);
    let views = Views {
        camera: scan.info.intrinsics,
        light_position_m: light.position.coords.into(),
        light_lobe_power: light.lobe_power,
        world_from_cameras: poses
            .map(|pose| {
                let by_row = pose.to_homogeneous().transpose();
                std::array::from_fn(|entry| by_row.as_slice()[entry])
            })
            .collect(),
    };
    write_json(&out.join("views.json"), &views)
}

fn write_json(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    let file = File::create(path).with_context(|| path.display().to_string())?;
    Ok(serde_json::to_writer(BufWriter::new(file), value)?)
}

fn write_floats(path: &Path, values: &[f32]) -> anyhow::Result<()> {
    let bytes: Vec<u8> = values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect();
    fs::write(path, bytes).with_context(|| path.display().to_string())
}
