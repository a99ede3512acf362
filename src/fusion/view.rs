//! The voxel grid as a camera sees it, a brick at a time.
//!
//! Within a brick the lens is linear, so that column times depth, row times depth and depth itself grow by the same step from
//! voxel to voxel: a voxel's pixel costs one division.

use super::block::{BLOCK_SIDE, BRICK_SIDE, BRICK_VOXELS, BRICKS, BlockCoord, WEIGHT_ONE};
use super::noise::DepthNoise;
use super::volume::TsdfVolume;
use crate::geometry::Lens;
use crate::geometry::Pose;
use nalgebra::{Matrix3, Vector3};
use std::ops::RangeInclusive;

/// From a brick's centre to its outermost voxels, in voxels.
const HALF_BRICK: f32 = 0.5 * (BRICK_SIDE - 1) as f32;
/// Nearer bricks are not seen, metres: no sensor measures there, and a brick must lie before the camera as a whole.
const MIN_DEPTH_M: f32 = 0.01;
/// What rounding may add to a brick's place in the image, pixels.
const ROUNDING_PX: f32 = 0.01;

/// The grid of a volume from a pose.
#[derive(Clone, Debug)]
pub struct View {
    lens: Lens,
    truncation_m: f32,
    weight: f32,
    /// Where it looks through what it sees: the noise of what would be measured there instead.
    looks_through: Option<DepthNoise>,
    /// World origin in the camera frame, metres.
    origin: Vector3<f64>,
    /// Columns are the steps from voxel to voxel along the world's axes, in the camera frame, metres.
    axes: Matrix3<f64>,
    /// The same by axis.
    steps: [[f32; 3]; 3],
    /// Centres of a block's bricks from its first voxel, x, y and z in the camera frame, metres.
    centres: [[f32; BRICKS]; 3],
    /// From a brick's centre to its nearest and farthest voxel along the optical axis, metres.
    half_depth_m: f32,
}

/// The bricks of a block in an image.
pub struct Bricks {
    /// Column times depth, row times depth, and depth (m) of each brick's first voxel.
    first: [[f32; BRICKS]; 3],
    /// What is added to them from voxel to voxel, by axis.
    steps: [[[f32; BRICKS]; 3]; 3],
    /// Depth of the centre, metres.
    depth: [f32; BRICKS],
    /// First and last column and row that voxels may have.
    columns: [[f32; BRICKS]; 2],
    rows: [[f32; BRICKS]; 2],
    projects: [bool; BRICKS],
    half_depth_m: f32,
}

/// The part of the image that a brick's voxels may fall on, and their depth.
pub struct Extent {
    /// Pixel columns.
    pub columns: RangeInclusive<usize>,
    /// Pixel rows.
    pub rows: RangeInclusive<usize>,
    /// Least depth, metres.
    pub near_m: f32,
    /// Largest depth, metres.
    pub far_m: f32,
}

impl View {
    /// The grid of a volume from a pose.
    pub fn new(volume: &TsdfVolume, lens: Lens, world_from_camera: &Pose) -> Self {
        let camera_from_world = world_from_camera.inverse();
        let rotation = camera_from_world.rotation.to_rotation_matrix();
        let axes = rotation.matrix() * f64::from(volume.voxel_size_m());
        let centre = |brick: usize| {
            let along =
                |axis: usize| f64::from(HALF_BRICK) + (BRICK_SIDE * (brick >> axis & 1)) as f64;
            axes * Vector3::new(along(0), along(1), along(2))
        };
        let half_depth = axes.row(2).abs().sum() * f64::from(HALF_BRICK);
        View {
            lens,
            truncation_m: volume.truncation_m(),
            weight: 1.0,
            looks_through: None,
            origin: camera_from_world.translation.vector,
            steps: axes.cast::<f32>().into(),
            centres: std::array::from_fn(|axis| {
                std::array::from_fn(|brick| centre(brick)[axis] as f32)
            }),
            half_depth_m: half_depth as f32,
            axes,
        }
    }

    /// Distance at which the volume's signed distances are cut off, metres.
    #[inline(always)]
    pub fn truncation_m(&self) -> f32 {
        self.truncation_m
    }

    /// For so many frames the frame counts.
    #[inline(always)]
    pub fn weight(&self) -> f32 {
        self.weight
    }

    /// The same for a frame that counts for `weight` frames.
    pub fn counting(&self, weight: f32) -> Self {
        View {
            weight,
            ..self.clone()
        }
    }

    /// The same for voxels in free space, which are told of it with the weight of a surface there that faces the camera: what is farther off
    /// is measured less well, but that it is farther is certain.
    pub fn looking_through(&self, noise: DepthNoise) -> Self {
        View {
            looks_through: Some(noise),
            ..self.clone()
        }
    }

    /// What the frame counts for in a brick's voxels where it looks through them, in units of [`WEIGHT_ONE`]; `None` where it does not.
    #[inline(always)]
    pub fn weight_looking_through(&self, bricks: &Bricks, brick: usize) -> Option<f32> {
        self.looks_through.map(|noise| {
            let precision = noise.precision(noise.sigma_m(bricks.depth[brick]));
            WEIGHT_ONE * precision * precision * self.weight
        })
    }

    /// Pixel on which the middle of a block falls, the number of pixels where there is none, and its depth (m).
    #[inline(always)]
    pub fn centre(&self, coord: BlockCoord) -> (u32, f32) {
        let mut centre = [0, 1, 2].map(|axis| self.origin[axis] as f32);
        for (c, step) in coord.iter().zip(&self.steps) {
            let along = (*c as f32 + 0.5) * BLOCK_SIDE as f32;
            for axis in 0..3 {
                centre[axis] += along * step[axis];
            }
        }
        (self.lens.pixel_index(centre), centre[2])
    }

