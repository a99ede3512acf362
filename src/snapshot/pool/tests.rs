//! Choosing among views of leaning planes.

use super::*;
use crate::snapshot::information::{Optics, view_information};
use crate::snapshot::scenes::{self, Plane};
use depth_camera::Sensor;

/// A view from the origin of a plane that leans by 35° towards `azimuth_rad`.
fn candidate(frame_id: u64, azimuth_rad: f64) -> (ShadingSnapshot, ViewInformation) {
    let plane = Plane::tilted(35.0_f64.to_radians(), azimuth_rad);
    let optics = Optics::new(&scenes::camera_info(Sensor::Kinect2)).unwrap();
    let (mut snapshot, model) = scenes::view_of_plane(&plane, &nalgebra::Isometry3::identity());
    snapshot.frame_id = frame_id;
    snapshot.device_time_secs = frame_id as f64;
    let view = view_information(&snapshot, &model, &optics);
    (snapshot, view)
}

fn ids(snapshots: &[ShadingSnapshot]) -> Vec<u64> {
    snapshots.iter().map(|s| s.frame_id).collect()
}

#[test]
fn a_new_tilt_is_chosen_before_a_repeated_one() {
    let mut pool = Pool::new(8);
    for (frame_id, azimuth) in [(0, 0.0), (1, 0.0), (2, 0.0), (3, 1.6)] {
        let (snapshot, view) = candidate(frame_id, azimuth);
        assert_eq!(pool.offer(snapshot, &view), None);
    }
    let (chosen, rejected) = pool.choose(2, 0.0);
    assert!(ids(&chosen).contains(&3));
    assert_eq!(chosen.len() + rejected.len(), 4);
}

#[test]
fn a_full_pool_puts_out_the_latest_of_equals() {
    let mut pool = Pool::new(3);
    let mut evicted = Vec::new();
    for (frame_id, azimuth) in [(0, 0.0), (1, 1.6), (2, 0.0), (3, 0.0), (4, 3.1)] {
        let (snapshot, view) = candidate(frame_id, azimuth);
        evicted.extend(pool.offer(snapshot, &view).map(|r| r.frame_id));
    }
    assert_eq!(evicted, [3, 2]);
    assert_eq!(pool.len(), 3);
    assert_eq!(ids(&pool.choose(3, 0.0).0), [0, 1, 4]);
}

#[test]
fn choosing_ends_when_little_is_gained() {
    let mut pool = Pool::new(40);
    for frame_id in 0..40 {
        let (snapshot, view) = candidate(frame_id, 0.3);
        pool.offer(snapshot, &view);
    }
    let (chosen, rejected) = pool.choose(36, 0.03);
    assert!(chosen.len() > 3 && chosen.len() < 20, "{}", chosen.len());
    assert!(rejected.iter().all(|r| matches!(
        r.reason,
        RejectReason::Redundant { gain_share } if gain_share < 0.03
    )));
}

#[test]
fn worth_is_submodular_and_losses_are_gains_in_reverse() {
    let mut pool = Pool::new(8);
    for (frame_id, azimuth) in [(0, 0.0), (1, 0.8), (2, 1.6)] {
        let (snapshot, view) = candidate(frame_id, azimuth);
        pool.offer(snapshot, &view);
    }
    let last = &pool.candidates[2];
    let nothing = vec![Information::default(); pool.total.len()];
    let mut others = pool.total.clone();
    for (patch, information) in &last.information {
        others[*patch] = others[*patch].minus(information);
    }
    assert!(gain(last, &others) < gain(last, &nothing));
    assert!((gain(last, &others) - loss(last, &pool.total)).abs() < 1e-9);
}

#[test]
fn what_was_asked_for_stays_and_is_chosen_first() {
    let mut pool = Pool::new(3);
    let mut evicted = Vec::new();
    for (frame_id, azimuth) in [(0, 0.0), (1, 0.0), (2, 1.6), (3, 3.1), (4, 4.7)] {
        let (snapshot, view) = candidate(frame_id, azimuth);
        let outdone = match frame_id {
            1 => pool.pin(snapshot, &view),
            _ => pool.offer(snapshot, &view),
        };
        evicted.extend(outdone.map(|r| r.frame_id));
    }
    assert_eq!(evicted[0], 0, "the equal that nobody asked for");
    assert!(!evicted.contains(&1));
    assert_eq!(ids(&pool.chosen(1, 0.9).accepted), [1]);
    let held = pool.held(1, 0.0);
    assert_eq!(held.len(), 3);
    for (snapshot, reason) in held {
        assert_eq!(reason.is_none(), snapshot.frame_id == 1);
    }
    // A copy of the choice is the choice.
    let chosen = ids(&pool.chosen(2, 0.0).accepted);
    assert_eq!(chosen, ids(&pool.choose(2, 0.0).0));
}

#[test]
fn a_pool_that_forgets_is_that_of_the_frames_before() {
    let mut pool = Pool::new(8);
    let mut before = Pool::new(8);
    for (frame_id, azimuth) in [(0, 0.0), (1, 1.6), (2, 0.4), (3, 3.1)] {
        let (snapshot, view) = candidate(frame_id, azimuth);
        if frame_id < 2 {
            before.offer(snapshot.clone(), &view);
        }
        pool.offer(snapshot, &view);
    }
    pool.forget_after(1.5);
    assert!((pool.worth - before.worth).abs() < 1e-9 * before.worth);
    assert_eq!(ids(&pool.choose(8, 0.0).0), [0, 1]);
}
