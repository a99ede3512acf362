//! How many of a frame's packets came.
//!
//! libfreenect delivers a frame with lost packets like any other, the gap filled with what was there before, and gives up a
//! frame without a word after more than five lost packets in a row. What it does tell is each packet that it takes (the chunk
//! callbacks): they are counted here. A frame of which the last packets are missing is delivered only after the first packet of the
//! next frame was taken, over the old one's bytes; the ledger knows which of the two a delivery means.

use std::fmt;

/// How the frames of one stream travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PacketLayout {
    /// Bytes of a frame.
    pub frame_bytes: usize,
    /// Bytes that a packet carries, the last one of a frame fewer.
    pub packet_bytes: usize,
}

impl PacketLayout {
    /// Depth, 640×480 pixels of 11 bits: 242 packets.
    pub const DEPTH: PacketLayout = PacketLayout {
        frame_bytes: 640 * 480 * 11 / 8,
        packet_bytes: 1748,
    };

    /// IR, 640×488 pixels of 10 bits: 205 packets.
    pub const IR: PacketLayout = PacketLayout {
        frame_bytes: 640 * 488 * 10 / 8,
        packet_bytes: 1908,
    };

    /// IR, 1280×1024 pixels of 10 bits: 859 packets.
    pub const IR_HIGH: PacketLayout = PacketLayout {
        frame_bytes: 1280 * 1024 * 10 / 8,
        packet_bytes: 1908,
    };

    /// Packets of a frame.
    pub fn n_packets(&self) -> usize {
        self.frame_bytes.div_ceil(self.packet_bytes)
    }

    /// Where a packet's bytes belong in the frame; `None` for a packet that has no place there.
    pub fn place(&self, number: usize, bytes: usize) -> Option<std::ops::Range<usize>> {
        let start = number.checked_mul(self.packet_bytes)?;
        let end = start.checked_add(bytes)?;
        (bytes <= self.packet_bytes && end <= self.frame_bytes).then_some(start..end)
    }

    /// Bytes that a packet of this number must carry.
    fn expected_bytes(&self, number: usize) -> usize {
        let start = number * self.packet_bytes;
        self.packet_bytes
            .min(self.frame_bytes.saturating_sub(start))
    }
}

/// What a frame lacks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Damage {
    /// Packets that came whole.
    pub n_received: usize,
    /// Packets that a frame has.
    pub n_expected: usize,
}

impl Damage {
    /// Packets that did not come, or not whole.
    pub fn n_lost(&self) -> usize {
        self.n_expected - self.n_received
    }
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (lost, expected) = (self.n_lost(), self.n_expected);
        write!(f, "{lost} of {expected} packets lost")
    }
}

#[derive(Clone, Copy, Debug)]
struct Tally {
    n_whole: usize,
    newest: usize,
}

/// Counts the packets of the frames of one stream.
#[derive(Clone, Debug)]
pub struct PacketLedger {
    layout: PacketLayout,
    current: Option<Tally>,
    /// A frame that was begun before the current one and not delivered.
    before: Option<Tally>,
}

impl PacketLedger {
    /// Nothing has come yet.
    pub fn new(layout: PacketLayout) -> Self {
        PacketLedger {
            layout,
            current: None,
            before: None,
        }
    }

    /// How frames travel.
    pub fn layout(&self) -> PacketLayout {
        self.layout
    }

    /// A packet was taken; returns the damage of a frame that is now known to have been given up.
    pub fn packet(&mut self, number: usize, bytes: usize) -> Option<Damage> {
        let is_whole = bytes == self.layout.expected_bytes(number);
        let mut given_up = None;
        match &mut self.current {
            Some(tally) if number > tally.newest => {
                tally.newest = number;
                tally.n_whole += usize::from(is_whole);
            }
            current => {
                given_up = self.before.take();
                self.before = current.replace(Tally {
                    n_whole: usize::from(is_whole),
                    newest: number,
                });
            }
        }
        given_up.map(|tally| self.damage(tally))
    }

