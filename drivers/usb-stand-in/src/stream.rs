//! One isochronous stream: which packet comes when, and which is lost.

use std::time::Duration;

use crate::wire::{HEADER_BYTES, Position, header, pack};

/// Ticks of the device clock in a frame.
const TICKS_PER_FRAME: u64 = 2_000_000;

/// How a stream's frames are cut.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Format {
    pub(crate) flag: u8,
    pub(crate) bits: u32,
    pub(crate) n_values: usize,
    pub(crate) packet_bytes: usize,
    /// Frames of this stream come so much more rarely.
    pub(crate) slower: u64,
}

impl Format {
    pub(crate) const DEPTH: Format = Format {
        flag: 0x70,
        bits: 11,
        n_values: 640 * 480,
        packet_bytes: 1748,
        slower: 1,
    };
    pub(crate) const IR: Format = Format {
        flag: 0x80,
        bits: 10,
        n_values: 640 * 488,
        packet_bytes: 1908,
        slower: 1,
    };
    pub(crate) const IR_HIGH: Format = Format {
        n_values: 1280 * 1024,
        slower: 3,
        ..Self::IR
    };

    fn frame_bytes(&self) -> usize {
        (self.n_values * self.bits as usize).div_ceil(8)
    }

    fn n_packets(&self) -> u64 {
        self.frame_bytes().div_ceil(self.packet_bytes) as u64
    }
}

/// When a stream's frames begin, and which they are.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Play {
    pub(crate) frame_secs: f64,
    /// The first one, counted from when the device was plugged in.
    pub(crate) first_frame: u64,
    /// The one from which pictures and stamps are counted.
    pub(crate) origin: u64,
    /// Whether nothing but empty packets follows the last picture.
    pub(crate) ends: bool,
}

/// A stream that has been started.
#[derive(Debug)]
pub(crate) struct Stream {
    format: Format,
    /// Frames to play, one after the other.
    values: Vec<u16>,
    /// Frames to play in their place, if there are any.
    others: Vec<u16>,
    plays_others: bool,
    play: Play,
    /// Packets since then.
    n_packets: u64,
    lose_every: u64,
    lose_run: u64,
    sequence: u8,
    packed: Vec<u8>,
    packed_frame: Option<u64>,
}

impl Stream {
    /// A stream at 640 columns; one whose frames come more rarely starts with the next of its own.
    pub(crate) fn start(
        format: Format,
        values: Vec<u16>,
        play: Play,
        (lose_every, lose_run): (u64, u64),
    ) -> Self {
        Stream {
            play: Play {
                frame_secs: play.frame_secs * format.slower as f64,
                first_frame: play.first_frame.div_ceil(format.slower),
                origin: play.origin / format.slower,
                ..play
            },
            format,
            values,
            others: Vec::new(),
            plays_others: false,
            n_packets: 0,
            lose_every,
            lose_run,
            sequence: 0,
            packed: Vec::new(),
            packed_frame: None,
        }
    }

    /// The same stream with other frames, which it plays when it is told to.
    pub(crate) fn with_others(self, others: Vec<u16>) -> Self {
        Stream { others, ..self }
    }

    /// Whether the other frames are played from the next one on, if there are any.
    pub(crate) fn play_others(&mut self, plays_others: bool) {
        self.plays_others = plays_others && self.others.len() >= self.format.n_values;
    }

    fn frame(&self) -> u64 {
        self.play.first_frame + self.n_packets / self.format.n_packets()
    }

    /// The picture that the next packet is of, and the number of its stamp.
    pub(crate) fn picture(&self) -> u64 {
        self.frame() - self.play.origin
    }

    fn n_pictures(&self) -> u64 {
        (self.values.len() / self.format.n_values) as u64
    }

    /// When the next packet comes: the packets of a frame are spread over its time.
    pub(crate) fn due(&self) -> Duration {
        let per_frame = self.format.n_packets();
        let of_frame = (self.n_packets % per_frame + 1) as f64 / per_frame as f64;
        Duration::from_secs_f64((self.frame() as f64 + of_frame) * self.play.frame_secs)
    }

    /// Ticks since the device was plugged in, or since the first picture, when the frame of the next packet was taken.
    pub(crate) fn ticks(&self) -> u32 {
        (self.picture() * self.format.slower * TICKS_PER_FRAME) as u32
    }

