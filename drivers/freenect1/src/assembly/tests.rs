//! Frames from packets.

use super::*;

/// Feeds the packets of one depth frame but the given ones, then delivers it.
fn depth(assembler: &mut Assembler, ticks: u32, at: Instant, lost: &[usize]) -> Vec<Captured> {
    let mut captured = Vec::new();
    let layout = PacketLayout::DEPTH;
    for number in (0..layout.n_packets()).filter(|number| !lost.contains(number)) {
        let bytes = layout
            .packet_bytes
            .min(layout.frame_bytes - number * layout.packet_bytes);
        let place = assembler.depth_packet(number, bytes, |c| captured.push(c));
        assert_eq!(place.map(|place| place.len()), Some(bytes));
    }
    assembler.depth_buffer()[0] = ticks as u16;
    assembler.depth_filled(ticks, at, |c| captured.push(c));
    captured
}

fn ir(assembler: &mut Assembler, ticks: u32, at: Instant, lost: &[usize]) -> Vec<Captured> {
    let mut captured = Vec::new();
    let layout = PacketLayout::IR;
    for number in (0..layout.n_packets()).filter(|number| !lost.contains(number)) {
        let bytes = layout
            .packet_bytes
            .min(layout.frame_bytes - number * layout.packet_bytes);
        assembler.ir_packet(number, bytes);
    }
    assembler.ir_buffer()[0] = ticks as u16;
    assembler.ir_filled(ticks, at, |c| captured.push(c));
    captured
}

fn started() -> (Assembler, Instant) {
    let now = Instant::now();
    let mut assembler = Assembler::default();
    let nothing = |captured| panic!("{captured:?}");
    assembler.start_depth(now, nothing);
    assembler.start_ir(IrSize::Medium, now, nothing);
    (assembler, now)
}

fn the_frame(captured: Vec<Captured>) -> RawFrame {
    match <[Captured; 1]>::try_from(captured) {
        Ok([Captured::Frame(frame)]) => frame,
        other => panic!("{other:?}"),
    }
}

#[test]
fn depth_and_infrared_of_one_moment_make_a_frame() {
    let (mut assembler, now) = started();
    assert!(depth(&mut assembler, 500, now, &[]).is_empty());
    let late = now + Duration::from_millis(5);
    let frame = the_frame(ir(&mut assembler, 700, late, &[]));
    assert_eq!((frame.frame_id, frame.host_time), (0, now));
    // To the microsecond.
    assert_eq!(frame.device_time_secs, 8e-6);
    assert_eq!(frame.disparity.unwrap().data()[0], 500);
    let ir = frame.ir.unwrap();
    assert_eq!((ir.width(), ir.height(), ir.data()[0]), (640, 488, 700));
}

#[test]
fn damaged_depth_costs_the_frame_and_damaged_infrared_itself() {
    let (mut assembler, now) = started();
    depth(&mut assembler, 0, now, &[7, 8]);
    let captured = ir(&mut assembler, 0, now, &[]);
    let [
        Captured::Damaged {
            frame_id: 0,
            reason,
        },
    ] = captured.as_slice()
    else {
        panic!("{captured:?}");
    };
    assert_eq!(reason, "depth: 2 of 242 packets lost");
    depth(&mut assembler, 2_000_000, now, &[]);
    let frame = the_frame(ir(&mut assembler, 2_000_000, now, &[200]));
    assert_eq!(frame.frame_id, 1);
    assert!(frame.disparity.is_some() && frame.ir.is_none());
    let statistics = assembler.statistics();
    assert_eq!(
        (statistics.depth.n_whole, statistics.depth.n_damaged),
        (1, 1)
    );
    assert_eq!((statistics.ir.n_whole, statistics.ir.n_damaged), (1, 1));
    assert_eq!(statistics.depth.n_packets_lost, 2);
    // Of depth a damaged frame has told.
    assert_eq!(statistics.n_missed(), 1);
}

