//! A Kinect I as the bus sees it: what it answers, and what its streams bring.

use std::{
    collections::BTreeMap,
    fs::{File, OpenOptions},
    io::Write,
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use crate::{
    scenario::{Device, Folder, Model},
    stream::{Format, Play, Stream},
};

/// The parts of a Kinect, each a device of its own on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    Camera,
    Motor,
    Audio,
}

/// Endpoints of the camera.
pub(crate) const VIDEO: u8 = 0x81;
pub(crate) const DEPTH: u8 = 0x82;

/// Registers that start streams, and their values for it.
const VIDEO_MODE: u16 = 0x05;
const VIDEO_IS_IR: u16 = 3;
const DEPTH_MODE: u16 = 0x06;
const DEPTH_IS_ON: u16 = 2;
const IR_RESOLUTION: u16 = 0x1a;

/// What depth is where no pattern is seen.
const NO_DISPARITY: u16 = 2047;

/// Depth is stamped a little later than IR of the same exposure; arbitrary, but not 0.
const DEPTH_LAG_TICKS: u32 = 12_345;

/// Writes a packet into its slot and returns its length.
pub(crate) type Packet<'a> = &'a mut dyn FnMut(&mut [u8]) -> usize;

/// One Kinect.
#[derive(Debug)]
pub(crate) struct Kinect {
    folder: Folder,
    pub(crate) device: Device,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    plugged_at: Instant,
    /// Since it was plugged in, where it does not run by the clock.
    free_time: Duration,
    is_plugged: bool,
    registers: BTreeMap<u16, u16>,
    answer: Vec<u8>,
    led_tag: [u8; 4],
    depth: Option<Stream>,
    ir: Option<Stream>,
    ir_ticks: u32,
    /// The frame that counts as the first, where frames are played once.
    origin: Option<u64>,
    trace: Option<File>,
}

impl State {
    fn new(trace: Option<File>) -> Self {
        State {
            plugged_at: Instant::now(),
            free_time: Duration::ZERO,
            is_plugged: true,
            // The gain that the device starts with.
            registers: BTreeMap::from([(0x15, 0x1e)]),
            answer: Vec::new(),
            led_tag: [0; 4],
            depth: None,
            ir: None,
            ir_ticks: 0,
            origin: None,
            trace,
        }
    }

    fn trace(&mut self, line: std::fmt::Arguments<'_>) {
        if let Some(file) = &mut self.trace {
            // A trace that cannot be written is missed by the test that reads it.
            let _ = writeln!(file, "{line}");
        }
    }
}

impl Kinect {
    pub(crate) fn load(folder: Folder) -> Result<Self, String> {
        let device = folder.device()?;
        let trace = OpenOptions::new()
            .create(true)
            .append(true)
            .open(folder.trace_path());
        Ok(Kinect {
            state: Mutex::new(State::new(trace.ok())),
            folder,
            device,
        })
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn has(&self, flag: &str) -> bool {
        self.folder.has(flag)
    }

    pub(crate) fn trace(&self, line: std::fmt::Arguments<'_>) {
        self.state().trace(line);
    }

    /// Whether it is there; one that has come back has forgotten everything.
    pub(crate) fn is_plugged(&self) -> bool {
        let is_plugged = !self.has("unplugged");
        let mut state = self.state();
        if is_plugged && !state.is_plugged {
            *state = State::new(state.trace.take());
        }
        state.is_plugged = is_plugged;
        is_plugged
    }

    /// The camera's interface, held for as long as the file is; `None` if another handle holds it.
    pub(crate) fn claim(&self) -> Option<File> {
        let file = OpenOptions::new()
            .create(true)
            .append(true)
            .open(self.folder.claim_path());
        file.ok().filter(|file| file.try_lock().is_ok())
    }

    /// When frames of a stream that is started at `now` begin.
    fn play(&self, state: &mut State, now: Duration) -> Play {
        let frame_secs = self.frame_secs();
        let next = (now.as_secs_f64() / frame_secs).ceil() as u64;
        if !self.device.play_once {
            return Play {
                frame_secs,
                first_frame: next,
                origin: 0,
                ends: false,
            };
        }
        // One frame later, so that what is started next begins with the same one.
        let origin = *state.origin.get_or_insert(next + 1);
        Play {
            frame_secs,
            first_frame: next.max(origin),
            origin,
            ends: true,
        }
    }

    /// Parts that are on the bus while it is plugged in.
    pub(crate) fn roles(&self) -> &'static [Role] {
        match self.device.model {
            Model::Xbox1414 => &[Role::Camera, Role::Motor, Role::Audio],
            // Its motor hangs on the audio part.
            Model::Xbox1473 | Model::KinectForWindows => &[Role::Audio, Role::Camera],
        }
    }

