//! Refinement against closed forms: derivatives, energies, and the whole of it.

use super::alignment::{AlignmentParams, AlignmentTarget, align_view};
use super::couplings::Couplings;
use super::energy::Problem;
use super::numeric::JacobianMode;
use super::observations::Observations;
use super::priors::PriorWeights;
use super::scenes::{
    ALBEDO, RippledPlane, calibration, optics, poses, rays, solved, surface_of, views, whole,
};
use super::site_motion::{Linearisation, SiteMotion};
use super::sites::{SiteKind, Sites, ViewSet};
use super::solver::SolverParams;
use super::surface::Surface;
use super::{ImageTrust, RefineError, RefineParams, Refinement, patches, refine};
use crate::geometry::{EdgeAdjacency, TriMesh, increment, motion_between};
use crate::robust::Tukey;
use nalgebra::{Point3, Translation3, Vector6};

const RIPPLED: RippledPlane = RippledPlane {
    amplitude_m: 0.0003,
};
const FLAT: RippledPlane = RippledPlane { amplitude_m: 0.0 };

/// Displacements that look random and are not.
fn shaken(surface: &Surface, amplitude_m: f64) -> Surface {
    let step: Vec<f64> = (0..surface.total_m.len())
        .map(|i| amplitude_m * ((i as f64 * 0.618_034).fract() - 0.5))
        .collect();
    surface.displaced(&step)
}

#[test]
fn gradient_matches_central_differences_of_the_energy() {
    for finds_tints in [false, true] {
        for linearisation in [Linearisation::Full, Linearisation::Detail] {
            check_gradient(linearisation, SiteKind::Face, finds_tints);
        }
        check_gradient(Linearisation::Full, SiteKind::Vertex, finds_tints);
    }
}

fn check_gradient(linearisation: Linearisation, kind: SiteKind, finds_tints: bool) {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let mesh = FLAT.mesh(0.004);
    let views = views(&RIPPLED, &mesh, &optics, &poses(0.5));
    let looked_at = shaken(&surface_of(mesh), 1e-4);
    let sites = Sites::new(kind, &looked_at.mesh, &views, ViewSet::MAX);
    let motion = SiteMotion::of(&looked_at, kind, linearisation);
    let surface = shaken(&looked_at, 5e-5);
    let edges = EdgeAdjacency::new(&surface.mesh);
    let patches = patches::cut(&surface.mesh, &surface.directions, 0.02);
    let couplings = Couplings::new(&surface.mesh, &edges, &patches);
    let n_sites = sites.points.len();
    let problem = Problem {
        sites: kind,
        observations: &Observations::new(&sites, &views, motion, None),
        labels: &(0..n_sites)
            .map(|site| (site % 2) as u8)
            .collect::<Vec<_>>(),
        tints: &(0..n_sites)
            .map(|site| 1.0 + 0.1 * (0.1 * site as f64).sin())
            .collect::<Vec<_>>(),
        finds_tints,
        loss: Tukey {
            scale: 2.0,
            cutoff: Tukey::EFFICIENT_CUTOFF,
        },
        priors: PriorWeights {
            anchor: 1e8,
            rest: 1e5,
            smoothness: 1e6,
        },
        patches: &patches,
        edges: &edges,
        jacobian: JacobianMode::Analytic,
    };
    let albedos = [ALBEDO, 0.97 * ALBEDO];
    // Tints are near their best values, at which the energy does not change with them; what they leave to the groups' albedos is the
    // small rest of two large sums: 939 for 1126 was seen.
    let (tolerance, of_groups) = if finds_tints {
        (0.05, 0.2)
    } else {
        (1e-4, 1e-4)
    };
    let tints = problem.evaluate(&surface, &albedos).tints;
    let matrix = problem.linearise(&surface, &albedos, &tints, &couplings);
    let largest = matrix
        .gradient
        .iter()
        .fold(0.0f64, |max, g| max.max(g.abs()));
    for vertex in (0..surface.total_m.len()).step_by(37) {
        let moved = |step: f64| {
            let mut steps = vec![0.0; surface.total_m.len()];
            steps[vertex] = step;
            problem
                .evaluate(&surface.displaced(&steps), &albedos)
                .energy
        };
        let numeric = (moved(1e-8) - moved(-1e-8)) / 2e-8;
        assert!(
            (numeric - matrix.gradient[vertex]).abs() < tolerance * largest,
            "{vertex}: {numeric} for {}",
            matrix.gradient[vertex]
        );
    }
    for group in 0..2 {
        let changed = |by: f64| {
            let mut albedos = albedos;
            albedos[group] *= by.exp();
            problem.evaluate(&surface, &albedos).energy
        };
        let numeric = (changed(1e-6) - changed(-1e-6)) / 2e-6;
        let analytic = matrix.groups[group].gradient;
        assert!(
            (numeric / analytic - 1.0).abs() < of_groups,
            "{numeric} {analytic}"
        );
    }
}

