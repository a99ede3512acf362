//! A plain row-major image.

/// A row-major image; pixel (u, v) is column u, row v, both from 0 at the top left.
#[derive(Clone, Debug, PartialEq)]
pub struct Image<T> {
    width: usize,
    height: usize,
    data: Vec<T>,
}

impl<T: Clone> Image<T> {
    /// An image of one value.
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        let data = vec![value; width * height];
        Image {
            width,
            height,
            data,
        }
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
        }
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
    pub fn into_vec(self) -> Vec<T> {
        self.data
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
        Image {
            width: self.width,
            height: self.height,
            data: self.data.iter().map(f).collect(),
        }
    }
}