    /// Product id and version of a part.
    pub(crate) fn ids(&self, role: Role) -> (u16, u16) {
        match (self.device.model, role) {
            (_, Role::Motor) => (0x02b0, 0x0105),
            (Model::Xbox1414, Role::Camera) => (0x02ae, 0x010b),
            (Model::Xbox1473, Role::Camera) => (0x02ae, 0x010e),
            (Model::KinectForWindows, Role::Camera) => (0x02bf, 0x0110),
            (Model::KinectForWindows, Role::Audio) => (0x02be, 0x0100),
            (_, Role::Audio) => (0x02ad, 0x0100),
        }
    }

    pub(crate) fn serial(&self, role: Role) -> &str {
        match (self.device.model, role) {
            (Model::Xbox1414, Role::Camera) | (_, Role::Audio) => &self.device.serial,
            (_, Role::Camera) => "0000000000000000",
            (_, Role::Motor) => "",
        }
    }

    /// A command to the camera: magic, length in words, opcode, tag, then its data.
    pub(crate) fn command(&self, request: &[u8]) {
        let Some((head, data)) = request.split_at_checked(8) else {
            return;
        };
        let words: Vec<u16> = data
            .chunks_exact(2)
            .map(|b| u16::from_le_bytes([b[0], b[1]]))
            .collect();
        let reply = match (u16::from_le_bytes([head[4], head[5]]), words.as_slice()) {
            (0x02, [register, ..]) => self.read_register(*register),
            (0x03, [register, value, ..]) => self.write_register(*register, *value),
            (0x04, _) => self.fixed_parameters(),
            (0x16, [0x40, ..]) => vec![0; 118],
            (0x16, [0x41, ..]) => vec![0; 8],
            (0x16, [0x00, ..]) => [[0, 0], self.device.const_shift.to_le_bytes()].concat(),
            _ => vec![0; 2],
        };
        let length = ((reply.len() / 2) as u16).to_le_bytes();
        let mut answer = vec![b'R', b'B', length[0], length[1]];
        answer.extend(&head[4..8]);
        answer.extend(reply);
        self.state().answer = answer;
    }

    /// The answer to the newest command; empty if there is none.
    pub(crate) fn answer(&self) -> Vec<u8> {
        std::mem::take(&mut self.state().answer)
    }

    /// A command to the audio part, of which the light is all that is known here.
    pub(crate) fn led_command(&self, request: &[u8]) {
        let mut state = self.state();
        state.trace(format_args!("led"));
        if let Some(tag) = request.get(4..8).and_then(|tag| tag.try_into().ok()) {
            state.led_tag = tag;
        }
    }

    pub(crate) fn led_answer(&self) -> [u8; 12] {
        let t = self.state().led_tag;
        [0x00, 0xe0, 0x6f, 0x0a, t[0], t[1], t[2], t[3], 0, 0, 0, 0]
    }

    fn read_register(&self, register: u16) -> Vec<u8> {
        let value = self.state().registers.get(&register).copied().unwrap_or(0);
        [register.to_le_bytes(), value.to_le_bytes()].concat()
    }

