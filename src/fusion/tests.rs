//! Tracking and fusion against the simulated camera's truth.

use super::{DepthNoise, Fusion, FusionParams, LossReason, TrackingOutcome};
use crate::geometry::{CameraModel, Pose, RayGrid, increment, motion_between};
use counting_allocator::n_of_thread;
use depth_camera::{DepthCamera, Frame, Image, Intrinsics, Sensor};
use nalgebra::Vector6;
use simulated::SimulatedCamera;
use std::time::Duration;

pub(super) fn frames(n_frames: usize) -> (Vec<Frame>, Vec<Pose>, CameraModel) {
    frames_of(SimulatedCamera::kinect2_plaque(60, 3), n_frames)
}

/// The first frames of a camera, where each was taken by the first, and the camera's lens.
pub(super) fn frames_of(
    mut camera: SimulatedCamera,
    n_frames: usize,
) -> (Vec<Frame>, Vec<Pose>, CameraModel) {
    let model = CameraModel::new(camera.info().intrinsics);
    // The simulator's world is its table; ours is the first camera.
    let first_from_table = camera.true_world_from_camera(0).inverse();
    let truth = (0..n_frames)
        .map(|frame| first_from_table * camera.true_world_from_camera(frame))
        .collect();
    let frames = (0..n_frames)
        .map(|_| {
            camera
                .grab(Duration::ZERO)
                .expect("no errors")
                .expect("more than asked for")
        })
        .collect();
    (frames, truth, model)
}

/// Voxels large enough for debug builds.
pub(super) fn small_params() -> FusionParams {
    FusionParams {
        voxel_size_m: 0.004,
        depth_max_m: 1.5,
        // Two frontal views at 0.6 m make a surface of such voxels.
        min_surface_weight: 8.0,
        ..FusionParams::default()
    }
}

pub(super) fn fusion(camera: CameraModel) -> Fusion {
    let noise = DepthNoise::of_sensor(Sensor::Kinect2);
    Fusion::new(camera, noise, small_params())
}

fn fuse(fusion: &mut Fusion, frame: &Frame) -> TrackingOutcome {
    fusion.fuse(
        frame.depth.as_ref().expect("Kinect II"),
        frame.device_time_secs,
    )
}

#[test]
fn a_frame_asks_for_the_memory_that_it_is_kept_in_and_no_other() {
    const N_BEFORE: usize = 16;
    let (seen, _, camera) = frames(1);
    let depth = seen[0].depth.as_ref().expect("Kinect II");
    let n_of_a_frame = |max_memory_mb: usize| -> Vec<u64> {
        let mut params = small_params();
        params.loop_closing.max_memory_mb = max_memory_mb;
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
        pool.expect("a thread").install(|| {
            let mut fusion = Fusion::new(camera, noise, params).by_turns();
            let mut n_of_frame = |frame: usize| {
                let before = n_of_thread();
                let outcome = fusion.fuse(depth, frame as f64 / 30.0);
                assert!(matches!(outcome, TrackingOutcome::Tracked { .. }));
                n_of_thread() - before
            };
            let n_of_frames: Vec<u64> = (0..2 * N_BEFORE).map(&mut n_of_frame).collect();
            n_of_frames[N_BEFORE..].to_vec()
        })
    };
    assert_eq!(n_of_a_frame(0), [0; N_BEFORE], "no frame is kept");
    // The list of frames has room for more than it holds.
    let mut kept = n_of_a_frame(100);
    kept.sort_unstable();
    assert_eq!(kept[N_BEFORE / 2], 1, "{kept:?}");
}

