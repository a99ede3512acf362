//! An image cut into square cells, for what varies slowly over it.

use super::PixelSquare;
use depth_camera::Image;
use rayon::prelude::*;

/// Square cells that cover an image but for what is left over at its right and lower border.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CellGrid {
    width: usize,
    height: usize,
    columns: usize,
    rows: usize,
    cell_px: usize,
}

impl CellGrid {
    /// Cuts an image of `width` by `height` pixels into about so many columns.
    pub fn new(width: usize, height: usize, columns: usize) -> Self {
        let cell_px = (width / columns).max(1);
        CellGrid {
            width,
            height,
            columns: width / cell_px,
            rows: height / cell_px,
            cell_px,
        }
    }

    /// Cells in a row.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Rows of cells.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Cells in all, row by row.
    pub fn n_cells(&self) -> usize {
        self.columns * self.rows
    }

    /// Side of a cell, pixels.
    pub fn cell_px(&self) -> usize {
        self.cell_px
    }

    /// The pixels of a cell of which every `step`-th is looked at in both directions.
    pub fn square(&self, cell: usize, step: usize) -> PixelSquare {
        PixelSquare {
            u: cell % self.columns * self.cell_px,
            v: cell / self.columns * self.cell_px,
            side: self.cell_px,
            step,
        }
    }

    /// The pixel in the middle of a cell.
    pub fn middle(&self, cell: usize) -> (usize, usize) {
        let PixelSquare { u, v, side, .. } = self.square(cell, 1);
        (u + side / 2, v + side / 2)
    }

    /// One value a cell spread over the image's pixels, bilinear between the cells' middles and constant beyond them.
    ///
    /// # Panics
    /// Unless there is one value for each cell.
    pub fn spread(&self, values: &[f32]) -> Image<f32> {
        assert_eq!(values.len(), self.n_cells(), "one value a cell");
        let mut out = vec![0.0f32; self.width * self.height];
        out.par_chunks_mut(self.width)
            .enumerate()
            .for_each(|(v, out)| {
                let (above, below, down) = self.between(v, self.rows);
                let [above, below] = [above, below].map(|row| &values[row * self.columns..]);
                let row: Vec<f32> = (0..self.columns)
                    .map(|k| above[k] + (below[k] - above[k]) * down)
                    .collect();
                for (u, out) in out.iter_mut().enumerate() {
                    let (left, right, along) = self.between(u, self.columns);
                    *out = row[left] + (row[right] - row[left]) * along;
                }
            });
        Image::from_vec(self.width, self.height, out)
    }

    /// The cells before and after a pixel along one side, and how far it lies between their middles.
    fn between(&self, pixel: usize, n: usize) -> (usize, usize, f32) {
        let place = (pixel as f32 + 0.5) / self.cell_px as f32 - 0.5;
        let place = place.clamp(0.0, (n - 1) as f32);
        let first = place as usize;
        (first, (first + 1).min(n - 1), place - first as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_linear_over_the_cells_is_linear_over_the_pixels_between_their_middles() {
        let cells = CellGrid::new(512, 424, 32);
        assert_eq!(
            (cells.columns(), cells.rows(), cells.cell_px()),
            (32, 26, 16)
        );
        let linear = |u: f32, v: f32| 0.3 * u - 0.7 * v + 2.0;
        let values: Vec<f32> = (0..cells.n_cells())
            .map(|cell| {
                let PixelSquare { u, v, side, .. } = cells.square(cell, 1);
                let middle = (side as f32 - 1.0) / 2.0;
                linear(u as f32 + middle, v as f32 + middle)
            })
            .collect();
        let image = cells.spread(&values);
        for (u, v) in [(8, 8), (100, 57), (311, 200), (490, 400)] {
            assert!(
                (image.at(u, v) - linear(u as f32, v as f32)).abs() < 1e-3,
                "{u} {v}"
            );
        }
        assert_eq!(image.at(0, 0), image.at(7, 7));
    }
}
