//! The levels of one frame: depth, rays and normals in planes of their own, kept from frame to frame.

use crate::geometry::Lens;
use crate::geometry::lanes::{LANES, Lane};
use crate::geometry::{CameraModel, RayGrid};

/// How many reduced levels there are.
pub const N_REDUCED: usize = 3;

/// Rows of one tile.
const TILE_ROWS: usize = 8;

/// The rays (X/Z, Y/Z) of an image's pixels in two planes; NaN where the lens has none.
#[derive(Clone, Debug)]
pub struct RayPlanes {
    /// Columns of the image.
    pub width: usize,
    /// Rows of the image.
    pub height: usize,
    /// X/Z, row by row.
    pub x: Vec<f32>,
    /// Y/Z, row by row.
    pub y: Vec<f32>,
}

impl RayPlanes {
    fn new(rays: &RayGrid) -> Self {
        let image = rays.rays();
        let plane = |axis: usize| image.data().iter().map(|ray| ray[axis]).collect();
        RayPlanes {
            width: image.width(),
            height: image.height(),
            x: plane(0),
            y: plane(1),
        }
    }
}

/// One reduced level of a frame.
#[derive(Clone, Debug)]
pub struct Level {
    /// The level's rays.
    pub rays: RayPlanes,
    /// The level's camera, for projection.
    pub lens: Lens,
    /// Distance between neighbouring rays at unit depth.
    pub pitch: f32,
    /// Depth, metres; 0 where there is none.
    pub depth: Vec<f32>,
    /// Unit normals towards the camera, x, y and z; zero where there is none.
    pub normals: [Vec<f32>; 3],
}

impl Level {
    fn new(camera: CameraModel) -> Self {
        let rays = RayPlanes::new(&RayGrid::new(camera));
        let n_pixels = rays.x.len();
        Level {
            lens: Lens::new(&camera),
            pitch: 1.0 / camera.intrinsics().fx as f32,
            depth: vec![0.0; n_pixels],
            normals: std::array::from_fn(|_| vec![0.0; n_pixels]),
            rays,
        }
    }

    /// How many tiles the level has.
    pub fn n_tiles(&self) -> usize {
        self.rays.height.div_ceil(TILE_ROWS)
    }

    /// The pixels of a tile; what is summed over a level is summed tile by tile.
    pub fn tile(&self, tile: usize) -> std::ops::Range<usize> {
        let first = tile * TILE_ROWS * self.rays.width;
        first..(first + TILE_ROWS * self.rays.width).min(self.depth.len())
    }

    /// A pixel's point in the camera frame (m); at the origin where there is no depth.
    #[inline(always)]
    pub fn point(&self, pixel: usize) -> [f32; 3] {
        let z = self.depth[pixel];
        [self.rays.x[pixel] * z, self.rays.y[pixel] * z, z]
    }
}

/// Values of `LANES` pixels of a plane from `first` on; 0 beyond its end.
#[inline(always)]
pub fn lane(plane: &[f32], first: usize) -> Lane {
    let mut lane = [0.0; LANES];
    let cells = &plane[first..plane.len().min(first + LANES)];
    match cells.first_chunk::<LANES>() {
        Some(cells) => lane = *cells,
        None => lane[..cells.len()].copy_from_slice(cells),
    }
    lane
}

/// The levels of one frame.
#[derive(Clone, Debug)]
pub struct FramePyramid {
    /// Rays of the whole image.
    pub rays: RayPlanes,
    /// Depth of the whole image within the working range, metres; 0 where there is none.
    pub depth: Vec<f32>,
    /// The image reduced by 2, 4 and 8.
    pub reduced: [Level; N_REDUCED],
    /// The image reduced by 2 before it is smoothed.
    pub(super) rough_half: Vec<f32>,
    median_depth_m: f32,
    /// Where depths are sorted.
    sorted: Vec<f32>,
}

impl FramePyramid {
    /// Median depth of the coarsest level, metres; 1 if it has none.
    pub fn median_depth_m(&self) -> f32 {
        self.median_depth_m
    }

    /// Takes up the median depth of the levels as they now are.
    pub(super) fn measure_depth(&mut self) {
        let coarsest = &self.reduced[N_REDUCED - 1].depth;
        self.sorted.clear();
        let measured = coarsest.iter().copied().filter(|z| *z > 0.0);
        self.sorted.extend(measured);
        let middle = self.sorted.len() / 2;
        self.median_depth_m = match self.sorted.is_empty() {
            true => 1.0,
            false => *self.sorted.select_nth_unstable_by(middle, f32::total_cmp).1,
        };
    }

    /// An empty frame of a camera.
    pub fn new(camera: &CameraModel) -> Self {
        let rays = RayPlanes::new(&RayGrid::new(*camera));
        let reduced = std::array::from_fn(|level| Level::new(camera.reduced(2 << level)));
        FramePyramid {
            depth: vec![0.0; rays.x.len()],
            rough_half: vec![0.0; reduced[0].depth.len()],
            median_depth_m: 1.0,
            sorted: Vec::with_capacity(reduced[N_REDUCED - 1].depth.len()),
            rays,
            reduced,
        }
    }
}