#[test]
fn poses_follow_the_truth_and_do_not_depend_on_threads() {
    let (frames, truth, camera) = frames(6);
    let run = |n_threads: usize| -> Vec<Pose> {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(n_threads)
            .build()
            .expect("threads");
        pool.install(|| {
            let mut fusion = fusion(camera);
            frames
                .iter()
                .map(|frame| match fuse(&mut fusion, frame) {
                    TrackingOutcome::Tracked {
                        world_from_camera, ..
                    } => world_from_camera,
                    other => panic!("frame {}: {other:?}", frame.frame_id),
                })
                .collect()
        })
    };
    let poses = run(1);
    assert_eq!(poses, run(2));
    for (pose, truth) in poses.iter().zip(&truth) {
        let off = motion_between(truth, pose);
        // A voxel; and the angle that moves the plaque's border, 0.12 m from its middle, by a quarter of one: it is nearly flat, and what
        // two noisy frames have fused hardly holds it.
        assert!(off.translation_m < 0.004, "{off:?}");
        assert!(off.rotation_rad < 0.01, "{off:?}");
    }
}

#[test]
fn pixels_without_a_ray_cost_nothing_but_themselves() {
    let (frames, _, camera) = frames(4);
    // A lens that bends inwards so much that no ray reaches the corners; what is measured elsewhere stays near.
    let intrinsics = Intrinsics {
        k1: -0.6,
        k2: 0.0,
        k3: 0.0,
        ..*camera.intrinsics()
    };
    let camera = CameraModel::new(intrinsics);
    let rays = RayGrid::new(camera);
    let has_none = |ray: &&[f32; 2]| ray[0].is_nan();
    let n_none = rays.rays().data().iter().filter(has_none).count();
    assert!(n_none > 100, "{n_none}");
    let mut fusion = fusion(camera);
    for frame in &frames {
        let outcome = fuse(&mut fusion, frame);
        assert!(
            matches!(outcome, TrackingOutcome::Tracked { .. }),
            "frame {}: {outcome:?}",
            frame.frame_id
        );
    }
}

/// A Kinect II's depth: 0.7 m where it shows anything.
fn depth_where(is_there: impl Fn(usize, usize) -> bool) -> Image<f32> {
    let (width, height) = (512, 424);
    let depth_m = |pixel: usize| match is_there(pixel % width, pixel / width) {
        true => 0.7,
        false => 0.0,
    };
    Image::from_vec(width, height, (0..width * height).map(depth_m).collect())
}

/// One pixel in 25, none beside another.
fn specks() -> Image<f32> {
    depth_where(|u, v| u % 5 == 0 && v % 5 == 0)
}

#[test]
fn a_small_object_alone_is_fused_and_specks_are_not_at_given_poses_either() {
    let (_, _, camera) = frames(0);
    // A square of 10 cm, 1.2 % of the pixels.
    let small = depth_where(|u, v| (230..282).contains(&u) && (186..238).contains(&v));
    let here = Pose::identity();
    let is_fused = |outcome: TrackingOutcome| matches!(outcome, TrackingOutcome::Tracked { .. });
    assert!(is_fused(fusion(camera).fuse(&small, 0.0)));
    assert!(is_fused(fusion(camera).fuse_at(&small, 0.0, &here)));
    assert!(is_fused(fusion(camera).fuse_near(&small, 0.0, &here)));
    let mut empty = fusion(camera);
    assert!(empty.sees_depth(&small) && !empty.sees_depth(&specks()));
    let outcome = empty.fuse_at(&specks(), 0.0, &here);
    assert_eq!((outcome, empty.n_fused()), (TrackingOutcome::NoDepth, 0));
}

#[test]
fn a_first_frame_of_specks_is_no_model() {
    let (frames, _, camera) = frames(3);
    let mut fusion = fusion(camera);
    assert_eq!(fusion.fuse(&specks(), 0.0), TrackingOutcome::NoDepth);
    for frame in &frames {
        assert!(matches!(
            fuse(&mut fusion, frame),
            TrackingOutcome::Tracked { .. }
        ));
    }
}