    /// A frame was delivered; returns its damage, and that of a frame before it that was given up.
    pub fn frame(&mut self) -> (Option<Damage>, Option<Damage>) {
        let is_complete = |tally: &Tally| tally.newest + 1 == self.layout.n_packets();
        let ends_now = self.current.as_ref().is_some_and(is_complete);
        let (delivered, given_up) = match self.before.take() {
            // The packets of the current frame have only just begun to come.
            Some(before) if !ends_now => (Some(before), None),
            before => (self.current.take(), before),
        };
        let nothing = Tally {
            n_whole: 0,
            newest: 0,
        };
        let damage = self.damage(delivered.unwrap_or(nothing));
        let is_damaged = damage.n_lost() > 0;
        (
            is_damaged.then_some(damage),
            given_up.map(|tally| self.damage(tally)),
        )
    }

    fn damage(&self, tally: Tally) -> Damage {
        Damage {
            n_received: tally.n_whole,
            n_expected: self.layout.n_packets(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAYOUT: PacketLayout = PacketLayout {
        frame_bytes: 95,
        packet_bytes: 10,
    };

    fn bytes(number: usize) -> usize {
        if number == 9 { 5 } else { 10 }
    }

    fn feed(ledger: &mut PacketLedger, numbers: impl IntoIterator<Item = usize>) -> Vec<Damage> {
        let given_up = numbers.into_iter();
        given_up
            .filter_map(|number| ledger.packet(number, bytes(number)))
            .collect()
    }

    fn lost(n_lost: usize) -> Damage {
        Damage {
            n_received: 10 - n_lost,
            n_expected: 10,
        }
    }

    #[test]
    fn layouts_are_those_of_the_device() {
        assert_eq!(PacketLayout::DEPTH.n_packets(), 242);
        assert_eq!(PacketLayout::IR.n_packets(), 205);
        assert_eq!(PacketLayout::IR_HIGH.n_packets(), 859);
        assert_eq!(LAYOUT.place(9, 5), Some(90..95));
        assert_eq!(LAYOUT.place(9, 6), None);
        assert_eq!(LAYOUT.place(0, 11), None);
        assert_eq!(LAYOUT.place(usize::MAX, 1), None);
    }

    #[test]
    fn whole_frames_are_whole() {
        let mut ledger = PacketLedger::new(LAYOUT);
        for _ in 0..3 {
            assert_eq!(feed(&mut ledger, 0..10), []);
            assert_eq!(ledger.frame(), (None, None));
        }
    }

    #[test]
    fn a_gap_and_a_short_packet_are_counted() {
        let mut ledger = PacketLedger::new(LAYOUT);
        feed(&mut ledger, [0, 1, 4, 5, 6, 7, 8, 9]);
        assert_eq!(ledger.frame(), (Some(lost(2)), None));
        feed(&mut ledger, 0..9);
        ledger.packet(9, 4);
        assert_eq!(ledger.frame(), (Some(lost(1)), None));
        feed(&mut ledger, 0..10);
        assert_eq!(ledger.frame(), (None, None));
    }

    #[test]
    fn a_frame_without_its_end_is_delivered_after_the_next_one_has_begun() {
        let mut ledger = PacketLedger::new(LAYOUT);
        feed(&mut ledger, 0..8);
        feed(&mut ledger, [1]);
        assert_eq!(ledger.frame(), (Some(lost(2)), None));
        feed(&mut ledger, 2..10);
        assert_eq!(ledger.frame(), (Some(lost(1)), None));
        feed(&mut ledger, 0..10);
        assert_eq!(ledger.frame(), (None, None));
    }

    #[test]
    fn a_frame_without_its_end_may_be_delivered_before_the_next_one_begins() {
        let mut ledger = PacketLedger::new(LAYOUT);
        feed(&mut ledger, 0..8);
        assert_eq!(ledger.frame(), (Some(lost(2)), None));
        feed(&mut ledger, 0..10);
        assert_eq!(ledger.frame(), (None, None));
    }

    #[test]
    fn frames_that_are_given_up_are_told_of() {
        let mut ledger = PacketLedger::new(LAYOUT);
        feed(&mut ledger, 0..3);
        assert_eq!(feed(&mut ledger, 0..10), []);
        assert_eq!(ledger.frame(), (None, Some(lost(7))));
        feed(&mut ledger, 0..3);
        feed(&mut ledger, 0..4);
        assert_eq!(feed(&mut ledger, 0..10), [lost(7)]);
        assert_eq!(ledger.frame(), (None, Some(lost(6))));
    }
}
