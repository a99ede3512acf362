//! A plain row-major image.

use std::{fmt, mem, sync::mpsc::SyncSender};

/// A row-major image; pixel (u, v) is column u, row v, both from 0 at the top left.
pub struct Image<T> {
    width: usize,
    height: usize,
    data: Vec<T>,
    /// Where the buffer goes when the image is dropped, if it is one of an [`crate::ImagePool`].
    home: Option<SyncSender<Vec<T>>>,
}

impl<T: Clone> Image<T> {
    /// An image of one value.
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Self::from_vec(width, height, vec![value; width * height])
    }
}

impl<T> Image<T> {
    /// An image over `data`, row by row.
    ///
    /// # Panics
    /// If `data` does not hold `width * height` values.
    pub fn from_vec(width: usize, height: usize, data: Vec<T>) -> Self {
        assert_eq!(
            data.len(),
            width * height,
            "image data does not fill {width}×{height}"
        );
        Image {
            width,
            height,
            data,
            home: None,
        }
    }

    /// The same image, whose buffer goes `home` when it is dropped.
    pub(crate) fn with_home(mut self, home: SyncSender<Vec<T>>) -> Self {
        self.home = Some(home);
        self
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All pixels, row by row.
    pub fn data(&self) -> &[T] {
        &self.data
    }

    /// All pixels, row by row.
    pub fn data_mut(&mut self) -> &mut [T] {
        &mut self.data
    }

    /// The pixels, row by row, without the image.
    pub fn into_vec(mut self) -> Vec<T> {
        self.home = None;
        mem::take(&mut self.data)
    }

    /// The image without what lies below its first `height` rows; nothing is copied.
    ///
    /// # Panics
    /// If the image has fewer rows.
    pub fn top_rows(mut self, height: usize) -> Self {
        assert!(height <= self.height, "the image has fewer rows");
        self.height = height;
        self.data.truncate(self.width * height);
        self
    }

    /// One row.
    pub fn row(&self, v: usize) -> &[T] {
        &self.data[v * self.width..(v + 1) * self.width]
    }

    /// One pixel.
    ///
    /// # Panics
    /// If the pixel lies outside.
    pub fn at(&self, u: usize, v: usize) -> &T {
        debug_assert!(u < self.width);
        &self.data[v * self.width + u]
    }

    /// Applies `f` to every pixel.
    pub fn map<U>(&self, f: impl FnMut(&T) -> U) -> Image<U> {
        Image::from_vec(self.width, self.height, self.data.iter().map(f).collect())
    }
}

impl<T> Drop for Image<T> {
    fn drop(&mut self) {
        if let Some(home) = self.home.take() {
            // A pool that is full or gone frees the buffer.
            let _ = home.try_send(mem::take(&mut self.data));
        }
    }
}

impl<T: Clone> Clone for Image<T> {
    fn clone(&self) -> Self {
        Self::from_vec(self.width, self.height, self.data.clone())
    }
}

impl<T: PartialEq> PartialEq for Image<T> {
    fn eq(&self, other: &Self) -> bool {
        (self.width, self.height) == (other.width, other.height) && self.data == other.data
    }
}

impl<T: fmt::Debug> fmt::Debug for Image<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Image")
            .field("width", &self.width)
            .field("height", &self.height)
            .field("data", &self.data)
            .finish()
    }
}
