//! Bad input: each kind is refused with its figure, or leaves the base surface alone.

use super::error::MAX_BELIEVABLE_RMSE;
use super::held_out::{HeldOut, ImageError, Judgement};
use super::scenes::{
    FULL_SCALE, RippledPlane, calibration, optics, poses, poses_all_round, rays, whole,
};
use super::sites::SiteKind;
use super::surface::unit_normal;
use super::{
    ImageTrust, MAX_MISFIT, MAX_VIEWS, Optics, RefineError, RefineParams, Refinement,
    cross_validate, refine, slow_gain_limit,
};
use crate::geometry::{Pose, TriMesh};
use crate::shading::{Calibration, Gloss};
use crate::snapshot::ShadingSnapshot;
use depth_camera::Image;
use nalgebra::{Point3, Vector3};

const RIPPLED: RippledPlane = RippledPlane {
    amplitude_m: 0.0003,
};
const FLAT: RippledPlane = RippledPlane { amplitude_m: 0.0 };

/// Parameters of a coarse mesh, which is fast.
fn coarse() -> RefineParams {
    RefineParams {
        edge_length_m: 0.0025,
        ..RefineParams::default()
    }
}

/// Refines an object from images of the rippled plane that were changed.
fn refine_from(
    object: &TriMesh,
    change: impl Fn(usize, &mut ShadingSnapshot),
) -> Result<Refinement, RefineError> {
    refine_with(object, &coarse(), change)
}

fn refine_with(
    object: &TriMesh,
    params: &RefineParams,
    change: impl Fn(usize, &mut ShadingSnapshot),
) -> Result<Refinement, RefineError> {
    let (rays, calibration) = (rays(), calibration());
    refine_lit(object, params, &optics(&rays, &calibration), change)
}

fn refine_lit(
    object: &TriMesh,
    params: &RefineParams,
    optics: &Optics,
    change: impl Fn(usize, &mut ShadingSnapshot),
) -> Result<Refinement, RefineError> {
    let mut snapshots: Vec<_> = poses(0.5)
        .iter()
        .map(|pose| RIPPLED.snapshot(optics, pose))
        .collect();
    for (k, snapshot) in snapshots.iter_mut().enumerate() {
        change(k, snapshot);
    }
    refine(&whole(object, &snapshots, optics), params, |_| true)
}

#[test]
fn a_surface_that_images_held_out_contradict_is_not_delivered() {
    // The views that are learnt from show ripples, those held out (1 and 5) show the flat base.
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let flat: Vec<_> = poses(0.5)
        .iter()
        .map(|pose| FLAT.snapshot(&optics, pose))
        .collect();
    let result = refine_from(&FLAT.mesh(0.0025), |k, snapshot| {
        if k % 4 == 1 {
            *snapshot = flat[k].clone();
        }
    });
    let Err(RefineError::WorseThanBase(held_out)) = result else {
        panic!("delivered");
    };
    assert!(held_out.refined.gradient > held_out.base.gradient);
    let text = RefineError::WorseThanBase(held_out).to_string();
    assert!(text.contains("% of the mean intensity"), "{text}");
}

#[test]
fn views_that_look_elsewhere_do_not_judge() {
    let away = Pose::rotation(Vector3::y() * std::f64::consts::PI);
    // Those that would judge if all looked.
    let result = refine_from(&FLAT.mesh(0.0025), |k, snapshot| {
        if k % 4 == 1 {
            snapshot.world_from_camera *= away;
        }
    });
    let judgement = result.expect("delivered").judgement;
    let judges: Vec<usize> = judgement.views.iter().map(|(view, _)| *view).collect();
    assert_eq!(judges, [2]);
    assert_eq!(judgement.n_comparing(), 1);
}

