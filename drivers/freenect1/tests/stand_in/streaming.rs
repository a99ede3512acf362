//! What arrives is what was sent, in time, and damage is never hidden.

use std::time::Instant;

use depth_camera::{CameraError, DepthCamera};
use freenect1::{Freenect1Camera, Settings, disparity::DisparityTable};

use crate::support::{
    N_FRAMES, SECOND, assert_bit_exact, is_too_busy, next_decoded_pair, next_pair, next_whole,
    on_stand_in,
};

/// 300 frames at 30 Hz; the device's clock wraps after two thirds of them.
#[test]
fn depth_and_infrared_arrive_bit_by_bit_at_30_hz() {
    let device = "first_ticks = 3894967296";
    on_stand_in(
        "streaming::depth_and_infrared_arrive_bit_by_bit_at_30_hz",
        &[device],
        |root| {
            let mut camera = Freenect1Camera::open(None, Settings::default()).unwrap();
            let mut before = next_whole(&mut camera);
            assert_bit_exact(&before);
            let start = Instant::now();
            let mut n_gaps = 0;
            let mut n_out_of_step = 0;
            let mut n_alone = 0;
            for _ in 0..300 {
                let frame = next_whole(&mut camera);
                let number = assert_bit_exact(&frame);
                n_alone += u64::from(frame.disparity.is_none() || frame.ir.is_none());
                let n_steps = frame.frame_id - before.frame_id;
                n_gaps += n_steps - 1;
                let n_ahead = (number + N_FRAMES - assert_bit_exact(&before)) % N_FRAMES;
                let device_secs = frame.device_time_secs - before.device_time_secs;
                let is_in_step = n_ahead as u64 == n_steps % N_FRAMES as u64
                    && (device_secs - n_steps as f64 / 30.0).abs() < 2e-6;
                // A frame of which no packet came is one that nobody can count.
                n_out_of_step += u64::from(!is_in_step);
                assert!(frame.host_time > before.host_time);
                before = frame;
            }
            let rate = 300.0 / start.elapsed().as_secs_f64();
            let statistics = camera.control().statistics();
            eprintln!("300 frames bit by bit at {rate:.2} Hz, {n_gaps} lost: {statistics:?}");
            if is_too_busy(root, &statistics) {
                return;
            }
            assert_eq!(
                (n_gaps, statistics.depth.n_damaged, statistics.ir.n_damaged),
                (0, 0, 0)
            );
            // The rate by the device's clock: the steps are of a thirtieth of a second.
            assert_eq!((n_out_of_step, n_alone), (0, 0));
            assert_eq!(
                statistics.depth.n_packets_lost + statistics.ir.n_packets_lost,
                0
            );
        },
    );
}

#[test]
fn a_frame_is_metres_and_infrared_on_one_grid() {
    on_stand_in(
        "streaming::a_frame_is_metres_and_infrared_on_one_grid",
        &[""],
        |_| {
            let mut camera = Freenect1Camera::open(None, Settings::default()).unwrap();
            let table = DisparityTable::new(camera.zero_plane()).unwrap();
            let raw = next_pair(&mut camera);
            let number = assert_bit_exact(&raw);
            // The same frame comes round again.
            let frame = loop {
                let frame = next_decoded_pair(&mut camera);
                if usize::from(*frame.ir.as_ref().unwrap().at(0, 0)) == number {
                    break frame;
                }
            };
            let (depth, ir) = (frame.depth.unwrap(), frame.ir.unwrap());
            assert_eq!((depth.width(), depth.height()), (640, 480));
            assert_eq!((ir.width(), ir.height()), (640, 480));
            let disparity = raw.disparity.unwrap();
            let expected = disparity.data().iter().map(|d| table.metres(*d));
            assert!(depth.data().iter().copied().eq(expected));
            assert_eq!(ir.data(), &raw.ir.unwrap().data()[..640 * 480]);
            let info = camera.info();
            assert_eq!((info.intrinsics.width, info.intrinsics.height), (640, 480));
            assert!((info.intrinsics.fx - 575.8).abs() < 0.1);
            assert_eq!(info.ir_full_scale, Some(1023.0));
        },
    );
}

/// Every 1009th packet of depth and every 1511th of IR: the library delivers such frames like any other.
#[test]
fn frames_with_gaps_are_never_delivered() {
    let device = "lose_depth_every = 1009\nlose_ir_every = 1511";
    on_stand_in(
        "streaming::frames_with_gaps_are_never_delivered",
        &[device],
        |root| {
            let mut camera = Freenect1Camera::open(None, Settings::default()).unwrap();
            let (mut n_whole, mut n_damaged, mut n_without_ir) = (0, 0, 0);
            let mut ids = Vec::new();
            while n_whole + n_damaged < 90 {
                match camera.grab_raw(5 * SECOND) {
                    Ok(frame) => {
                        assert_bit_exact(&frame);
                        n_whole += 1;
                        n_without_ir += u32::from(frame.ir.is_none());
                        ids.push(frame.frame_id);
                    }
                    Err(CameraError::DamagedFrame { frame_id, reason }) => {
                        assert!(reason.contains("of 242 packets lost"), "{reason}");
                        n_damaged += 1;
                        ids.push(frame_id);
                    }
                    Err(error) => panic!("{error}"),
                }
            }
            let statistics = camera.control().statistics();
            eprintln!(
                "{n_whole} whole, {n_damaged} damaged, {n_without_ir} without IR: {statistics:?}"
            );
            assert!(ids.is_sorted_by(|a, b| a < b), "{ids:?}");
            assert!(statistics.depth.n_packets_lost >= n_damaged as u64);
            if is_too_busy(root, &statistics) {
                return;
            }
            // One packet in 1009 hits a frame of 242 packets every 4.17 frames, one in 1511 one of 205 every 7.4.
            assert!((18..=26).contains(&n_damaged), "{n_damaged}");
            assert!((6..=14).contains(&n_without_ir), "{n_without_ir}");
        },
    );
}

/// Nine packets in a row: the library gives the rest of the frame up and says nothing.
#[test]
fn frames_that_the_library_gives_up_are_counted() {
    let device = "lose_depth_every = 2003\nlose_run = 9";
    on_stand_in(
        "streaming::frames_that_the_library_gives_up_are_counted",
        &[device],
        |root| {
            let mut camera = Freenect1Camera::open(None, Settings::default()).unwrap();
            let (mut n_whole, mut n_given_up) = (0, 0);
            while n_whole < 60 {
                match camera.grab_raw(5 * SECOND) {
                    Ok(frame) => {
                        assert_bit_exact(&frame);
                        n_whole += 1;
                    }
                    Err(CameraError::DamagedFrame { .. }) => n_given_up += 1,
                    Err(error) => panic!("{error}"),
                }
            }
            let statistics = camera.control().statistics();
            eprintln!("{n_whole} whole, {n_given_up} given up: {statistics:?}");
            if is_too_busy(root, &statistics) {
                return;
            }
            assert!((6..=11).contains(&n_given_up), "{n_given_up}");
            assert!(
                statistics.n_ir_unpaired >= 5,
                "IR of the moments whose depth was given up"
            );
        },
    );
}
