//! Packets of a Kinect I in any order, of any length, with any stamps: nothing breaks, nothing damaged is delivered as whole.
#![no_main]

use std::{
    cell::RefCell,
    time::{Duration, Instant},
};

use depth_camera::Image;
use freenect1::{
    assembly::{Assembler, Captured},
    disparity::{DisparityTable, ZeroPlane},
    packets::PacketLayout,
    streams::IrSize,
};
use libfuzzer_sys::fuzz_target;

/// Bytes of a packed frame of depth, and of IR at both sizes.
const DEPTH_BYTES: usize = 640 * 480 * 11 / 8;
const IR_BYTES: usize = 1280 * 1024 * 10 / 8;

fuzz_target!(|bytes: &[u8]| {
    let start = Instant::now();
    let mut now = start;
    let mut assembler = Assembler::default();
    let captured = RefCell::new(Vec::new());
    let emit = |what: Captured| captured.borrow_mut().push(what);
    let (mut depth_runs, mut ir_runs) = (false, false);
    for step in bytes.chunks_exact(6) {
        let number = usize::from(u16::from_le_bytes([step[1], step[2]]));
        let ticks = u32::from_le_bytes([step[2], step[3], step[4], step[5]]);
        let length = usize::from(u16::from_le_bytes([step[3], step[4]]));
        now += Duration::from_millis(u64::from(step[5]));
        match step[0] % 10 {
            0 => {
                assembler.start_depth(now, emit);
                depth_runs = true;
            }
            1 => {
                let size = [IrSize::Medium, IrSize::High][number % 2];
                assembler.start_ir(size, now, emit);
                ir_runs = true;
            }
            2 => {
                assembler.stop_depth(emit);
                depth_runs = false;
            }
            3 => {
                assembler.stop_ir(emit);
                ir_runs = false;
            }
            4 if depth_runs => assembler.depth_filled(ticks, now, emit),
            5 if ir_runs => assembler.ir_filled(ticks, now, emit),
            6 if depth_runs => {
                if let Some(place) = assembler.depth_packet(number, length, emit) {
                    assert!(place.end <= DEPTH_BYTES);
                }
            }
            7 if ir_runs => {
                if let Some(place) = assembler.ir_packet(number, length) {
                    assert!(place.end <= IR_BYTES);
                }
            }
            // A whole frame, so that there is something to lose.
            8 if depth_runs => {
                for number in 0.. {
                    let Some(bytes) = whole_packet(PacketLayout::DEPTH, number) else { break };
                    assembler.depth_packet(number, bytes, emit);
                }
                assembler.depth_filled(ticks, now, emit);
            }
            _ => {
                assembler.depth_silence(now);
                assembler.ir_silence(now);
            }
        }
    }
    check(&captured.borrow(), &assembler);
});

/// The length of packet `number` of a whole frame of depth; `None` beyond the last.
fn whole_packet(layout: PacketLayout, number: usize) -> Option<usize> {
    let start = number * 1748;
    let length = DEPTH_BYTES.checked_sub(start).filter(|left| *left > 0)?.min(1748);
    layout.place(number, length).map(|_| length)
}

fn check(captured: &[Captured], assembler: &Assembler) {
    let mut before = None;
    let mut n_with_depth = 0;
    for what in captured {
        let id = match what {
            Captured::Frame(frame) => {
                assert!(frame.disparity.is_some() || frame.ir.is_some());
                n_with_depth += u64::from(frame.disparity.is_some());
                assert!(frame.device_time_secs.is_finite());
                frame.frame_id
            }
            Captured::Damaged { frame_id, .. } => *frame_id,
        };
        assert!(before.is_none_or(|before| before < id));
        before = Some(id);
    }
    assert!(n_with_depth <= assembler.statistics().depth.n_whole);
    let table = DisparityTable::new(&ZeroPlane::TYPICAL).expect("typical constants are good");
    let mut metres = [0.0; 4];
    let image = Image::from_vec(2, 2, vec![0, 1083, 2047, captured.len() as u16]);
    table.convert(&image, &mut metres);
    assert!(metres.iter().all(|z| (0.0..=60.0).contains(z)));
}