#[test]
fn views_that_see_nothing_of_what_was_learnt_judge_what_they_see() {
    // Views 1 and 5 judge. They see one side of the surface, the others the other; the rest is black.
    let result = refine_from(&FLAT.mesh(0.0025), |k, snapshot| {
        let is_black = |u: usize| match k % 4 {
            1 => u < 120,
            _ => u > 80,
        };
        let width = snapshot.ir_counts.width();
        let counts = snapshot.ir_counts.data_mut().iter_mut();
        let black = counts
            .enumerate()
            .filter(|(pixel, _)| is_black(pixel % width));
        black.for_each(|(_, counts)| *counts = 0.0);
    });
    let compared = match result {
        Ok(refinement) => refinement.judgement.overall,
        Err(RefineError::WorseThanBase(held_out)) => held_out,
        Err(error) => panic!("{error}"),
    };
    assert!(compared.n_pixels > 0);
}

#[test]
fn views_that_see_nothing_are_not_the_only_ones_that_judge_or_are_learnt_from() {
    let judges_where_these_see = |seeing: &[usize]| {
        let result = refine_from(&FLAT.mesh(0.0025), |k, snapshot| {
            if !seeing.contains(&k) {
                snapshot.ir_counts.data_mut().fill(65535.0);
            }
        });
        let judgement = result.expect("delivered").judgement;
        assert_eq!(judgement.n_comparing(), judgement.views.len());
        let judges = judgement.views.iter().map(|(view, _)| *view);
        judges.collect::<Vec<usize>>()
    };
    // All look at the surface, and 1 and 5 would judge.
    assert_eq!(judges_where_these_see(&[0, 2, 3, 4, 6]), [2]);
    assert_eq!(judges_where_these_see(&[1, 5]), [5]);
    assert!(judges_where_these_see(&[4]).is_empty());
}

#[test]
fn edges_are_as_long_as_the_views_that_look_at_the_object_want_them() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0025);
    let mut snapshots: Vec<_> = poses(0.5)
        .iter()
        .map(|pose| FLAT.snapshot(&optics, pose))
        .collect();
    let footprint_m = |snapshots: &[ShadingSnapshot]| {
        let subject = whole(&base, snapshots, &optics);
        (subject.footprint_m(), subject.images_of_it().len())
    };
    let (of_all_m, n_all) = footprint_m(&snapshots);
    // Most stand 3 m farther back and to the side, where the object is not in the image.
    for snapshot in &mut snapshots[..4] {
        snapshot.world_from_camera *= Pose::translation(8.0, 0.0, -3.0);
    }
    let (of_looking_m, n_looking) = footprint_m(&snapshots);
    assert_eq!((n_all, n_looking), (7, 3));
    assert!(
        (of_looking_m / of_all_m - 1.0).abs() < 0.2,
        "{of_looking_m} m"
    );
    assert_eq!(footprint_m(&[]), (0.0, 0));
}

/// Lights a room in a snapshot of the plane, from one side of the image; half as bright there as the lamp makes the plane.
fn light_the_room(snapshot: &mut ShadingSnapshot, is_measured: bool) {
    let gamma = calibration().gamma;
    let linear = |counts: f32| (f64::from(counts) / FULL_SCALE).powf(1.0 / gamma);
    let counts = |linear: f64| (FULL_SCALE * linear.powf(gamma)) as f32;
    let (width, height) = (snapshot.ir_counts.width(), snapshot.ir_counts.height());
    let brightest = snapshot
        .ir_counts
        .data()
        .iter()
        .copied()
        .fold(0.0, f32::max);
    let room = |u: usize| 0.5 * linear(brightest) * u as f64 / width as f64;
    for (pixel, lit) in snapshot.ir_counts.data_mut().iter_mut().enumerate() {
        *lit = counts(linear(*lit) + room(pixel % width));
    }
    let unlit = (0..width * height).map(|pixel| counts(room(pixel % width)));
    snapshot.unlit_counts = is_measured.then(|| Image::from_vec(width, height, unlit.collect()));
}

