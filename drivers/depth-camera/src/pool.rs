//! Buffers that are used again, so that a stream of images allocates nothing once it runs.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use crate::Image;

/// Buffers of images; one handed out as an [`Image`] comes home when that image is dropped, on whatever thread.
///
/// More images may be out than the pool holds: buffers are made where there is none to spare, and those that find the pool full
/// are freed.
#[derive(Debug)]
pub struct ImagePool<T> {
    home: SyncSender<Vec<T>>,
    returned: Receiver<Vec<T>>,
}

impl<T: Clone + Default> ImagePool<T> {
    /// An empty pool that keeps at most `capacity` buffers.
    pub fn new(capacity: usize) -> Self {
        let (home, returned) = sync_channel(capacity);
        ImagePool { home, returned }
    }

    /// A buffer of `len` values, whatever they are.
    pub fn take(&self, len: usize) -> Vec<T> {
        let mut buffer = self.returned.try_recv().unwrap_or_default();
        buffer.resize(len, T::default());
        buffer
    }

    /// An image over a buffer, which comes home when the image is dropped; clones of the image do not.
    ///
    /// # Panics
    /// If `data` does not hold `width * height` values.
    pub fn image(&self, width: usize, height: usize, data: Vec<T>) -> Image<T> {
        Image::from_vec(width, height, data).with_home(self.home.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_image_lends_its_buffer_to_the_next() {
        let pool = ImagePool::<u16>::new(2);
        let data = pool.take(12);
        let address = data.as_ptr();
        let image = pool.image(4, 3, data).top_rows(2);
        assert_eq!((image.width(), image.height()), (4, 2));
        let clone = image.clone();
        std::thread::scope(|scope| {
            scope.spawn(|| drop(image));
        });
        drop(clone);
        let again = pool.take(12);
        assert_eq!(again.as_ptr(), address);
        assert_eq!(again.len(), 12);
        let other = pool.take(12);
        assert_ne!(other.as_ptr(), address);
    }

    #[test]
    fn a_full_pool_frees_what_comes_and_a_buffer_that_is_kept_never_comes() {
        let pool = ImagePool::<u16>::new(1);
        let images = [0, 1].map(|_| pool.image(1, 1, pool.take(1)));
        drop(images);
        assert_eq!(pool.returned.try_iter().count(), 1);
        let kept = pool.image(1, 1, vec![7]).into_vec();
        assert_eq!(kept, [7]);
        assert_eq!(pool.returned.try_iter().count(), 0);
        drop(pool.image(1, 1, vec![8]));
        let image = pool.image(1, 1, vec![9]);
        drop(pool);
        assert_eq!(image.data(), [9]);
    }
}
