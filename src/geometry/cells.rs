//! An image cut into square cells, for what varies slowly over it.

use super::PixelSquare;
use super::lanes::{LANES, Lane, floor};
use depth_camera::Image;
use rayon::prelude::*;
use std::ops::{Add, Mul};

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
        let columns: Vec<(u32, u32, f32)> = (0..self.width)
            .map(|u| self.between(u as f32, self.columns))
            .collect();
        let mut out = vec![0.0f32; self.width * self.height];
        out.par_chunks_mut(self.width)
            .enumerate()
            .for_each(|(v, out)| {
                let (above, below, down) = self.between(v as f32, self.rows);
                let [above, below] =
                    [above, below].map(|row| &values[row as usize * self.columns..]);
                let row: Vec<f32> = (0..self.columns)
                    .map(|k| above[k] + (below[k] - above[k]) * down)
                    .collect();
                for (out, &(left, right, along)) in out.iter_mut().zip(&columns) {
                    let [left, right] = [left, right].map(|column| row[column as usize]);
                    *out = left + (right - left) * along;
                }
            });
        Image::from_vec(self.width, self.height, out)
    }

    /// The four cells whose middles lie around places on the image (columns and rows, pixels), with their bilinear shares of 1.
    #[inline(always)]
    pub fn around(&self, u: &Lane, v: &Lane) -> ([[u32; LANES]; 4], [Lane; 4]) {
        let (mut cells, mut shares) = ([[0; LANES]; 4], [[0.0; LANES]; 4]);
        let (left, right, along) = self.all_between(u, self.columns);
        let (above, below, down) = self.all_between(v, self.rows);
        let columns = self.columns as u32;
        for i in 0..LANES {
            let (above, below) = (above[i] * columns, below[i] * columns);
            cells[0][i] = above + left[i];
            cells[1][i] = above + right[i];
            cells[2][i] = below + left[i];
            cells[3][i] = below + right[i];
            shares[0][i] = (1.0 - along[i]) * (1.0 - down[i]);
            shares[1][i] = along[i] * (1.0 - down[i]);
            shares[2][i] = (1.0 - along[i]) * down[i];
            shares[3][i] = along[i] * down[i];
        }
        (cells, shares)
    }

    /// Gives cells without a value the mean of their neighbours, from the known ones outwards; all are 0 where none is known.
    pub fn filled<T>(&self, values: &[Option<T>]) -> Vec<T>
    where
        T: Copy + Default + Add<Output = T> + Mul<f32, Output = T>,
    {
        let mut cells = values.to_vec();
        let is_empty =
            |cells: &[Option<T>], index: &usize| cells.get(*index).is_some_and(Option::is_none);
        // Those beside known ones, then those beside these.
        let known = (0..cells.len()).filter(|index| !is_empty(&cells, index));
        let mut next: Vec<usize> = known.flat_map(|index| self.neighbours(index)).collect();
        loop {
            next.retain(|index| is_empty(&cells, index));
            next.sort_unstable();
            next.dedup();
            if next.is_empty() {
                break;
            }
            let means: Vec<Option<T>> = next
                .iter()
                .map(|&index| {
                    let beside = self.neighbours(index).filter_map(|k| *cells.get(k)?);
                    let (sum, n) =
                        beside.fold((T::default(), 0), |(sum, n), value| (sum + value, n + 1));
                    (n > 0).then(|| sum * (1.0 / n as f32))
                })
                .collect();
            for (&index, mean) in next.iter().zip(means) {
                cells[index] = mean;
            }
            next = next
                .iter()
                .flat_map(|&index| self.neighbours(index))
                .collect();
        }
        cells.into_iter().map(Option::unwrap_or_default).collect()
    }

    /// A cell and those up to `reach` columns and rows from it: nine for 1 but for the image's border.
    pub fn beside(&self, cell: usize, reach: usize) -> impl Iterator<Item = usize> + use<> {
        let (column, row) = (cell % self.columns, cell / self.columns);
        let columns = column.saturating_sub(reach)..(column + reach + 1).min(self.columns);
        let rows = row.saturating_sub(reach)..(row + reach + 1).min(self.rows);
        let n_columns = self.columns;
        rows.flat_map(move |row| columns.clone().map(move |column| row * n_columns + column))
    }

    /// The cell of a pixel; `None` in what is left over at the border.
    pub fn cell_of(&self, (u, v): (usize, usize)) -> Option<usize> {
        let (column, row) = (u / self.cell_px, v / self.cell_px);
        (column < self.columns && row < self.rows).then(|| row * self.columns + column)
    }

    /// Indices of the four neighbours, some of which may lie below the last row.
    fn neighbours(&self, index: usize) -> impl Iterator<Item = usize> {
        let column = index % self.columns;
        let beside = [
            (column > 0).then(|| index - 1),
            (column + 1 < self.columns).then_some(index + 1),
            index.checked_sub(self.columns),
            Some(index + self.columns),
        ];
        beside.into_iter().flatten()
    }

    /// The cells before and after a pixel along one side, and how far it lies between their middles.
    #[inline(always)]
    fn between(&self, pixel: f32, n: usize) -> (u32, u32, f32) {
        let last = n as u32 - 1;
        let place = (pixel + 0.5) / self.cell_px as f32 - 0.5;
        let place = place.max(0.0).min(last as f32);
        let first = floor(place) as u32;
        (first, (first + 1).min(last), place - first as f32)
    }

    /// [`Self::between`] of many pixels.
    #[inline(always)]
    fn all_between(&self, pixels: &Lane, n: usize) -> ([u32; LANES], [u32; LANES], Lane) {
        let (mut first, mut next, mut along) = ([0; LANES], [0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            (first[i], next[i], along[i]) = self.between(pixels[i], n);
        }
        (first, next, along)
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
        let (around, shares) = cells.around(&[123.0; LANES], &[77.0; LANES]);
        let around = around.iter().zip(shares);
        let mixed: f32 = around
            .map(|(cell, share)| values[cell[3] as usize] * share[3])
            .sum();
        assert!((mixed - image.at(123, 77)).abs() < 1e-4);
    }

    #[test]
    fn a_pixel_lies_in_its_cell_and_a_cell_touches_those_around_it() {
        let cells = CellGrid::new(43, 24, 4);
        assert_eq!((cells.columns(), cells.rows()), (4, 2));
        for cell in 0..cells.n_cells() {
            assert_eq!(cells.cell_of(cells.middle(cell)), Some(cell));
        }
        assert_eq!(
            (cells.cell_of((40, 3)), cells.cell_of((3, 20))),
            (None, None)
        );
        assert_eq!(cells.beside(0, 1).collect::<Vec<_>>(), [0, 1, 4, 5]);
        assert_eq!(cells.beside(6, 1).collect::<Vec<_>>(), [1, 2, 3, 5, 6, 7]);
        assert_eq!(cells.beside(0, 2).collect::<Vec<_>>(), [0, 1, 2, 4, 5, 6]);
    }

    #[test]
    fn cells_without_a_value_have_that_of_their_neighbours() {
        let cells = CellGrid::new(40, 20, 4);
        assert_eq!(cells.filled(&[None::<f32>; 8]), [0.0; 8]);
        let values = [Some(1.0), None, Some(3.0), None, None, None, None, None];
        assert_eq!(
            cells.filled(&values),
            [1.0, 2.0, 3.0, 3.0, 1.0, 2.0, 3.0, 3.0]
        );
    }
}
