//! Frames on their way to several threads, without asking for memory once they flow.

use depth_camera::{Frame, Image, ImagePool};
use std::sync::Arc;

/// As many frames as are under way where fusion keeps up: those in its channel, the one it works on, a new one, and some for the
/// recorder. More are under way only where one of them does not keep up; then memory is asked for.
const N_SLOTS: usize = 8;

/// Shares frames, and uses what nobody holds any more for the next one.
#[derive(Debug)]
pub struct SharedFrames {
    slots: Vec<Arc<Frame>>,
    depth: ImagePool<f32>,
    ir: ImagePool<u16>,
}

impl Default for SharedFrames {
    fn default() -> Self {
        SharedFrames {
            slots: Vec::with_capacity(N_SLOTS),
            depth: ImagePool::new(N_SLOTS),
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

    /// A frame like that one, to be changed.
    pub fn copy_of(&self, frame: &Frame) -> Frame {
        Frame {
            depth: frame.depth.as_ref().map(|image| copy(&self.depth, image)),
            ir: frame.ir.as_ref().map(|image| copy(&self.ir, image)),
            ..*frame
        }
    }
}

fn copy<T: Copy + Default>(pool: &ImagePool<T>, image: &Image<T>) -> Image<T> {
    let mut data = pool.take(image.data().len());
    data.copy_from_slice(image.data());
    pool.image(image.width(), image.height(), data)
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
    fn a_copy_is_the_same_in_memory_of_its_own() {
        let frames = SharedFrames::default();
        let original = frame(7);
        let mut copy = frames.copy_of(&original);
        assert_eq!(copy.depth, original.depth);
        assert_eq!(copy.frame_id, 7);
        copy.depth.as_mut().unwrap().data_mut()[0] = 0.0;
        assert_ne!(copy.depth, original.depth);
    }
}