    /// A part of the image with so many pixels more on each side.
    #[inline(always)]
    pub fn widened(&self, extent: Extent, by: usize) -> Extent {
        let [last_column, last_row] = self.lens.last().map(|last| last as usize);
        let widened = |range: RangeInclusive<usize>, last: usize| {
            range.start().saturating_sub(by)..=(range.end() + by).min(last)
        };
        Extent {
            columns: widened(extent.columns, last_column),
            rows: widened(extent.rows, last_row),
            ..extent
        }
    }

    /// The bricks of a block.
    #[inline(always)]
    pub fn bricks(&self, coord: BlockCoord) -> Bricks {
        let [x, y, z] = coord.map(|c| f64::from(c * BLOCK_SIDE));
        let corner = self.origin + self.axes * Vector3::new(x, y, z);
        let corner = [corner.x as f32, corner.y as f32, corner.z as f32];
        let mut bricks = Bricks {
            first: [[0.0; BRICKS]; 3],
            steps: [[[0.0; BRICKS]; 3]; 3],
            depth: [0.0; BRICKS],
            columns: [[0.0; BRICKS]; 2],
            rows: [[0.0; BRICKS]; 2],
            projects: [false; BRICKS],
            half_depth_m: self.half_depth_m,
        };
        let last = self.lens.last();
        for i in 0..BRICKS {
            let centre = [0, 1, 2].map(|axis| corner[axis] + self.centres[axis][i]);
            let local = self.lens.near(centre);
            let forms = [local.column, local.row, [0.0, 0.0, 1.0]];
            let inv_z = 1.0 / centre[2];
            // Pixels per depth of the nearest voxel.
            let inv_near = 1.0 / (centre[2] - self.half_depth_m);
            let (mut place, mut reach) = ([0.0; 2], [0.0; 2]);
            for (form, row) in forms.iter().enumerate() {
                let at_centre = dot(row, &centre);
                let mut first = at_centre;
                for axis in 0..3 {
                    let step = dot(row, &self.steps[axis]);
                    bricks.steps[axis][form][i] = step;
                    first -= HALF_BRICK * step;
                    if form < 2 {
                        place[form] = at_centre * inv_z;
                        let sideways = step - place[form] * self.steps[axis][2];
                        reach[form] += HALF_BRICK * sideways.abs() * inv_near;
                    }
                }
                bricks.first[form][i] = first;
            }
            let low = [0, 1].map(|k| place[k] - reach[k] - ROUNDING_PX);
            let high = [0, 1].map(|k| place[k] + reach[k] + ROUNDING_PX);
            bricks.columns[0][i] = if low[0] > 0.0 { low[0] } else { 0.0 };
            bricks.rows[0][i] = if low[1] > 0.0 { low[1] } else { 0.0 };
            bricks.columns[1][i] = if high[0] < last[0] { high[0] } else { last[0] };
            bricks.rows[1][i] = if high[1] < last[1] { high[1] } else { last[1] };
            bricks.depth[i] = centre[2];
            bricks.projects[i] = local.projects
                & (centre[2] - self.half_depth_m > MIN_DEPTH_M)
                & (bricks.columns[0][i] <= bricks.columns[1][i])
                & (bricks.rows[0][i] <= bricks.rows[1][i]);
        }
        bricks
    }

    /// Pixel and depth (m) of a brick's voxels.
    #[inline(always)]
    pub fn project(
        &self,
        bricks: &Bricks,
        brick: usize,
    ) -> ([u32; BRICK_VOXELS], [f32; BRICK_VOXELS]) {
        const PLANE: usize = BRICK_SIDE * BRICK_SIDE;
        let steps = bricks.steps.map(|forms| forms.map(|form| form[brick]));
        let mut plane = [[0.0; PLANE]; 3];
        for (form, plane) in plane.iter_mut().enumerate() {
            for (i, out) in plane.iter_mut().enumerate() {
                let (x, y) = ((i % BRICK_SIDE) as f32, (i / BRICK_SIDE) as f32);
                *out = bricks.first[form][brick] + (steps[0][form] * x + steps[1][form] * y);
            }
        }
        let (mut pixels, mut depths) = ([0; BRICK_VOXELS], [0.0; BRICK_VOXELS]);
        for z in 0..BRICK_SIDE {
            let rise = steps[2].map(|step| step * z as f32);
            for i in 0..PLANE {
                let [column, row, depth] = [0, 1, 2].map(|form| plane[form][i] + rise[form]);
                let inv_depth = 1.0 / depth;
                pixels[PLANE * z + i] =
                    self.lens.nearest_index(column * inv_depth, row * inv_depth);
                depths[PLANE * z + i] = depth;
            }
        }
        (pixels, depths)
    }
}

impl Bricks {
    /// Where a brick lies; `None` if no voxel of it falls into the image.
    #[inline(always)]
    pub fn extent(&self, brick: usize) -> Option<Extent> {
        let nearest = |place: f32| (place + 0.5) as usize;
        self.projects[brick].then(|| Extent {
            columns: nearest(self.columns[0][brick])..=nearest(self.columns[1][brick]),
            rows: nearest(self.rows[0][brick])..=nearest(self.rows[1][brick]),
            near_m: self.depth[brick] - self.half_depth_m,
            far_m: self.depth[brick] + self.half_depth_m,
        })
    }
}

#[inline(always)]
fn dot(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
