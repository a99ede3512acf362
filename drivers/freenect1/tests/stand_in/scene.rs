//! A simulated Kinect I's pictures, sent through the library as disparity and packets, come out as the camera took them.

use std::{fs, path::Path};

use depth_camera::{DepthCamera, Frame};
use freenect1::{Freenect1Camera, Settings, disparity::ZeroPlane};
use simulated::SimulatedCamera;

use crate::support::{SECOND, file, next_decoded_pair, on_stand_in};

const N_FRAMES: usize = 3;

fn frames() -> Vec<Frame> {
    let mut camera = SimulatedCamera::kinect1_plaque(12, 5);
    let frames = std::iter::from_fn(|| camera.grab(SECOND).unwrap());
    frames
        .filter(|frame| frame.ir.is_some())
        .take(N_FRAMES)
        .collect()
}

/// Writes a session's frames, which hold depth and IR, as the streams of a device: depth as the disparity nearest to it, the
/// rows that the device has more of IR as black.
fn write_streams(frames: &[Frame], folder: &Path) {
    let plane = ZeroPlane::TYPICAL;
    let disparity = frames
        .iter()
        .flat_map(|frame| frame.depth.as_ref().unwrap().data());
    let disparity = disparity.map(|metres| plane.disparity(f64::from(*metres)));
    let bytes: Vec<u8> = disparity.flat_map(u16::to_le_bytes).collect();
    fs::write(folder.join("depth11.u16"), bytes).unwrap();
    let mut bytes = Vec::new();
    for frame in frames {
        let ir = frame.ir.as_ref().unwrap();
        let rows_below = vec![0; 640 * (488 - ir.height())];
        let counts = ir.data().iter().chain(&rows_below);
        bytes.extend(counts.flat_map(|count| count.to_le_bytes()));
    }
    fs::write(folder.join("ir10.u16"), bytes).unwrap();
}

#[test]
fn a_simulated_session_comes_out_as_it_was_taken() {
    on_stand_in(
        "scene::a_simulated_session_comes_out_as_it_was_taken",
        &[""],
        |root| {
            let sent = frames();
            write_streams(&sent, file(root, "depth11.u16").parent().unwrap());
            let mut camera = Freenect1Camera::open(None, Settings::default()).unwrap();
            let plane = *camera.zero_plane();
            let mut seen = [false; N_FRAMES];
            let mut n_measured = 0;
            for _ in 0..30 {
                let frame = next_decoded_pair(&mut camera);
                let (depth, ir) = (frame.depth.unwrap(), frame.ir.unwrap());
                let number = sent.iter().position(|sent| sent.ir.as_ref() == Some(&ir));
                let number = number.expect("IR is one of those that were sent");
                seen[number] = true;
                let truth = sent[number].depth.as_ref().unwrap();
                for (metres, truth) in depth.data().iter().zip(truth.data()) {
                    // Half of a step of the disparity.
                    let disparity = plane.disparity(f64::from(*truth));
                    let next = plane.depth_m(disparity + 1).unwrap_or(0.0) as f32;
                    let tolerance = match *truth > 0.0 {
                        true => 0.55 * (next - metres).abs(),
                        false => 0.0,
                    };
                    assert!(
                        (metres - truth).abs() <= tolerance,
                        "{metres} m for {truth} m"
                    );
                }
                let is_measured = |metres: &&f32| **metres > 0.0;
                n_measured += depth.data().iter().filter(is_measured).count();
            }
            assert_eq!(seen, [true; N_FRAMES]);
            // Some of the frames are of the lamp, with the projector covered and no depth.
            assert!(n_measured > 100_000, "{n_measured}");
        },
    );
}