#[test]
fn a_wrong_albedo_is_mended_and_bends_nothing() {
    let solver = SolverParams {
        max_steps: 6,
        min_decrease: 1e-6,
        max_step_m: 1e-3,
    };
    let params = RefineParams {
        edge_length_m: 0.004,
        ..RefineParams::default()
    };
    let start = (FLAT.mesh(params.edge_length_m), 0.93 * ALBEDO);
    let (surface, albedo) = solved(&FLAT, start, &params, &solver);
    assert!((albedo / ALBEDO - 1.0).abs() < 0.01, "{albedo}");
    let farthest = surface
        .total_m
        .iter()
        .fold(0.0, |max: f64, t| max.max(t.abs()));
    assert!(farthest < 5e-5, "{farthest}");
}

#[test]
fn the_true_surface_has_almost_no_residual() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let mesh = RIPPLED.mesh(0.0012);
    let views = views(&RIPPLED, &mesh, &optics, &poses(0.5));
    let sites = Sites::new(SiteKind::Face, &mesh, &views, ViewSet::MAX);
    let albedo = vec![ALBEDO; mesh.faces.len()];
    for error in sites.view_errors(&views, &albedo) {
        assert!(error.n_sites > 3000);
        // Facets of a tenth of a wavelength and the footprint correction of point samples: 1 %.
        assert!(error.rmse < 0.012, "{}", error.rmse);
    }
}

#[test]
fn alignment_brings_a_moved_view_back() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let mesh = RIPPLED.mesh(0.0012);
    let mut views = views(&RIPPLED, &mesh, &optics, &poses(0.4)[1..2]);
    let truth = views[0].camera_from_world;
    let moved = increment(&Vector6::new(0.0, 0.0, 0.0, 0.0012, -0.0009, 0.0));
    views[0].camera_from_world = moved * truth;
    views[0].gain = 1.03;
    let sites = Sites::new(SiteKind::Face, &mesh, &views, ViewSet::MAX);
    let target = AlignmentTarget {
        sites: &sites,
        chosen: &sites.of_view(0),
        stands_for: 1.0,
        albedo: &vec![ALBEDO; mesh.faces.len()],
        centre: Point3::new(0.0, 0.0, 0.6),
        loss: Tukey {
            scale: 10.0,
            cutoff: 9.0,
        },
    };
    let params = AlignmentParams {
        iterations: 10,
        ..AlignmentParams::default()
    };
    align_view(&mut views[0], &target, &params);
    let centre = Point3::new(0.0, 0.0, 0.6);
    let off = (views[0].camera_from_world * centre - truth * centre).norm();
    assert!(off < 1e-4, "{off} m from a start of 1.5 mm");
    assert!(motion_between(&views[0].camera_from_world, &truth).rotation_rad < 2e-3);
    assert!((views[0].gain - 1.0).abs() < 0.01);
}

/// Mean angle between the normals of a mesh and of the true surface away from the border, radians.
fn normal_error(truth: &RippledPlane, mesh: &TriMesh) -> f64 {
    let normals = mesh.vertex_normals();
    let inner = |p: &Point3<f64>| p.x.abs() < 0.03 && p.y.abs() < 0.03;
    let angles: Vec<f64> = mesh
        .vertices
        .iter()
        .zip(&normals)
        .filter(|(p, _)| inner(p))
        .map(|(p, n)| n.angle(&truth.normal(p.x, p.y)))
        .collect();
    angles.iter().sum::<f64>() / angles.len() as f64
}