#[test]
fn infrared_goes_alone_once_depth_is_stopped() {
    let (mut assembler, now) = started();
    depth(&mut assembler, 60_000_000, now, &[]);
    the_frame(ir(&mut assembler, 60_000_000, now, &[]));
    // Without depth of the same moment IR tells nothing while depth runs.
    ir(&mut assembler, 62_000_000, now, &[]);
    assert!(ir(&mut assembler, 64_000_000, now, &[]).is_empty());
    assert_eq!(assembler.statistics().n_ir_unpaired, 1);
    let mut waiting = Vec::new();
    assembler.stop_depth(|c| waiting.push(c));
    assert!(the_frame(waiting).disparity.is_none());
    for n in 1..4_u64 {
        let at = now + Duration::from_millis(500 * n);
        let frame = the_frame(ir(&mut assembler, 64_000_000, at, &[]));
        assert!(frame.disparity.is_none());
        let passed = frame.device_time_secs - 64.0 / 60.0;
        assert!((passed - 0.5 * n as f64).abs() < 1e-6, "{passed}");
    }
    assert_eq!(assembler.depth_silence(now), None);
}

#[test]
fn infrared_whose_stamps_stand_still_is_not_paired_by_arrival_before_they_can_move() {
    let (mut assembler, now) = started();
    let at = |ms| now + Duration::from_millis(ms);
    // On a busy machine the images of two moments arrive at once.
    assert!(ir(&mut assembler, 2_000_000, at(30), &[]).is_empty());
    assert!(depth(&mut assembler, 4_000_000, at(31), &[]).is_empty());
    assert_eq!(assembler.statistics().n_ir_unpaired, 1);
    assert!(ir(&mut assembler, 2_000_000, at(32), &[]).is_empty());
    assert_eq!(assembler.statistics().n_ir_unpaired, 2);
    let pair = the_frame(ir(&mut assembler, 4_000_000, at(40), &[]));
    assert_eq!(pair.disparity.unwrap().data()[0], 4_000_000_u32 as u16);
    assert_eq!(pair.ir.unwrap().data()[0], 4_000_000_u32 as u16);
    // So streams begin.
    assert_eq!(assembler.statistics().n_missed(), 0);
}

#[test]
fn infrared_without_its_depth_is_missed() {
    let (mut assembler, now) = started();
    for n in 0..3 {
        depth(&mut assembler, 2_000_000 * n, now, &[]);
        the_frame(ir(&mut assembler, 2_000_000 * n, now, &[]));
    }
    assert!(ir(&mut assembler, 6_000_000, now, &[]).is_empty());
    assert!(ir(&mut assembler, 8_000_000, now, &[]).is_empty());
    assert_eq!(assembler.statistics().n_missed(), 1, "one still waits");
}

#[test]
fn infrared_whose_stamps_move_is_paired_with_the_first_depth_that_comes_after_it() {
    let (mut assembler, now) = started();
    let at = |ms| now + Duration::from_millis(ms);
    for n in 1..3 {
        assert!(ir(&mut assembler, 2_000_000 * n, at(30), &[]).is_empty());
    }
    // Of the first nothing tells whether its stamp moves.
    assert_eq!(assembler.statistics().n_ir_unpaired, 1);
    let pair = the_frame(depth(&mut assembler, 4_000_000, at(90), &[]));
    assert!(pair.disparity.is_some() && pair.ir.is_some());
}

#[test]
fn infrared_whose_stamps_never_move_is_paired_by_arrival() {
    let (mut assembler, now) = started();
    let mut frames = Vec::new();
    for n in 0..6_u64 {
        let at = now + Duration::from_micros(33_333 * n);
        frames.extend(depth(&mut assembler, 2_000_000 * n as u32, at, &[]));
        let late = at + Duration::from_millis(3);
        frames.extend(ir(&mut assembler, 40_000_000, late, &[]));
    }
    let is_pair = |captured: &Captured| match captured {
        Captured::Frame(frame) => frame.ir.is_some(),
        Captured::Damaged { .. } => panic!("{captured:?}"),
    };
    let pairs: Vec<bool> = frames.iter().map(is_pair).collect();
    // The first stamp is new, and the next one might still begin to move.
    assert_eq!(pairs, [false, false, true, true, true, true]);
    assert_eq!(assembler.statistics().n_ir_unpaired, 2);
}

#[test]
fn silence_is_measured_from_the_start_or_the_newest_frame() {
    let (mut assembler, now) = started();
    let later = now + Duration::from_secs(3);
    let silence = assembler.depth_silence(later).unwrap();
    assert_eq!(
        (silence.silent_for, silence.is_first),
        (Duration::from_secs(3), true)
    );
    depth(&mut assembler, 0, later, &[1]);
    let silence = assembler.depth_silence(later).unwrap();
    assert_eq!(
        (silence.silent_for, silence.is_first),
        (Duration::ZERO, false)
    );
    assert!(assembler.ir_silence(later).unwrap().is_first);
}
