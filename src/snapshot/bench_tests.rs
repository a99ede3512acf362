//! Recorded Kinect I sessions: every IR image is told apart as speckle or lamp, and the groups are found.
//!
//! The recordings are large and not part of the sources: `RELIEF_BENCH` names their folder, by default one beside the
//! sources; where there is none the tests say so and pass.

use super::information::Optics;
use super::speckle::texture;
use super::{RejectReason, SnapshotParams, SnapshotSelection, SnapshotSelector, scenes};
use crate::fusion::{TrackingOutcome, bench_tests::session};
use crate::geometry::Pose;
use depth_camera::DepthCamera;
use replay::ReplayCamera;
use std::path::Path;
use std::time::Duration;

/// Times of the images under the lamp, in the order of the list.
fn lamp_times(folder: &Path) -> Vec<f64> {
    std::fs::read_to_string(folder.join("shading.txt"))
        .unwrap()
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| line.split(' ').next().unwrap().parse().unwrap())
        .collect()
}

/// Smallest and largest.
#[derive(Clone, Copy, Debug)]
struct Range(f64, f64);

impl Range {
    const EMPTY: Range = Range(f64::MAX, f64::MIN);

    fn with(self, value: f64) -> Range {
        Range(self.0.min(value), self.1.max(value))
    }
}

/// Replays a session with poses that never move, checks each IR image, and returns the selection.
fn replayed(folder: &Path, lamp: &[f64]) -> SnapshotSelection {
    let mut camera = ReplayCamera::open(folder).unwrap();
    let full_scale = Optics::new(camera.info()).unwrap().full_scale;
    let mut selector = SnapshotSelector::new(camera.info(), SnapshotParams::default()).unwrap();
    let (mut speckled, mut lit) = (Range::EMPTY, Range::EMPTY);
    while let Some(frame) = camera.grab(Duration::ZERO).unwrap() {
        let depth = frame.depth.as_ref().unwrap();
        let has_depth = depth.data().iter().any(|z| *z > 0.0);
        let outcome = match has_depth {
            true => scenes::tracked(Pose::identity()),
            false => TrackingOutcome::NoDepth,
        };
        if let Some(ir) = &frame.ir {
            let texture = texture(ir, full_scale);
            let under_lamp = lamp.contains(&frame.device_time_secs);
            assert_eq!(
                texture.is_speckled(),
                !under_lamp,
                "frame {}",
                frame.frame_id
            );
            assert!(!texture.is_dark());
            let range = if under_lamp { &mut lit } else { &mut speckled };
            *range = range.with(texture.speckle_energy);
        }
        selector.observe(&scenes::without_model(&frame, &outcome));
    }
    println!(
        "{}: speckle energy {:.4} to {:.4} under the lamp, {:.4} to {:.4} under the projector",
        folder.display(),
        lit.0,
        lit.1,
        speckled.0,
        speckled.1
    );
    selector.finish()
}

/// Checks that a session gives one image of four exposures at each of `n_complete` poses, in order; exposures after which
/// the recording ends are refused.
fn check(name: &str, n_complete: usize) {
    let Some(folder) = session(name) else { return };
    let lamp = lamp_times(&folder);
    let selection = replayed(&folder, &lamp);
    assert!(selection.accepted.iter().all(|s| s.n_exposures == 4));
    let complete: Vec<f64> = lamp.iter().step_by(4).take(n_complete).copied().collect();
    let found: Vec<f64> = selection
        .accepted
        .iter()
        .map(|s| s.device_time_secs)
        .collect();
    assert_eq!(found, complete);
    let unfinished = selection
        .rejected
        .iter()
        .filter(|r| r.reason == RejectReason::Unfinished);
    assert_eq!(unfinished.count(), lamp.len() - 4 * n_complete);
}

#[test]
fn the_pot_has_thirteen_shading_poses() {
    check("pot-k1", 13);
}

#[test]
fn the_sphere_has_five_shading_poses() {
    check("sphere-k1", 5);
}

/// Its recording ends under the lamp of the sixth.
#[test]
fn the_wall_has_five_shading_poses() {
    check("wall-k1", 5);
}