/// As steep as 32°.
const STEEP: RippledPlane = RippledPlane {
    amplitude_m: 0.0012,
};

/// Refines a plane by images of ripples whose poses are 2 mm off; at most so many turns a round, and believed up to such slow gains.
fn refined_from_flat(
    hidden: &RippledPlane,
    max_turns: usize,
    max_slow_gain: f64,
) -> Result<Refinement, RefineError> {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let poses = poses(0.5);
    let moved = poses.iter().enumerate().map(|(k, pose)| {
        let mut snapshot = hidden.snapshot(&optics, pose);
        let angle = 2.4 * k as f64;
        let off = Translation3::new(0.002 * angle.cos(), 0.002 * angle.sin(), 0.0);
        snapshot.world_from_camera = off * snapshot.world_from_camera;
        snapshot
    });
    let snapshots: Vec<_> = moved.collect();
    let params = RefineParams {
        edge_length_m: 0.0012,
        max_turns,
        // Its images are of points.
        integrate_pixels: false,
        trust: ImageTrust {
            max_slow_gain,
            ..ImageTrust::default()
        },
        ..RefineParams::default()
    };
    let base = FLAT.mesh(0.0015);
    refine(&whole(&base, &snapshots, &optics), &params, |_| true)
}

#[test]
fn steep_ripples_at_wrong_poses_take_many_turns() {
    let flat = normal_error(&STEEP, &FLAT.mesh(0.0015));
    let refined = |hidden: &RippledPlane, max_turns: usize| {
        let allowed = ImageTrust::default().max_slow_gain;
        refined_from_flat(hidden, max_turns, allowed).expect("everything is visible")
    };
    let (once, resting) = (refined(&STEEP, 1), refined(&STEEP, 9));
    // Error of the normals, as a share of the base surface's.
    let [by_one, by_more] = [&once, &resting].map(|of| normal_error(&STEEP, &of.mesh) / flat);
    assert!(
        by_more < 0.5 * by_one,
        "{by_one} by one turn, {by_more} by more"
    );
    // Judged before the last round takes its turns, and better than the base surface by then.
    let held_out = resting.judgement.overall;
    let [before, after] = [&held_out.base, &held_out.refined].map(|of| of.intensity);
    assert!(after < 0.9 * before, "{before} of the base, {after}");
    let [n_steep, n_shallow] = [&resting, &refined(&RIPPLED, 9)].map(|of| of.iterations.len());
    assert!(
        n_steep > n_shallow,
        "{n_steep} steps, {n_shallow} if shallow"
    );
}

#[test]
fn what_would_be_refused_before_it_rests_is_judged_once_more_at_rest() {
    let slow_gain = |refined: &Refinement| refined.judgement.overall.slow_gain;
    let at_first = slow_gain(&refined_from_flat(&STEEP, 9, 1.0).expect("all is allowed"));
    let limit = 0.9 * at_first;
    let rested = refined_from_flat(&STEEP, 9, limit).expect("explained at rest");
    assert!(
        slow_gain(&rested) <= limit,
        "{at_first}, {}",
        slow_gain(&rested)
    );
    let refused = refined_from_flat(&STEEP, 1, limit).err();
    assert!(
        matches!(refused, Some(RefineError::SlowlyContradicted { .. })),
        "{refused:?}"
    );
}

#[test]
fn refinement_finds_ripples_that_the_base_lacks() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0015);
    let snapshots: Vec<_> = poses(0.5)
        .iter()
        .map(|pose| RIPPLED.snapshot(&optics, pose))
        .collect();
    let params = RefineParams {
        edge_length_m: 0.0012,
        ..RefineParams::default()
    };
    let mut energies = Vec::new();
    let refined = refine(&whole(&base, &snapshots, &optics), &params, |iteration| {
        energies.push((iteration.energy_before, iteration.energy_after));
        true
    })
    .expect("everything is visible");
    assert!(
        energies.iter().all(|(before, after)| after < before),
        "the energy never rises"
    );
    let error = |mesh: &TriMesh| normal_error(&RIPPLED, mesh);
    let (before, after) = (error(&base), error(&refined.mesh));
    assert!(
        after < 0.4 * before,
        "mean normal error from {before} to {after} rad"
    );
    assert_eq!(refined.materials.len(), 1);
    let held_out = refined.judgement.overall;
    assert_eq!(refined.judgement.views.len(), 2);
    assert!(held_out.refined.intensity < 0.5 * held_out.base.intensity);
    assert!(held_out.refined.gradient < 0.5 * held_out.base.gradient);
    assert!(
        refined
            .views
            .iter()
            .all(|view| view.rmse_after < 0.5 * view.rmse_before)
    );
}

