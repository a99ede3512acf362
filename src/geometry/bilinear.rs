//! Values between the points of a grid, bilinear, at one place in double precision.
//!
//! Kernels that take many places at once in single precision have loops of their own, which become vector code, and between the middles
//! of square cells there is [`CellGrid`](super::CellGrid).

use depth_camera::Image;
use nalgebra::Vector2;

/// The four points of a grid, stored row by row, between which a place lies.
#[derive(Clone, Copy, Debug)]
pub struct Bilinear {
    /// Their indices: the upper left one, that beside it, and those below the two.
    pub corners: [usize; 4],
    /// How far the place lies to the right of the left ones and below the upper ones, 0 to 1.
    along: f64,
    down: f64,
}

impl Bilinear {
    /// Between the points of a grid of so many columns, for a place (column and row) above its last row and left of its last column.
    #[inline]
    pub fn new(place: &Vector2<f64>, columns: usize) -> Self {
        let (column, row) = (place.x as usize, place.y as usize);
        let first = row * columns + column;
        Bilinear {
            corners: [first, first + 1, first + columns, first + columns + 1],
            along: place.x - column as f64,
            down: place.y - row as f64,
        }
    }

    /// Between the pixels of an image; `None` for a place that four do not surround.
    #[inline]
    pub fn within<T>(image: &Image<T>, pixel: &Vector2<f64>) -> Option<Self> {
        let within = |x: f64, n: usize| x >= 0.0 && x < (n - 1) as f64;
        let is_inside = within(pixel.x, image.width()) && within(pixel.y, image.height());
        is_inside.then(|| Bilinear::new(pixel, image.width()))
    }

    /// The shares of 1 that the corners have of the place.
    #[inline]
    pub fn shares(&self) -> [f64; 4] {
        let Bilinear { along, down, .. } = *self;
        [
            (1.0 - along) * (1.0 - down),
            along * (1.0 - down),
            (1.0 - along) * down,
            along * down,
        ]
    }

    /// The value at the place, given those at the corners, and its gradient by column and row.
    #[inline]
    pub fn between(&self, [a, b, c, d]: [f64; 4]) -> (f64, [f64; 2]) {
        let (across, across_below) = (b - a, d - c);
        let (top, bottom) = (a + across * self.along, c + across_below * self.along);
        let value = top + (bottom - top) * self.down;
        let gradient = [across + (across_below - across) * self.down, bottom - top];
        (value, gradient)
    }
}

/// What an image shows between its pixels; `None` beyond the middles of the outermost ones.
pub fn bilinear(image: &Image<f32>, pixel: &Vector2<f64>) -> Option<f64> {
    let place = Bilinear::within(image, pixel)?;
    let corners = place.corners.map(|at| f64::from(image.data()[at]));
    Some(place.between(corners).0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_bilinear_is_met_with_its_gradient_and_by_the_shares_alike() {
        let truth = |u: f64, v: f64| 2.0 + 0.5 * u - 0.25 * v + 0.125 * u * v;
        let pixels = (0..3).flat_map(|v| (0..4).map(move |u| [u, v].map(f64::from)));
        let image = Image::from_vec(4, 3, pixels.map(|[u, v]| truth(u, v) as f32).collect());
        let values = |corners: [usize; 4]| corners.map(|at| f64::from(image.data()[at]));
        for (u, v) in [(0.0, 0.0), (1.25, 0.5), (2.875, 1.75), (0.5, 1.0)] {
            let pixel = Vector2::new(u, v);
            let place = Bilinear::within(&image, &pixel).expect("inside");
            let corners = values(place.corners);
            let (value, gradient) = place.between(corners);
            assert!((value - truth(u, v)).abs() < 1e-12);
            assert!((gradient[0] - (0.5 + 0.125 * v)).abs() < 1e-12);
            assert!((gradient[1] - (0.125 * u - 0.25)).abs() < 1e-12);
            let shared = place.shares().into_iter().zip(corners);
            let shared: f64 = shared.map(|(share, value)| share * value).sum();
            assert!((shared - value).abs() < 1e-12);
            assert_eq!(bilinear(&image, &pixel), Some(value));
        }
        for (u, v) in [(-0.1, 1.0), (3.0, 1.0), (1.0, 2.0), (f64::NAN, 1.0)] {
            assert_eq!(bilinear(&image, &Vector2::new(u, v)), None, "{u} {v}");
        }
    }
}