#[test]
fn light_of_the_room_does_not_bend_the_surface_where_it_was_measured() {
    let base = FLAT.mesh(0.0025);
    // Counts are rounded otherwise, which moves a surface solved at vertices by 8 µm at most.
    for (sites, tolerance_m) in [(SiteKind::Face, 1e-6), (SiteKind::Vertex, 2e-5)] {
        let params = RefineParams { sites, ..coarse() };
        let lit = |is_measured: bool| {
            let light = |_, snapshot: &mut ShadingSnapshot| light_the_room(snapshot, is_measured);
            refine_with(&base, &params, light)
        };
        let dark = refine_with(&base, &params, |_, _| ()).expect("delivered");
        let farthest = |refinement: &Refinement| {
            let pairs = dark.mesh.vertices.iter().zip(&refinement.mesh.vertices);
            pairs.fold(0.0f64, |far, (a, b)| far.max((a - b).norm()))
        };
        let measured = lit(true).expect("delivered");
        assert!(
            farthest(&measured) < tolerance_m,
            "{} m",
            farthest(&measured)
        );
        match lit(false) {
            Ok(bent) => assert!(farthest(&bent) > 5e-5, "{} m", farthest(&bent)),
            Err(error) => assert!(
                matches!(error, RefineError::SlowlyContradicted { .. }),
                "{error}"
            ),
        }
    }
}

#[test]
fn images_that_the_light_cannot_explain_leave_the_base() {
    // Stripes of 2 mm and a contrast of 1 to 12, with another phase in every view.
    let result = refine_from(&FLAT.mesh(0.0025), |k, snapshot| {
        let width = snapshot.ir_counts.width();
        for (pixel, counts) in snapshot.ir_counts.data_mut().iter_mut().enumerate() {
            let stripe = (pixel % width + 3 * (pixel / width) + 7 * k) / 5 % 2;
            *counts *= if stripe == 0 { 0.08 } else { 1.0 };
        }
    });
    match result {
        Err(RefineError::Contradicted { rmse }) => assert!(rmse > MAX_BELIEVABLE_RMSE),
        Err(RefineError::WorseThanBase(held_out)) => {
            assert!(held_out.refined.intensity > MAX_BELIEVABLE_RMSE);
        }
        other => panic!("{:?}", other.map(|refined| refined.rmse_after)),
    }
}

#[test]
fn saturated_views_are_refused_and_counted() {
    let result = refine_from(&FLAT.mesh(0.0025), |_, snapshot| {
        snapshot.ir_counts.data_mut().fill(65535.0);
    });
    let expected = RefineError::Saturated {
        n_saturated: 7,
        n_views: 7,
    };
    assert_eq!(result.err(), Some(expected));
}

#[test]
fn slow_differences_of_brightness_are_measured_and_bounded() {
    let allowed = |max_slow_gain: f64| RefineParams {
        trust: ImageTrust {
            max_slow_gain,
            ..ImageTrust::default()
        },
        ..coarse()
    };
    let base = FLAT.mesh(0.0025);
    let delivered = refine_with(&base, &allowed(0.04), |_, _| ()).expect("the light is right");
    let measured = delivered.judgement.overall.slow_gain;
    assert!(measured > 0.0 && measured < 0.04);
    let limit = 0.5 * measured;
    let Err(error) = refine_with(&base, &allowed(limit), |_, _| ()) else {
        panic!("delivered");
    };
    let text = error.to_string();
    let RefineError::SlowlyContradicted {
        slow_gain,
        limit: bound,
    } = error
    else {
        panic!("{text}");
    };
    assert!(slow_gain > bound, "{slow_gain} at rest");
    // The plane sends itself no light but for what noise makes of it.
    assert!(bound >= limit && bound < 1.1 * limit, "{bound}");
    assert!(text.contains("gamma or light is wrong"), "{text}");
}

