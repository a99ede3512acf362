//! From packets and finished buffers to frames: counts packets, stamps, pairs, numbers, and lends buffers.
//!
//! What libfreenect's callbacks tell comes in here, on the device thread; there is no C and no thread in this module.

use std::time::{Duration, Instant};

use depth_camera::{Image, ImagePool, whole_microseconds};

use crate::{
    clock::DeviceClock,
    packets::{Damage, PacketLayout, PacketLedger},
    pairing::{Moment, Pairing, Running, Stamp},
    streams::{DEPTH_SIZE, IrSize},
};

/// Buffers that are kept for use again: one is filled, one waits to be paired, the rest is on its way through the pipeline.
const POOL_CAPACITY: usize = 16;

/// IR whose stamp stands still has no counterpart until depth has brought so many images; arbitrary. Its stamps move with the first
/// of them, or never will. On a busy machine an image arrives as late as the next one, so that arrival pairs only where they
/// never do.
const N_DEPTH_UNTIL_STAMPS_MOVE: u64 = 3;

/// One moment as the device delivers it, nothing decoded.
#[derive(Debug)]
pub struct RawFrame {
    /// Counts moments from the start; gaps are moments of which depth was lost.
    pub frame_id: u64,
    /// The device's own clock, seconds, in whole microseconds.
    pub device_time_secs: f64,
    /// When the first of its images had arrived, on this machine's monotonic clock.
    pub host_time: Instant,
    /// Disparity, 640×480, 0 to 2047; see [`crate::disparity`].
    pub disparity: Option<Image<u16>>,
    /// IR counts, 640×488 or 1280×1024, 0 to 1023.
    pub ir: Option<Image<u16>>,
}

/// What comes out of the device.
#[derive(Debug)]
pub enum Captured {
    /// A moment of which every packet came.
    Frame(RawFrame),
    /// A moment that is lost.
    Damaged {
        /// Its number.
        frame_id: u64,
        /// Which stream lost how much.
        reason: String,
    },
}

/// What became of one stream's frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StreamStatistics {
    /// Frames of which every packet came.
    pub n_whole: u64,
    /// Frames that lacked packets; none of them was delivered.
    pub n_damaged: u64,
    /// Packets that they lacked.
    pub n_packets_lost: u64,
}

/// What became of all frames since the camera was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Statistics {
    /// Depth.
    pub depth: StreamStatistics,
    /// IR. A damaged image costs itself alone: its frame is delivered without it.
    pub ir: StreamStatistics,
    /// IR images that were dropped because depth of the same moment did not come, or because nothing told which one it was.
    pub n_ir_unpaired: u64,
    /// IR images that no frame holds though no damaged frame tells of it: damaged ones beside whole depth, those that libfreenect gave
    /// up, and unpaired ones, but for those that come while depth begins.
    pub n_ir_untold: u64,
    /// Frames that nobody fetched in time; newer ones took their place.
    pub n_overrun: u64,
}

impl Statistics {
    /// Frames and single IR images that were let go without a damaged frame that tells of it.
    pub fn n_missed(&self) -> u64 {
        self.n_overrun + self.n_ir_untold
    }
}

/// An image on its way to its counterpart.
#[derive(Debug)]
struct Exposure {
    image: Image<u16>,
    damage: Option<Damage>,
    host_time: Instant,
    device_time_secs: f64,
}

#[derive(Debug)]
struct Stream {
    ledger: PacketLedger,
    pool: ImagePool<u16>,
    size: (usize, usize),
    /// What libfreenect fills now.
    buffer: Vec<u16>,
    statistics: StreamStatistics,
    /// When it was started or last heard of; `None` while it is stopped.
    last_heard: Option<Instant>,
    /// Since it was started.
    n_heard: u64,
}

impl Stream {
    fn new(layout: PacketLayout, size: (usize, usize)) -> Self {
        let pool = ImagePool::new(POOL_CAPACITY);
        Stream {
            ledger: PacketLedger::new(layout),
            buffer: pool.take(size.0 * size.1),
            pool,
            size,
            statistics: StreamStatistics::default(),
            last_heard: None,
            n_heard: 0,
        }
    }

    fn start(&mut self, layout: PacketLayout, size: (usize, usize), now: Instant) {
        self.ledger = PacketLedger::new(layout);
        self.buffer.resize(size.0 * size.1, 0);
        self.size = size;
        self.last_heard = Some(now);
        self.n_heard = 0;
    }

    /// The image that was filled, with its damage, and whether one before it was given up.
    fn finish(&mut self, host: Instant) -> (Image<u16>, Option<Damage>, Option<Damage>) {
        let (width, height) = self.size;
        let next = self.pool.take(width * height);
        let filled = std::mem::replace(&mut self.buffer, next);
        let (damage, given_up) = self.ledger.frame();
        self.statistics.n_whole += u64::from(damage.is_none());
        damage.iter().for_each(|damage| self.count(damage));
        self.last_heard = Some(host);
        self.n_heard += 1;
        (self.pool.image(width, height, filled), damage, given_up)
    }