#[test]
fn a_frame_from_elsewhere_is_lost_and_not_fused_and_tracking_resumes() {
    let (frames, _, camera) = frames(22);
    let mut fusion = fusion(camera);
    fuse(&mut fusion, &frames[0]);
    fuse(&mut fusion, &frames[1]);
    // A thirtieth of a second later the camera stands 25° round the object.
    let depth = frames[21].depth.as_ref().expect("Kinect II");
    let outcome = fusion.fuse(depth, frames[2].device_time_secs);
    assert!(matches!(outcome, TrackingOutcome::Lost(_)), "{outcome:?}");
    assert_eq!(fusion.n_fused(), 2);
    assert!(matches!(
        fuse(&mut fusion, &frames[2]),
        TrackingOutcome::Tracked { .. }
    ));
    assert_eq!(fusion.n_fused(), 3);
}

#[test]
fn a_frame_that_fits_in_part_is_fused_unless_it_comes_with_a_jerk() {
    let (frames, _, camera) = frames(12);
    let mut fusion = fusion(camera);
    for frame in &frames[..5] {
        fuse(&mut fusion, frame);
    }
    // Of the pixels with depth the first third shows a hand; behind the last share something was taken away.
    let outcome = |index: usize, taken_away: f32| {
        let mut depth = frames[index].depth.clone().expect("Kinect II");
        let n_there = depth.data().iter().filter(|&&z| z > 0.0).count();
        let pixels = depth.data_mut().iter_mut().filter(|z| **z > 0.0);
        for (n, z) in pixels.enumerate() {
            let share = n as f32 / n_there as f32;
            if share < 0.33 {
                *z -= 0.1;
            } else if share > 1.0 - taken_away {
                *z += 0.1;
            }
        }
        fusion.clone().fuse(&depth, frames[5].device_time_secs)
    };
    for taken_away in [0.0, 0.08] {
        let outcome = outcome(5, taken_away);
        assert!(
            matches!(outcome, TrackingOutcome::Tracked { .. }),
            "{outcome:?}"
        );
    }
    let elsewhere = TrackingOutcome::Lost(LossReason::Elsewhere);
    assert_eq!(outcome(8, 0.0), elsewhere);
}

#[test]
fn a_kidnapped_camera_is_found_by_two_frames() {
    let (frames, truth, camera) = frames(16);
    let noise = DepthNoise::of_sensor(Sensor::Kinect2);
    let params = FusionParams {
        // 2.3° a frame are believed, the 9° of the jump are not.
        max_rotation_rad_per_s: 1.2,
        ..small_params()
    };
    let mut fusion = Fusion::new(camera, noise, params);
    for frame in &frames {
        let outcome = fuse(&mut fusion, frame);
        assert!(
            matches!(outcome, TrackingOutcome::Tracked { .. }),
            "{outcome:?}"
        );
    }
    let start_secs = frames[15].device_time_secs;
    let mut again = |index: usize| {
        let depth = frames[index].depth.as_ref().expect("Kinect II");
        fusion.fuse(depth, start_secs + index as f64 / 30.0)
    };
    let unconfirmed = TrackingOutcome::Lost(LossReason::Unconfirmed);
    assert_eq!(again(1), unconfirmed);
    let TrackingOutcome::Tracked {
        world_from_camera, ..
    } = again(2)
    else {
        panic!("not confirmed");
    };
    let off = motion_between(&truth[2], &world_from_camera);
    assert!(
        off.translation_m < 0.002 && off.rotation_rad < 0.006,
        "{off:?}"
    );
    assert_eq!((fusion.n_relocalised(), fusion.n_fused()), (1, 17));
}

#[test]
fn dropped_frames_and_a_hand_before_the_lens_are_got_over() {
    let (frames, _, camera) = frames(10);
    let mut fusion = fusion(camera);
    for index in [0, 1, 4, 5] {
        let outcome = fuse(&mut fusion, &frames[index]);
        assert!(
            matches!(outcome, TrackingOutcome::Tracked { .. }),
            "{outcome:?}"
        );
    }
    let hand = frames[6].depth.as_ref().expect("Kinect II").map(|_| 0.4);
    let outcome = fusion.fuse(&hand, frames[6].device_time_secs);
    assert!(matches!(outcome, TrackingOutcome::Lost(_)), "{outcome:?}");
    let outcome = fuse(&mut fusion, &frames[8]);
    assert!(
        matches!(outcome, TrackingOutcome::Tracked { .. }),
        "{outcome:?}"
    );
    assert_eq!((fusion.n_fused(), fusion.n_relocalised()), (5, 0));
}

