//! Frames whose IR image does not lie on the depth image's pixel grid, as a raw Kinect I delivers them.

use depth_camera::{Frame, Image};

/// Moves IR images onto the grid of the depth images by whole pixels: what is left, half a pixel at most, refinement's
/// alignment of views takes up. The camera's intrinsics are those of the depth grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct IrOffset {
    /// How far right of and below its place in the depth image a point lies in the IR image, pixels.
    right: isize,
    down: isize,
}

impl IrOffset {
    /// The nearest whole pixels of a measured offset (right, down).
    pub fn nearest([right_px, down_px]: [f64; 2]) -> Self {
        IrOffset {
            right: right_px.round() as isize,
            down: down_px.round() as isize,
        }
    }

    /// Whether nothing has to be moved.
    pub fn is_zero(self) -> bool {
        (self.right, self.down) == (0, 0)
    }

    /// The frame with its IR on the depth image's grid, moved in place; what the IR image does not show is black, which nothing
    /// uses.
    pub fn remove_from(self, mut frame: Frame) -> Frame {
        if let Some(ir) = frame.ir.as_mut().filter(|_| !self.is_zero()) {
            self.move_content(ir);
        }
        frame
    }

    fn move_content(self, ir: &mut Image<u16>) {
        let (width, height) = (ir.width(), ir.height());
        let mut move_row = |v| self.move_row(v, width, height, ir.data_mut());
        // A row is read before it is written.
        match self.down >= 0 {
            true => (0..height).for_each(&mut move_row),
            false => (0..height).rev().for_each(&mut move_row),
        }
    }

    fn move_row(self, v: usize, width: usize, height: usize, data: &mut [u16]) {
        // Columns that have a source: from `start` up to `end`.
        let start = self.right.min(0).unsigned_abs().min(width);
        let end = width.saturating_sub(self.right.max(0).unsigned_abs());
        let from = v.checked_add_signed(self.down).filter(|v| *v < height);
        let Some(from) = from.filter(|_| start < end) else {
            return data[v * width..(v + 1) * width].fill(0);
        };
        let source = from * width + start.saturating_add_signed(self.right);
        data.copy_within(source..source + end - start, v * width + start);
        data[v * width..v * width + start].fill(0);
        data[v * width + end..(v + 1) * width].fill(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Instant;

    fn frame(ir: Option<Image<u16>>) -> Frame {
        Frame {
            frame_id: 3,
            device_time_secs: 1.0,
            host_time: Instant::now(),
            depth: Some(Image::filled(4, 3, 0.5)),
            ir,
        }
    }

    #[test]
    fn content_moves_by_the_nearest_whole_pixels() {
        let ir = Image::from_vec(4, 3, (1..=12).collect());
        let moved = |offset| IrOffset::nearest(offset).remove_from(frame(Some(ir.clone())));
        let expected = [6, 7, 8, 0, 10, 11, 12, 0, 0, 0, 0, 0];
        let there = moved([1.4, 0.6]);
        assert_eq!(there.ir.as_ref().unwrap().data(), expected);
        assert_eq!(there.depth, frame(None).depth);
        let expected = [0, 0, 0, 0, 0, 1, 2, 3, 0, 5, 6, 7];
        assert_eq!(moved([-1.0, -1.0]).ir.as_ref().unwrap().data(), expected);
        assert_eq!(moved([0.4, -0.4]).ir.as_ref(), Some(&ir));
        assert!(
            moved([20.0, 0.0])
                .ir
                .as_ref()
                .unwrap()
                .data()
                .iter()
                .all(|c| *c == 0)
        );
    }

    #[test]
    fn a_frame_without_infrared_is_left_alone() {
        let there = IrOffset::nearest([5.0, 4.0]).remove_from(frame(None));
        assert!(there.ir.is_none() && there.depth.is_some());
    }
}
