//! Frames on their way to several threads, without asking for memory once they flow.

use super::IrOffset;
use depth_camera::{Frame, Image, ImagePool};
use std::sync::Arc;

/// As many frames as are under way where fusion keeps up: those in its channel, the one it works on, a new one, and some for the
/// recorder. More are under way only where one of them does not keep up; then memory is asked for.
const N_SLOTS: usize = 8;

/// Shares frames, and uses what nobody holds any more for the next one.
#[derive(Debug)]
pub struct SharedFrames {
    slots: Vec<Arc<Frame>>,
    /// Of copies.
    ir: ImagePool<u16>,
}

impl Default for SharedFrames {
    fn default() -> Self {
        SharedFrames {
            slots: Vec::with_capacity(N_SLOTS),
            ir: ImagePool::new(N_SLOTS),
        }
    }
}

impl SharedFrames {
    /// The frame, to be held by several.
    pub fn share(&mut self, frame: Frame) -> Arc<Frame> {
        for slot in &mut self.slots {
            if let Some(free) = Arc::get_mut(slot) {
                *free = frame;
                return slot.clone();
            }
        }
        let shared = Arc::new(frame);
        if self.slots.len() < N_SLOTS {
            self.slots.push(shared.clone());
        }
        shared
    }

    /// The frame with its IR on the depth image's grid, and its IR as it was delivered beside it.
    ///
    /// Depth is never copied; IR once, if it is moved.
    pub fn share_without(&mut self, offset: IrOffset, frame: Frame) -> DeliveredFrame {
        let as_delivered = match &frame.ir {
            Some(ir) if !offset.is_zero() => Frame {
                depth: None,
                ir: Some(self.copy(ir)),
                ..frame
            },
            _ => return DeliveredFrame::unmoved(self.share(frame)),
        };
        DeliveredFrame {
            ir: Some(self.share(as_delivered)),
            frame: self.share(offset.remove_from(frame)),
        }
    }

    fn copy(&self, ir: &Image<u16>) -> Image<u16> {
        let mut data = self.ir.take(ir.data().len());
        data.copy_from_slice(ir.data());
        self.ir.image(ir.width(), ir.height(), data)
    }
}

/// A frame as the recorder gets it, with the IR image that the camera delivered; others hold its images too.
#[derive(Clone, Debug)]
pub struct DeliveredFrame {
    /// Its number, times and depth; its IR may have been moved.
    pub frame: Arc<Frame>,
    /// A frame of the same number and times that holds IR as it was delivered; `None` if there is none, or it is left out.
    pub ir: Option<Arc<Frame>>,
}

impl DeliveredFrame {
    /// A frame whose IR was not moved.
    pub fn unmoved(frame: Arc<Frame>) -> Self {
        DeliveredFrame {
            ir: frame.ir.is_some().then(|| frame.clone()),
            frame,
        }
    }

    /// IR as it was delivered.
    pub fn infrared(&self) -> Option<&Image<u16>> {
        self.ir.as_ref()?.ir.as_ref()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Instant;

    fn frame(frame_id: u64) -> Frame {
        Frame {
            frame_id,
            device_time_secs: 0.1,
            host_time: Instant::now(),
            depth: Some(Image::filled(2, 2, frame_id as f32)),
            ir: None,
        }
    }

    #[test]
    fn what_nobody_holds_is_used_again_and_what_is_held_stays() {
        let mut frames = SharedFrames::default();
        let held = frames.share(frame(1));
        let let_go = Arc::as_ptr(&frames.share(frame(2)));
        let next = frames.share(frame(3));
        assert_eq!(Arc::as_ptr(&next), let_go);
        assert_eq!((held.frame_id, next.frame_id), (1, 3));
        let many: Vec<_> = (4..40).map(|id| frames.share(frame(id))).collect();
        assert!(
            many.iter()
                .zip(4..)
                .all(|(shared, id)| shared.frame_id == id)
        );
        assert_eq!(frames.slots.len(), N_SLOTS);
    }

    #[test]
    fn infrared_that_is_moved_is_copied_and_nothing_else_is() {
        let whole = || Frame {
            ir: Some(Image::from_vec(2, 2, vec![1, 2, 3, 4])),
            ..frame(7)
        };
        let mut frames = SharedFrames::default();
        let sent = whole();
        let depth = sent.depth.as_ref().unwrap().data().as_ptr();
        let delivered = frames.share_without(IrOffset::nearest([1.0, 1.0]), sent);
        let shared = delivered.frame.depth.as_ref().unwrap();
        assert_eq!(shared.data().as_ptr(), depth);
        assert_eq!(delivered.frame.ir.as_ref().unwrap().data(), [4, 0, 0, 0]);
        assert_eq!(delivered.infrared().unwrap().data(), [1, 2, 3, 4]);
        let ir = delivered.ir.unwrap();
        assert_eq!((ir.frame_id, ir.depth.is_none()), (7, true));

        let delivered = frames.share_without(IrOffset::nearest([0.0, 0.0]), whole());
        let ir = delivered.ir.unwrap();
        assert!(Arc::ptr_eq(&ir, &delivered.frame));
        let delivered = frames.share_without(IrOffset::nearest([1.0, 1.0]), frame(8));
        assert!(delivered.ir.is_none() && delivered.frame.depth.is_some());
    }
}