#[test]
fn a_lamp_may_be_as_bright_as_it_likes_in_each_image_and_an_emitter_may_not() {
    let (rays, calibration) = (rays(), calibration());
    let emitter = optics(&rays, &calibration);
    let lamp = Optics {
        is_steady: false,
        ..optics(&rays, &calibration)
    };
    let refined = |optics: &Optics| {
        refine_lit(&FLAT.mesh(0.0025), &coarse(), optics, |k, snapshot| {
            let brightness = if k % 2 == 0 { 1.05 } else { 0.95 };
            let counts = snapshot.ir_counts.data_mut();
            counts.iter_mut().for_each(|count| *count *= brightness);
        })
    };
    let is_refused = |result: &Result<Refinement, RefineError>| {
        matches!(result, Err(RefineError::SlowlyContradicted { .. }))
    };
    assert!(is_refused(&refined(&emitter)));
    let delivered = refined(&lamp).expect("the light is right");
    let HeldOut {
        slow_gain,
        base,
        refined,
        ..
    } = delivered.judgement.overall;
    assert!(slow_gain < 0.01, "{slow_gain}");
    assert!(refined.gradient < 0.7 * base.gradient);
    // Brighter towards one side of one image and the other of the next it is seen to be.
    let slanted = refine_lit(&FLAT.mesh(0.0025), &coarse(), &lamp, |k, snapshot| {
        let slant = if k % 2 == 0 { 0.6 } else { -0.6 };
        let width = snapshot.ir_counts.width();
        let counts = snapshot.ir_counts.data_mut().iter_mut().enumerate();
        counts.for_each(|(pixel, count)| {
            *count *= 1.0 + slant * ((pixel % width) as f32 / width as f32 - 0.5);
        });
    });
    let slanted = slanted.map(|refined| refined.judgement.overall.slow_gain);
    assert!(
        slanted
            .as_ref()
            .is_ok_and(|within| *within > 2.0 * slow_gain),
        "{slanted:?}, without {slow_gain}"
    );
}

#[test]
fn more_is_believed_where_much_light_comes_over_other_surfaces() {
    let trust = ImageTrust::default();
    assert_eq!(slow_gain_limit(&trust, 0.0), trust.max_slow_gain);
    let on_table = slow_gain_limit(&trust, 0.05);
    assert!(on_table < 1.1 * trust.max_slow_gain, "{on_table}");
    let in_bowl = slow_gain_limit(&trust, 0.2);
    assert!((0.05..0.07).contains(&in_bowl), "{in_bowl}");
}

/// Refines by images from all round; `is_asked` whether they are asked for response and gloss.
fn refine_all_round(
    base: &TriMesh,
    snapshots: &[ShadingSnapshot],
    optics: &Optics,
    is_asked: bool,
) -> Result<Refinement, RefineError> {
    let mut params = RefineParams {
        edge_length_m: 0.0015,
        ..RefineParams::default()
    };
    params.self_calibration.enabled = is_asked;
    let subject = whole(base, snapshots, optics);
    refine(&subject, &params, |_| true)
}

const GLOSS: Gloss = Gloss {
    strength: 0.5,
    power: 20.0,
};

#[test]
fn one_of_two_materials_is_glossy() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0025);
    for is_glossy in [[true, false], [false, true]] {
        let snapshots = poses_all_round();
        let snapshots = snapshots.iter().map(|pose| {
            let mut snapshot = RIPPLED.snapshot(&optics, pose);
            let mut glossy = snapshot.clone();
            RIPPLED.polish(&mut glossy, GLOSS, &optics);
            let places = rays.rays().data().iter().zip(snapshot.depth_m.data());
            let pixels = snapshot.ir_counts.data_mut().iter_mut();
            let pixels = pixels.zip(glossy.ir_counts.data()).zip(places);
            for ((counts, polished), ([x, y], depth)) in pixels {
                let place = pose * (Point3::new(*x, *y, 1.0) * *depth).cast::<f64>();
                let is_bright = place.x > 0.0;
                if is_glossy[usize::from(is_bright)] {
                    *counts = *polished;
                }
                if !is_bright {
                    *counts *= 0.5f64.powf(calibration.gamma) as f32;
                }
            }
            snapshot
        });
        let snapshots: Vec<_> = snapshots.collect();
        let refined = refine_all_round(&base, &snapshots, &optics, true).expect("is told");
        assert_eq!(refined.materials.len(), 2, "{:?}", refined.materials);
        for (material, is_glossy) in refined.materials.iter().zip(is_glossy) {
            let told = material.gloss;
            match is_glossy {
                true => assert!((told.strength - GLOSS.strength).abs() < 0.2, "{told:?}"),
                false => assert!(told.is_matte(), "{told:?}"),
            }
        }
    }
}