    fn write_register(&self, register: u16, value: u16) -> Vec<u8> {
        let now = self.now(&self.state());
        let mut state = self.state();
        state.trace(format_args!("write {register:02x} {value:x}"));
        state.registers.insert(register, value);
        match (register, value) {
            (DEPTH_MODE, DEPTH_IS_ON) => {
                let start = now + millis(self.device.first_depth_after_ms);
                let loss = (self.device.lose_depth_every, self.device.lose_run);
                let values = self.folder.values("depth11.u16");
                let play = self.play(&mut state, start);
                let nothing = vec![NO_DISPARITY; Format::DEPTH.n_values];
                let stream = Stream::start(Format::DEPTH, values, play, loss);
                state.depth = Some(stream.with_others(nothing));
            }
            (DEPTH_MODE, _) => state.depth = None,
            (VIDEO_MODE, VIDEO_IS_IR) => {
                let start = now + millis(self.device.first_ir_after_ms);
                let loss = (self.device.lose_ir_every, self.device.lose_run);
                let is_high = state.registers.get(&IR_RESOLUTION) == Some(&2);
                let play = self.play(&mut state, start);
                let ir = |format, file| Stream::start(format, self.folder.values(file), play, loss);
                state.ir = Some(match is_high {
                    true => ir(Format::IR_HIGH, "ir10-high.u16"),
                    false => {
                        let alone = self.folder.values("ir10-alone.u16");
                        ir(Format::IR, "ir10.u16").with_others(alone)
                    }
                });
            }
            (VIDEO_MODE, _) => state.ir = None,
            _ => {}
        }
        vec![0; 2]
    }

    fn fixed_parameters(&self) -> Vec<u8> {
        let n_bytes = match self.device.model {
            Model::Xbox1414 => 322,
            Model::Xbox1473 | Model::KinectForWindows => 334,
        };
        let mut reply = vec![0; n_bytes];
        let zero_plane = [
            self.device.emitter_distance_cm,
            // Distance to the colour camera.
            2.3,
            self.device.reference_distance_mm,
            self.device.reference_pixel_size_mm,
        ];
        for (slot, value) in reply[94..].chunks_exact_mut(4).zip(zero_plane) {
            slot.copy_from_slice(&value.to_le_bytes());
        }
        reply
    }

    fn frame_secs(&self) -> f64 {
        match self.device.frame_rate_hz > 0.0 {
            true => 1.0 / self.device.frame_rate_hz,
            false => 1.0 / 30.0,
        }
    }

    fn now(&self, state: &State) -> Duration {
        match self.device.frame_rate_hz > 0.0 {
            true => state.plugged_at.elapsed(),
            false => state.free_time,
        }
    }

    /// Whether time stands still because the next picture must not be sent yet.
    fn is_withheld(&self, state: &State) -> bool {
        let next = state.depth.as_ref().map(Stream::picture);
        let limit = self.folder.number("frame-limit");
        next.zip(limit).is_some_and(|(next, limit)| next >= limit)
    }

    /// Hands every packet that has come since the last call to `deliver`, which says whether a transfer waited for it.
    pub(crate) fn advance(&self, mut deliver: impl FnMut(u8, Packet<'_>) -> bool) {
        let silent = [self.has("silent-depth"), self.has("silent-ir")];
        let is_covered = self.has("covered");
        let mut guard = self.state();
        if !self.is_withheld(&guard) {
            guard.free_time += Duration::from_micros(self.device.free_step_us);
        }
        let now = self.now(&guard);
        let state = &mut *guard;
        let first_ticks = self.device.first_ticks;
        while let Some(depth) = state.depth.as_mut().filter(|stream| stream.due() <= now) {
            let ticks = first_ticks
                .wrapping_add(depth.ticks())
                .wrapping_add(DEPTH_LAG_TICKS);
            depth.play_others(is_covered);
            if silent[0] {
                depth.pass();
            } else if !deliver(DEPTH, &mut |slot| depth.packet(ticks, slot)) {
                depth.pass();
                state.trace(format_args!("overrun depth"));
            }
        }
        let stands_still = self.device.freeze_ir_clock && state.depth.is_none();
        while let Some(ir) = state.ir.as_mut().filter(|stream| stream.due() <= now) {
            if !stands_still {
                state.ir_ticks = first_ticks.wrapping_add(ir.ticks());
            }
            let ticks = state.ir_ticks;
            ir.play_others(is_covered || state.depth.is_none());
            if silent[1] {
                ir.pass();
            } else if !deliver(VIDEO, &mut |slot| ir.packet(ticks, slot)) {
                ir.pass();
                state.trace(format_args!("overrun IR"));
            }
        }
    }
}

fn millis(millis: f64) -> Duration {
    Duration::from_secs_f64(millis / 1000.0)
}
