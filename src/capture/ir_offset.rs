//! Frames whose IR image does not lie on the depth image's pixel grid, as a raw Kinect I delivers them.

use depth_camera::{Frame, Image};
use std::sync::Arc;

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

    /// The frame with its IR on the depth image's grid; what the IR image does not show is black, which nothing uses.
    pub fn remove_from(self, frame: Arc<Frame>) -> Arc<Frame> {
        match &frame.ir {
            Some(ir) if (self.right, self.down) != (0, 0) => Arc::new(Frame {
                ir: Some(self.moved(ir)),
                depth: frame.depth.clone(),
                ..*frame
            }),
            _ => frame,
        }
    }

    fn moved(self, ir: &Image<u16>) -> Image<u16> {
        let (width, height) = (ir.width(), ir.height());
        let mut moved = Image::filled(width, height, 0);
        for v in 0..height {
            let Some(from) = v.checked_add_signed(self.down).filter(|v| *v < height) else {
                continue;
            };
            let row = &mut moved.data_mut()[v * width..(v + 1) * width];
            for (u, value) in row.iter_mut().enumerate() {
                if let Some(from_u) = u.checked_add_signed(self.right).filter(|u| *u < width) {
                    *value = *ir.at(from_u, from);
                }
            }
        }
        moved
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Instant;

    fn frame(ir: Option<Image<u16>>) -> Arc<Frame> {
        Arc::new(Frame {
            frame_id: 3,
            device_time_secs: 1.0,
            host_time: Instant::now(),
            depth: Some(Image::filled(4, 3, 0.5)),
            ir,
        })
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
