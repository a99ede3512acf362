//! Every frame accounted for: each one that the device produced is in one place, at every moment.

/// What became of the frames of a device, or where they are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameAccounts {
    /// Frames that came or were announced, damaged ones too.
    pub produced: u64,
    /// Frames in the model, or that were in it before the operator took them back.
    pub fused: u64,
    /// Frames whose pose was not found.
    pub lost: u64,
    /// Frames without depth in range.
    pub without_depth: u64,
    /// Frames that came while the scan was paused.
    pub paused: u64,
    /// Frames that came damaged.
    pub damaged: u64,
    /// Frames that fusion never saw because it was busy, or had ended.
    pub dropped: u64,
    /// Frames on their way to fusion, or in its hands.
    pub in_flight: u64,
    /// Frames, and infrared images that frames lack, which the driver had and let go: none of them is among those produced.
    pub missed: u64,
}

/// What can become of a frame that was on its way to fusion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    Fused,
    Lost,
    WithoutDepth,
    Paused,
    Dropped,
}

impl FrameAccounts {
    /// A frame came damaged.
    pub(super) fn damaged(&mut self) {
        self.produced += 1;
        self.damaged += 1;
    }

    /// A frame is on its way to fusion.
    pub(super) fn sent(&mut self) {
        self.produced += 1;
        self.in_flight += 1;
    }

    /// A frame that was on its way is in `place` now.
    pub(super) fn arrived(&mut self, place: Place) {
        self.in_flight = self.in_flight.saturating_sub(1);
        *match place {
            Place::Fused => &mut self.fused,
            Place::Lost => &mut self.lost,
            Place::WithoutDepth => &mut self.without_depth,
            Place::Paused => &mut self.paused,
            Place::Dropped => &mut self.dropped,
        } += 1;
    }

    /// Frames that fusion has handled, whatever became of them.
    pub fn handled(&self) -> u64 {
        self.fused + self.lost + self.without_depth + self.paused
    }

    /// Frames produced beyond those that are accounted for: 0 unless the program is wrong.
    pub fn unaccounted(&self) -> i64 {
        let accounted = self.handled() + self.damaged + self.dropped + self.in_flight;
        self.produced as i64 - accounted as i64
    }
}