#[test]
fn motion_is_carried_on_over_dropped_frames_by_their_times() {
    let (frames, truth, camera) = frames(26);
    let mut fusion = fusion(camera);
    // A machine that is too slow for three of four frames.
    for index in (0..5).chain((5..26).step_by(4)) {
        let TrackingOutcome::Tracked {
            world_from_camera, ..
        } = fuse(&mut fusion, &frames[index])
        else {
            panic!("frame {index} is lost");
        };
        let off = motion_between(&truth[index], &world_from_camera);
        // From afar alignment ends some voxels short of its aim, which the next frames make up for.
        assert!(
            off.translation_m < 0.01 && off.rotation_rad < 0.04,
            "frame {index}: {off:?}"
        );
    }
}

#[test]
fn what_is_fused_after_a_gap_lies_where_it_was_taken() {
    let (frames, truth, camera) = frames(20);
    let mut before = fusion(camera);
    for frame in &frames[..8] {
        fuse(&mut before, frame);
    }
    let outcomes = (8..20).map(|index| (index, fuse(&mut before.clone(), &frames[index])));
    let mut n_tracked = 0;
    for (index, outcome) in outcomes {
        if let TrackingOutcome::Tracked {
            world_from_camera, ..
        } = outcome
        {
            let off = motion_between(&truth[index], &world_from_camera);
            assert!(
                off.translation_m < 0.04 && off.rotation_rad < 0.06,
                "frame {index}: {off:?}"
            );
            n_tracked += 1;
        }
    }
    assert!(n_tracked >= 4, "{n_tracked} of 12");
}

#[test]
fn a_covered_lens_is_waited_out() {
    let (frames, _, camera) = frames(2);
    let mut fusion = fusion(camera);
    fuse(&mut fusion, &frames[0]);
    let dark = Image::filled(512, 424, 0.0);
    assert_eq!(fusion.fuse(&dark, 0.5), TrackingOutcome::NoDepth);
    assert!(matches!(
        fuse(&mut fusion, &frames[1]),
        TrackingOutcome::Tracked { .. }
    ));
}

#[test]
fn a_bare_plane_does_not_hold_the_camera() {
    let (_, _, camera) = frames(0);
    let mut fusion = fusion(camera);
    let wall = Image::filled(512, 424, 0.8f32);
    fusion.fuse(&wall, 0.0);
    let outcome = fusion.fuse(&wall, 1.0 / 30.0);
    assert!(
        matches!(outcome, TrackingOutcome::Lost(LossReason::FlatScene { .. })),
        "{outcome:?}"
    );
}

#[test]
fn given_poses_are_taken_as_they_are() {
    let (frames, truth, camera) = frames(2);
    let mut fusion = fusion(camera);
    for (frame, pose) in frames.iter().zip(&truth) {
        let depth = frame.depth.as_ref().expect("Kinect II");
        let outcome = fusion.fuse_at(depth, frame.device_time_secs, pose);
        assert_eq!(
            outcome,
            TrackingOutcome::Tracked {
                world_from_camera: *pose,
                fit: None
            }
        );
    }
    assert!(
        fusion.mesh().faces.is_empty(),
        "two frames are too few for a surface of weight 2"
    );
}

#[test]
fn beyond_the_memory_budget_frames_are_tracked_and_the_refusal_is_told() {
    let (frames, _, camera) = frames(4);
    let params = FusionParams {
        voxel_size_m: 0.001,
        memory_budget_mb: 96,
        ..FusionParams::default()
    };
    let mut fusion = Fusion::new(camera, DepthNoise::of_sensor(Sensor::Kinect2), params);
    let table_bytes = fusion.memory_bytes();
    for frame in &frames {
        let outcome = fuse(&mut fusion, frame);
        assert!(
            matches!(outcome, TrackingOutcome::Tracked { .. }),
            "{outcome:?}"
        );
    }
    assert!(fusion.memory_bytes() - table_bytes <= 32 << 20);
    let refusal = fusion.refusal().expect("1 mm voxels do not fit");
    let told = "its 32 MiB of fusion.memory_budget_mb, 96";
    assert!(refusal.contains(told), "{refusal}");
}

