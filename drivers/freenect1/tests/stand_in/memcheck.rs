//! No invalid read, no invalid write, no leak through the C library.

use std::process::{Command, Stdio};

use depth_camera::CameraError;
use freenect1::{Freenect1Camera, Settings, streams::Streams};

use crate::support::{lower, next_failure, next_whole, on_stand_in_under, raise};

const VALGRIND: &[&str] = &[
    "valgrind",
    "--quiet",
    // Its threads take turns; otherwise one that asks again and again keeps the others from answering.
    "--fair-sched=try",
    "--leak-check=full",
    // What is merely reachable or possibly lost belongs to the test harness and to the stand-in's tables.
    "--show-leak-kinds=definite",
    "--errors-for-leak-kinds=definite",
    "--error-exitcode=99",
];

/// Opens, streams, changes streams, loses the device, finds it again, closes, all under valgrind.
#[test]
fn valgrind_finds_nothing() {
    let here = Command::new("valgrind")
        .arg("--version")
        .stdout(Stdio::null())
        .status();
    if !here.is_ok_and(|status| status.success()) {
        eprintln!("skipped: no valgrind here");
        return;
    }
    // Slow enough for a program that runs thirty times slower, and fast enough that on a busy machine, too, a first frame comes within
    // the two seconds that it is waited for.
    let device = "frame_rate_hz = 2.5\nlose_ir_every = 701";
    on_stand_in_under(
        VALGRIND,
        "memcheck::valgrind_finds_nothing",
        &[device],
        |root| {
            let mut camera = Freenect1Camera::open(None, Settings::default()).unwrap();
            for _ in 0..2 {
                next_whole(&mut camera);
            }
            camera.control().set_streams(Streams::Ir).unwrap();
            while next_whole(&mut camera).disparity.is_some() {}
            camera.control().set_streams(Streams::DepthAndIr).unwrap();
            while next_whole(&mut camera).disparity.is_none() {}
            raise(root, "unplugged");
            let (error, _) = next_failure(&mut camera);
            assert_eq!(error, CameraError::Disconnected);
            lower(root, "unplugged");
            next_whole(&mut camera);
        },
    );
}