#[test]
fn one_label_for_two_materials_leaves_the_base() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0025);
    let of_at_most = |max_albedos: usize, darker: f64| {
        let params = RefineParams {
            max_albedos,
            ..coarse()
        };
        refine_lit(&base, &params, &optics, |_, snapshot| {
            RippledPlane::paint(snapshot, &optics, |x, _| if x > 0.0 { 1.0 } else { darker });
        })
    };
    let Err(error) = of_at_most(1, 0.5) else {
        panic!("delivered");
    };
    let RefineError::OneLabel(told) = error else {
        panic!("{error}");
    };
    assert!((told.contrast - 2.0).abs() < 0.1, "{told:?}");
    assert!((told.rarer_share - 0.5).abs() < 0.05, "{told:?}");
    let text = error.to_string();
    assert!(text.contains("refine.max_albedos"), "{text}");
    let both = of_at_most(2, 0.5).expect("they are told apart");
    assert_eq!(both.materials.len(), 2);
    assert!(matches!(
        of_at_most(1, 0.6),
        Err(RefineError::OneLabel { .. })
    ));
    for darker in [0.75, 1.0] {
        let one = of_at_most(1, darker).expect("tints take up the rest");
        assert_eq!(one.materials.len(), 1);
    }
}

#[test]
fn images_that_lie_elsewhere_than_depth_disagree_with_the_light() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0025);
    let refined_with = |beside_px: usize| {
        let snapshots = poses_all_round();
        let snapshots = snapshots.iter().map(|pose| {
            let mut snapshot = RIPPLED.snapshot(&optics, pose);
            let places = rays.rays().data().iter().zip(snapshot.depth_m.data());
            for (counts, ([x, y], depth)) in snapshot.ir_counts.data_mut().iter_mut().zip(places) {
                let place = pose * (Point3::new(*x, *y, 1.0) * *depth).cast::<f64>();
                // A chessboard with fields of 2 cm.
                let [column, row] = [place.x, place.y].map(|m| (m / 0.02).floor() as i64);
                if (column + row) % 2 == 0 {
                    *counts *= 0.5f64.powf(calibration.gamma) as f32;
                }
            }
            snapshot.ir_counts.data_mut().rotate_right(beside_px);
            snapshot
        });
        refine_all_round(&base, &snapshots.collect::<Vec<_>>(), &optics, true)
    };
    let misfit = |beside_px: usize| refined_with(beside_px).expect("is told").misfit;
    let [in_place, beside] = [0, 8].map(misfit);
    assert!(
        in_place < MAX_MISFIT && beside > MAX_MISFIT,
        "{in_place} {beside}"
    );
}

#[test]
fn gloss_does_not_bend_the_surface() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0025);
    let snapshots = poses_all_round();
    let snapshots = snapshots.iter().map(|pose| {
        let mut snapshot = RIPPLED.snapshot(&optics, pose);
        RIPPLED.polish(&mut snapshot, GLOSS, &optics);
        snapshot
    });
    let snapshots: Vec<_> = snapshots.collect();
    let refined = |is_asked| refine_all_round(&base, &snapshots, &optics, is_asked);
    let normal_error = |mesh: &TriMesh| {
        let angles = (0..mesh.faces.len()).filter_map(|face| {
            let centre = mesh.centroid(face);
            let is_inside = centre.x.abs() < 0.03 && centre.y.abs() < 0.03;
            let (normal, _) = unit_normal(mesh, face).filter(|_| is_inside)?;
            Some(normal.angle(&RIPPLED.normal(centre.x, centre.y)))
        });
        let angles: Vec<f64> = angles.collect();
        angles.iter().sum::<f64>() / angles.len() as f64
    };
    let glossy = refined(true).expect("gloss is told");
    let told = glossy.materials[0].gloss;
    assert!((told.strength - GLOSS.strength).abs() < 0.2, "{told:?}");
    let (error, of_base) = (normal_error(&glossy.mesh), normal_error(&base));
    assert!(error < 0.5 * of_base, "{error} of {of_base} rad");
    match refined(false) {
        Ok(matte) => {
            assert_eq!(matte.materials[0].gloss, Gloss::default());
            let believed_matte = normal_error(&matte.mesh);
            assert!(
                error < 0.8 * believed_matte,
                "{error}, {believed_matte} rad"
            );
        }
        Err(told) => assert!(
            matches!(told, RefineError::SlowlyContradicted { .. }),
            "{told}"
        ),
    }
}