#[test]
fn what_nobody_sees_is_refused() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.003);
    let mut away = FLAT.snapshot(&optics, &poses(0.0)[0]);
    away.world_from_camera.translation.vector.z = 2.0;
    let result = refine(
        &whole(&base, &[away], &optics),
        &RefineParams::default(),
        |_| true,
    );
    assert_eq!(
        result.err(),
        Some(RefineError::NothingVisible { n_views: 1 })
    );
}

#[test]
fn dark_spots_are_no_other_material() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0015);
    const DARK: f64 = 0.6;
    // One half is dark; on the other, spots of 3 mm, as shade and stray light make them, are as dark every 10 mm.
    let albedo = |x: f64, y: f64| {
        let off = |x: f64| x - 0.01 * (x / 0.01).round();
        let is_spot = x > 0.005 && off(x).hypot(off(y)) < 0.0015;
        if x < 0.0 || is_spot { DARK } else { 1.0 }
    };
    let snapshots: Vec<_> = poses(0.4)
        .iter()
        .map(|pose| {
            let mut snapshot = RIPPLED.snapshot(&optics, pose);
            RippledPlane::paint(&mut snapshot, &optics, albedo);
            snapshot
        })
        .collect();
    let params = RefineParams {
        edge_length_m: 0.0015,
        ..RefineParams::default()
    };
    let refined = refine(&whole(&base, &snapshots, &optics), &params, |_| true).expect("visible");
    let ratios: Vec<f64> = refined
        .materials
        .iter()
        .map(|material| material.albedo / ALBEDO)
        .collect();
    assert_eq!(ratios.len(), 2, "{ratios:?}");
    let vertices = refined.mesh.vertices.iter().zip(&refined.labels);
    let apart_from_border = vertices.filter(|(vertex, _)| vertex.x.abs() > 0.003);
    let (n, n_wrong) = apart_from_border.fold((0, 0), |(n, n_wrong), (vertex, label)| {
        (
            n + 1,
            n_wrong + usize::from((vertex.x < 0.0) != (*label == 0)),
        )
    });
    assert!(n_wrong * 200 < n, "{n_wrong} of {n} have the other's label");
}

/// Paint of four tones that are no two materials: diagonal stripes of 5 mm, crossed by others.
fn print(x: f64, y: f64) -> f64 {
    let stripe = |x: f64| (x / 0.005).rem_euclid(2.0) < 1.0;
    let first = if stripe(x + y) { 0.85 } else { 1.0 };
    first * if stripe(x - y) { 0.85 } else { 1.0 }
}

#[test]
fn print_is_albedo_and_relief_is_found_beneath_it() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0015);
    let printed = |pose| {
        let mut snapshot = RIPPLED.snapshot(&optics, pose);
        RippledPlane::paint(&mut snapshot, &optics, print);
        snapshot
    };
    let snapshots: Vec<_> = poses(0.5).iter().map(printed).collect();
    let params = RefineParams {
        edge_length_m: 0.0015,
        ..RefineParams::default()
    };
    let refined = refine(&whole(&base, &snapshots, &optics), &params, |_| true).expect("visible");
    let error_rad = |mesh: &TriMesh| {
        let normals = mesh.vertex_normals();
        let inner = mesh.vertices.iter().zip(&normals);
        let inner = inner.filter(|(p, _)| p.x.abs() < 0.025 && p.y.abs() < 0.025);
        let angles: Vec<f64> = inner
            .map(|(p, normal)| normal.angle(&RIPPLED.normal(p.x, p.y)))
            .collect();
        angles.iter().sum::<f64>() / angles.len() as f64
    };
    let (before, after) = (error_rad(&base), error_rad(&refined.mesh));
    assert!(after < 0.4 * before, "from {before} to {after} rad");
}