    fn count(&mut self, damage: &Damage) {
        self.statistics.n_damaged += 1;
        self.statistics.n_packets_lost += damage.n_lost() as u64;
    }

    fn silence(&self, now: Instant) -> Option<Silence> {
        self.last_heard.map(|heard| Silence {
            silent_for: now.saturating_duration_since(heard),
            is_first: self.n_heard == 0,
        })
    }
}

/// How long a stream that runs has delivered nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Silence {
    /// Since its last frame, or since it was started.
    pub silent_for: Duration,
    /// Whether it has not delivered anything since it was started.
    pub is_first: bool,
}

/// The state of both streams.
#[derive(Debug)]
pub struct Assembler {
    depth: Stream,
    ir: Stream,
    clock: DeviceClock,
    pairing: Pairing<Exposure>,
    next_frame_id: u64,
    n_ir_unpaired: u64,
    n_ir_untold: u64,
    /// Stamp of the newest IR image since IR was started.
    newest_ir_ticks: Option<u32>,
}

impl Default for Assembler {
    fn default() -> Self {
        Assembler {
            depth: Stream::new(PacketLayout::DEPTH, DEPTH_SIZE),
            ir: Stream::new(IrSize::Medium.layout(), IrSize::Medium.pixels()),
            clock: DeviceClock::default(),
            pairing: Pairing::new(Running::One),
            next_frame_id: 0,
            n_ir_unpaired: 0,
            n_ir_untold: 0,
            newest_ir_ticks: None,
        }
    }
}

impl Assembler {
    /// The device was opened, perhaps anew.
    pub fn device_opened(&mut self) {
        self.clock.restart();
    }

    /// Depth is about to be started.
    pub fn start_depth(&mut self, now: Instant, emit: impl FnMut(Captured)) {
        self.depth.start(PacketLayout::DEPTH, DEPTH_SIZE, now);
        self.streams_changed(emit);
    }

    /// IR is about to be started.
    pub fn start_ir(&mut self, size: IrSize, now: Instant, emit: impl FnMut(Captured)) {
        self.ir.start(size.layout(), size.pixels(), now);
        self.newest_ir_ticks = None;
        self.streams_changed(emit);
    }

    /// Depth was stopped.
    pub fn stop_depth(&mut self, emit: impl FnMut(Captured)) {
        self.depth.last_heard = None;
        self.streams_changed(emit);
    }

    /// IR was stopped.
    pub fn stop_ir(&mut self, emit: impl FnMut(Captured)) {
        self.ir.last_heard = None;
        self.streams_changed(emit);
    }

    fn streams_changed(&mut self, mut emit: impl FnMut(Captured)) {
        let both = self.depth.last_heard.is_some() && self.ir.last_heard.is_some();
        let running = if both { Running::Both } else { Running::One };
        for moment in self.pairing.set_running(running).into_iter().flatten() {
            self.resolve(moment, &mut emit);
        }
    }

    /// Where depth is to be decoded to: 640×480 values that stay in place until [`Assembler::depth_filled`] names others.
    pub fn depth_buffer(&mut self) -> &mut [u16] {
        &mut self.depth.buffer
    }

    /// Where IR is to be decoded to, as [`Assembler::depth_buffer`].
    pub fn ir_buffer(&mut self) -> &mut [u16] {
        &mut self.ir.buffer
    }

    /// A packet of depth was taken; where its bytes belong in the packed frame, if they do.
    pub fn depth_packet(
        &mut self,
        number: usize,
        bytes: usize,
        emit: impl FnMut(Captured),
    ) -> Option<std::ops::Range<usize>> {
        let place = self.depth.ledger.layout().place(number, bytes)?;
        if let Some(damage) = self.depth.ledger.packet(number, bytes) {
            self.depth_given_up(damage, emit);
        }
        Some(place)
    }

    /// A packet of IR was taken; as [`Assembler::depth_packet`].
    pub fn ir_packet(&mut self, number: usize, bytes: usize) -> Option<std::ops::Range<usize>> {
        let place = self.ir.ledger.layout().place(number, bytes)?;
        if let Some(damage) = self.ir.ledger.packet(number, bytes) {
            self.ir_given_up(&damage);
        }
        Some(place)
    }

    /// The depth buffer was filled, and another one takes its place.
    pub fn depth_filled(&mut self, ticks: u32, host: Instant, mut emit: impl FnMut(Captured)) {
        let (image, damage, given_up) = self.depth.finish(host);
        if let Some(damage) = given_up {
            self.depth_given_up(damage, &mut emit);
        }
        let exposure = Exposure {
            image,
            damage,
            host_time: host,
            device_time_secs: self.clock.at(ticks, host),
        };
        let stamp = Stamp {
            host,
            ticks: Some(ticks),
        };
        let complete = self.pairing.depth(stamp, exposure);
        for moment in complete.into_iter().flatten() {
            self.resolve(moment, &mut emit);
        }
    }