#[test]
fn a_surface_is_refined_by_what_the_images_say_of_the_response() {
    let (rays, truth) = (rays(), calibration());
    let true_optics = optics(&rays, &truth);
    let base = FLAT.mesh(0.0025);
    let rendered = poses_all_round();
    let snapshots: Vec<_> = rendered
        .iter()
        .map(|pose| RIPPLED.snapshot(&true_optics, pose))
        .collect();
    let wrong = Calibration {
        gamma: 1.3,
        ..truth.clone()
    };
    let refined = |believed: &Calibration, is_asked: bool| {
        refine_all_round(&base, &snapshots, &true_optics.with(believed), is_asked)
    };
    let held = |refined: &Refinement| refined.judgement.overall.refined.intensity;
    let right = refined(&truth, true).expect("the light is right");
    assert_eq!(right.contradiction, None);
    let found = refined(&wrong, true).expect("the images tell gamma");
    let told = found.contradiction.as_ref().expect("gamma is wrong");
    assert!((told.calibration.gamma / truth.gamma - 1.0).abs() < 0.03);
    assert!(held(&found) < 1.2 * held(&right));
    if let Ok(bent) = refined(&wrong, false) {
        assert_eq!(bent.contradiction, None);
        assert!(held(&bent) > 1.5 * held(&found));
    }
}

#[test]
fn more_views_than_can_be_used_are_refused() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0025);
    let snapshots = vec![FLAT.snapshot(&optics, &poses(0.0)[0]); MAX_VIEWS + 1];
    let subject = whole(&base, &snapshots, &optics);
    let result = refine(&subject, &RefineParams::default(), |_| true);
    assert_eq!(
        result.err(),
        Some(RefineError::TooManyViews {
            n_views: MAX_VIEWS + 1
        })
    );
}

#[test]
fn no_surface_is_refused() {
    let result = refine_from(&TriMesh::default(), |_, _| ());
    assert_eq!(result.err(), Some(RefineError::NoSurface));
}

#[test]
fn parts_that_do_not_touch_are_refined_alike() {
    let whole = FLAT.mesh(0.0025);
    let parts = whole.filter_faces(|face| whole.centroid(face).x.abs() > 0.004);
    assert_eq!(parts.face_components().1, 2);
    let refined = refine_from(&parts, |_, _| ()).expect("both are visible");
    assert_eq!(refined.mesh.face_components().1, 2);
    let normals = refined.mesh.vertex_normals();
    for side in [-1.0, 1.0] {
        let pairs = refined.mesh.vertices.iter().zip(&normals);
        let inner = pairs.filter(|(p, _)| (side * p.x - 0.018).abs() < 0.01 && p.y.abs() < 0.03);
        let (mut before, mut after) = (0.0, 0.0);
        for (p, normal) in inner {
            before += RIPPLED.normal(p.x, p.y).angle(&-Vector3::z());
            after += RIPPLED.normal(p.x, p.y).angle(normal);
        }
        assert!(after < 0.75 * before, "{before} to {after}");
    }
}

#[test]
fn a_mesh_that_is_no_surface_is_refused() {
    let mut fan = FLAT.mesh(0.0025);
    // Every face once more, turned over: all inner edges have four faces.
    let doubled: Vec<[u32; 3]> = fan.faces.iter().map(|&[a, b, c]| [a, c, b]).collect();
    fan.faces.extend(doubled);
    let result = refine_from(&fan, |_, _| ());
    assert!(matches!(result, Err(RefineError::NotManifold { n_edges, of }) if 2 * n_edges > of));
}