    /// Whether the last picture has been played: the bus goes on, and the device has nothing to send.
    pub(crate) fn is_over(&self) -> bool {
        self.play.ends && self.picture() >= self.n_pictures()
    }

    /// The next packet comes and is written to `slot`; returns its length, 0 if it is lost on the way or there is nothing to send.
    pub(crate) fn packet(&mut self, ticks: u32, slot: &mut [u8]) -> usize {
        if self.is_over() {
            self.pass();
            return 0;
        }
        let number = self.n_packets % self.format.n_packets();
        let is_lost = self.lose_every > 0 && self.n_packets % self.lose_every < self.lose_run;
        let sequence = self.sequence;
        self.pack_frame();
        let start = number as usize * self.format.packet_bytes;
        let end = self.packed.len().min(start + self.format.packet_bytes);
        self.pass();
        if is_lost {
            return 0;
        }
        let data = &self.packed[start..end];
        let position = match number {
            0 => Position::First,
            number if number + 1 == self.format.n_packets() => Position::Last,
            _ => Position::Middle,
        };
        let header = header(self.format.flag, position, sequence, data.len(), ticks);
        slot[..HEADER_BYTES].copy_from_slice(&header);
        slot[HEADER_BYTES..HEADER_BYTES + data.len()].copy_from_slice(data);
        HEADER_BYTES + data.len()
    }

    /// The next packet comes and finds nobody.
    pub(crate) fn pass(&mut self) {
        self.n_packets += 1;
        self.sequence = self.sequence.wrapping_add(1);
    }

    fn pack_frame(&mut self) {
        let frame = self.picture();
        if self.packed_frame == Some(frame) {
            return;
        }
        let values = match self.plays_others {
            true => &self.others,
            false => &self.values,
        };
        let n_frames = (values.len() / self.format.n_values) as u64;
        if n_frames == 0 {
            self.packed.clear();
            self.packed.resize(self.format.frame_bytes(), 0);
        } else {
            let start = (frame % n_frames) as usize * self.format.n_values;
            let values = &values[start..start + self.format.n_values];
            pack(values, self.format.bits, &mut self.packed);
        }
        self.packed_frame = Some(frame);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packets_are_those_of_the_device() {
        assert_eq!(Format::DEPTH.n_packets(), 242);
        assert_eq!(Format::IR.n_packets(), 205);
        assert_eq!(Format::IR_HIGH.n_packets(), 859);
    }

    #[test]
    fn frames_begin_in_time_and_lose_what_they_are_told_to() {
        let play = Play {
            frame_secs: 1.0 / 30.0,
            first_frame: 2,
            origin: 0,
            ends: false,
        };
        let values = vec![3; Format::DEPTH.n_values];
        let mut stream = Stream::start(Format::DEPTH, values, play, (100, 2));
        assert_eq!(stream.ticks(), 4_000_000);
        let mut slot = [0; 1760];
        let lengths: Vec<usize> = (0..242).map(|_| stream.packet(0, &mut slot)).collect();
        let lost: Vec<usize> = (0..242).filter(|i| lengths[*i] == 0).collect();
        assert_eq!(lost, [0, 1, 100, 101, 200, 201]);
        assert_eq!(lengths[2], 1760);
        assert_eq!(lengths[241], HEADER_BYTES + 422_400 % 1748);
        let due = stream.due().as_secs_f64();
        assert!((due - (3.0 + 1.0 / 242.0) / 30.0).abs() < 1e-6, "{due}");
        // Played once, its second picture is the last.
        let play = Play {
            origin: 2,
            ends: true,
            ..play
        };
        let values = vec![3; 2 * Format::DEPTH.n_values];
        let mut stream = Stream::start(Format::DEPTH, values, play, (0, 1));
        assert_eq!(stream.ticks(), 0);
        assert!((0..2 * 242).all(|_| stream.packet(0, &mut slot) > 0));
        assert!(stream.is_over());
        // The transfers of a bus are filled in time, whether or not there is anything to send.
        let due = stream.due();
        assert!((0..16).all(|_| stream.packet(0, &mut slot) == 0));
        assert!(stream.due() > due);
    }
}