#[test]
fn a_scene_beyond_the_volume_is_told_of() {
    let (frames, truth, camera) = frames(1);
    let mut fusion = fusion(camera);
    let depth = frames[0].depth.as_ref().expect("Kinect II");
    fusion.fuse_at(depth, 0.0, &truth[0]);
    assert_eq!(fusion.refusal(), None);
    // The volume reaches 512 blocks of 32 mm from the first camera.
    let far = Pose::translation(20.0, 0.0, 0.0);
    fusion.fuse_at(depth, 0.1, &far);
    let refusal = fusion.refusal().expect("20 m away");
    assert!(refusal.contains("beyond the volume's border"), "{refusal}");
}

#[test]
fn a_view_settles_on_the_finished_model() {
    let (frames, _, camera) = frames(10);
    let mut fusion = fusion(camera);
    let tracked: Vec<Pose> = frames
        .iter()
        .map(|frame| match fuse(&mut fusion, frame) {
            TrackingOutcome::Tracked {
                world_from_camera, ..
            } => world_from_camera,
            other => panic!("{other:?}"),
        })
        .collect();
    let depth = frames[6].depth.as_ref().expect("Kinect II");
    let astray = Vector6::new(0.003, -0.002, 0.004, 0.002, 0.001, -0.003);
    let settled = fusion.settle(depth, &(increment(&astray) * tracked[6]));
    let motion = motion_between(&tracked[6], &settled.expect("near"));
    assert!(motion.translation_m < 0.0008, "{motion:?}");
    assert!(motion.rotation_rad < 0.002, "{motion:?}");
    // Tracking does not err by 5 cm: a view so far off is not led about.
    let far = increment(&Vector6::new(0.0, 0.0, 0.0, 0.05, 0.0, 0.0)) * tracked[6];
    let led = fusion.settle(depth, &far);
    assert!(led.is_none_or(|pose| motion_between(&far, &pose).translation_m < 0.01));
}

#[test]
fn fitness_falls_before_the_camera_is_lost() {
    let (frames, _, camera) = frames(6);
    let mut before = fusion(camera);
    for frame in &frames[..5] {
        fuse(&mut before, frame);
    }
    let depth = frames[5].depth.as_ref().expect("Kinect II");
    // A hand before the lens that covers more and more of the image.
    let fitness_behind = |covered_share: f64| {
        let mut covered = depth.clone();
        let n_columns = (covered_share * depth.width() as f64) as usize;
        for row in covered.data_mut().chunks_mut(depth.width()) {
            row[..n_columns].fill(0.4);
        }
        match before.clone().fuse(&covered, frames[5].device_time_secs) {
            TrackingOutcome::Tracked { fit, .. } => fit.map(|fit| fit.fitness),
            TrackingOutcome::Lost(_) | TrackingOutcome::NoDepth => None,
        }
    };
    let fitness: Vec<Option<f64>> = (0..20)
        .map(|n| fitness_behind(0.05 * f64::from(n)))
        .collect();
    let n_tracked = fitness
        .iter()
        .take_while(|fitness| fitness.is_some())
        .count();
    let tracked: Vec<f64> = fitness[..n_tracked].iter().copied().flatten().collect();
    assert!((5..20).contains(&n_tracked), "{fitness:?}");
    assert_eq!(tracked[0], 1.0);
    assert!(tracked[n_tracked - 1] < 0.4, "{fitness:?}");
    // Two steps, a tenth of the image, before the loss it is plain to see.
    assert!(tracked[n_tracked - 2] < 0.6, "{fitness:?}");
    assert!(tracked.is_sorted_by(|a, b| *b <= a + 0.02), "{fitness:?}");
}