    /// The IR buffer was filled, and another one takes its place.
    pub fn ir_filled(&mut self, ticks: u32, host: Instant, mut emit: impl FnMut(Captured)) {
        let (image, damage, given_up) = self.ir.finish(host);
        given_up.iter().for_each(|damage| self.ir_given_up(damage));
        // The firmware stops these stamps while depth is off, and sets them going with depth's first frame.
        let before = self.newest_ir_ticks.replace(ticks);
        let moves = match before {
            Some(before) => before != ticks,
            None => self.depth.n_heard > 0,
        };
        let is_known = moves && self.depth.last_heard.is_some();
        let ticks = is_known.then_some(ticks);
        let device_time_secs = match ticks {
            Some(ticks) => self.clock.at(ticks, host),
            None => self.clock.without_stamp(host),
        };
        let exposure = Exposure {
            image,
            damage,
            host_time: host,
            device_time_secs,
        };
        if !is_known && self.depth.n_heard < N_DEPTH_UNTIL_STAMPS_MOVE {
            return self.resolve(Moment::Ir(exposure), &mut emit);
        }
        let complete = self.pairing.ir(Stamp { host, ticks }, exposure);
        for moment in complete.into_iter().flatten() {
            self.resolve(moment, &mut emit);
        }
    }

    fn depth_given_up(&mut self, damage: Damage, mut emit: impl FnMut(Captured)) {
        self.depth.count(&damage);
        let frame_id = self.number();
        emit(Captured::Damaged {
            frame_id,
            reason: format!("depth: {damage}, given up by libfreenect"),
        });
    }

    fn ir_given_up(&mut self, damage: &Damage) {
        self.ir.count(damage);
        self.n_ir_untold += 1;
    }

    /// Delivers what is whole of a moment.
    fn resolve(&mut self, moment: Moment<Exposure>, emit: &mut impl FnMut(Captured)) {
        let (depth, ir) = match moment {
            Moment::Both(depth, ir) => (Some(depth), Some(ir)),
            Moment::Depth(depth) => (Some(depth), None),
            Moment::Ir(_) if self.depth.last_heard.is_some() => {
                let has_begun = self.depth.n_heard >= N_DEPTH_UNTIL_STAMPS_MOVE;
                self.n_ir_unpaired += 1;
                self.n_ir_untold += u64::from(has_begun);
                return;
            }
            Moment::Ir(ir) => (None, Some(ir)),
        };
        let frame_id = self.number();
        let lost = match (&depth, &ir) {
            (Some(depth), _) => depth.damage.map(|damage| ("depth", damage)),
            (None, ir) => ir
                .as_ref()
                .and_then(|ir| ir.damage)
                .map(|damage| ("IR", damage)),
        };
        if let Some((stream, damage)) = lost {
            let reason = format!("{stream}: {damage}");
            return emit(Captured::Damaged { frame_id, reason });
        }
        let device_time_secs = depth.as_ref().or(ir.as_ref()).map(|e| e.device_time_secs);
        let host_time = depth.iter().chain(&ir).map(|e| e.host_time).min();
        let (Some(device_time_secs), Some(host_time)) = (device_time_secs, host_time) else {
            return;
        };
        let is_ir_damaged = ir.as_ref().is_some_and(|ir| ir.damage.is_some());
        self.n_ir_untold += u64::from(is_ir_damaged);
        emit(Captured::Frame(RawFrame {
            frame_id,
            device_time_secs: whole_microseconds(device_time_secs),
            host_time,
            disparity: depth.map(|depth| depth.image),
            ir: ir.filter(|ir| ir.damage.is_none()).map(|ir| ir.image),
        }));
    }

    fn number(&mut self) -> u64 {
        self.next_frame_id += 1;
        self.next_frame_id - 1
    }

    /// How long depth has been silent; `None` while it is stopped.
    pub fn depth_silence(&self, now: Instant) -> Option<Silence> {
        self.depth.silence(now)
    }

    /// How long IR has been silent; `None` while it is stopped.
    pub fn ir_silence(&self, now: Instant) -> Option<Silence> {
        self.ir.silence(now)
    }

    /// What became of all frames; overruns are not known here.
    pub fn statistics(&self) -> Statistics {
        Statistics {
            depth: self.depth.statistics,
            ir: self.ir.statistics,
            n_ir_unpaired: self.n_ir_unpaired,
            n_ir_untold: self.n_ir_untold,
            n_overrun: 0,
        }
    }
}

#[cfg(test)]
mod tests;