#[test]
fn a_part_that_nobody_sees_stays_where_it_is() {
    let mut parts = FLAT.mesh(0.0025);
    let n_front = parts.vertices.len();
    // The same plane once more behind the first, where only its front could be seen.
    let behind = FLAT.mesh(0.0025);
    let offset = Vector3::new(0.0, 0.0, 0.05);
    parts
        .vertices
        .extend(behind.vertices.iter().map(|vertex| vertex + offset));
    let shift = |face: &[u32; 3]| face.map(|vertex| vertex + n_front as u32);
    parts.faces.extend(behind.faces.iter().map(shift));
    let refined = refine_from(&parts, |_, _| ()).expect("the front is visible");
    let (mut n_hidden, mut moved_m) = (0, 0.0f64);
    for vertex in &refined.mesh.vertices {
        if vertex.z > 0.63 {
            n_hidden += 1;
            moved_m = moved_m.max((vertex.z - 0.65).abs());
        }
    }
    assert!(n_hidden > 1000);
    assert!(moved_m < 1e-6, "{moved_m} m");
}

#[test]
fn one_view_is_refined_from_and_judged_by_nobody() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0025);
    let snapshots = [RIPPLED.snapshot(&optics, &poses(0.4)[1])];
    let subject = whole(&base, &snapshots, &optics);
    let refined = refine(&subject, &RefineParams::default(), |_| true).expect("visible");
    assert_eq!(refined.judgement, Judgement::default());
    assert!(refined.rmse_after < refined.rmse_before);
}

#[test]
fn every_view_is_left_out_once() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0025);
    let snapshots: Vec<_> = poses(0.5)
        .iter()
        .map(|pose| RIPPLED.snapshot(&optics, pose))
        .collect();
    let subject = whole(&base, &snapshots, &optics);
    let params = RefineParams {
        edge_length_m: 0.0025,
        n_rounds: 2,
        ..RefineParams::default()
    };
    let judged = cross_validate(&subject, &params, 3, |_| true).expect("visible");
    let views: Vec<usize> = judged.iter().map(|view| view.index).collect();
    assert_eq!(views, [0, 1, 2, 3, 4, 5, 6]);
    for view in &judged {
        let HeldOut { base, refined, .. } = view.figures();
        assert!(refined.intensity < base.intensity && refined.gradient < base.gradient);
    }
}

#[test]
fn views_that_alone_see_the_surface_are_not_judged_by_and_the_others_are() {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(0.0025);
    let mut snapshots: Vec<_> = poses(0.5)[..3]
        .iter()
        .map(|pose| RIPPLED.snapshot(&optics, pose))
        .collect();
    for snapshot in &mut snapshots[1..] {
        snapshot.ir_counts.data_mut().fill(65535.0);
    }
    let judged_of = |snapshots: &[ShadingSnapshot]| {
        let subject = whole(&base, snapshots, &optics);
        let params = RefineParams {
            n_rounds: 1,
            ..coarse()
        };
        let judged = cross_validate(&subject, &params, 3, |_| true);
        judged.map(|judged| judged.iter().map(|view| view.index).collect::<Vec<_>>())
    };
    assert_eq!(judged_of(&snapshots), Ok(vec![1, 2]));
    snapshots[0].ir_counts.data_mut().fill(65535.0);
    assert!(matches!(
        judged_of(&snapshots),
        Err(RefineError::Saturated { .. })
    ));
}

#[test]
fn a_surface_must_not_be_worse_in_either_measure() {
    let error = |intensity, gradient| ImageError {
        intensity,
        gradient,
    };
    let judgement = |refined| Judgement {
        views: Vec::new(),
        overall: HeldOut {
            base: error(0.1, 0.05),
            refined,
            ..HeldOut::default()
        },
    };
    assert!(!judgement(error(0.09, 0.04)).prefers_base());
    assert!(judgement(error(0.09, 0.06)).prefers_base());
    assert!(judgement(error(0.11, 0.04)).prefers_base());
    assert!(judgement(error(f64::NAN, 0.04)).prefers_base());
    assert!(judgement(error(0.09, f64::NAN)).prefers_base());
}
