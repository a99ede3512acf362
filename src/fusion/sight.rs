//! Where along its rays a camera can meet the volume: most of a view is free space, in which there is nothing to look for.
//!
//! The image plane at unit depth is cut into square cells; each knows between which depths there are blocks. Bounds are those
//! of boxes around the blocks, so that they are never too narrow.

use super::block::{BLOCK_SIDE, BlockCoord};
use super::preprocess::DepthRange;
use super::pyramid::RayPlanes;
use super::volume::TsdfVolume;
use crate::geometry::{Pose, Rigid};

/// Side of a cell at unit depth: a block of 2 mm voxels at 0.8 m.
const CELL: f32 = 0.02;
/// Nearer than this, metres, blocks are taken to be in sight of every ray.
const TOO_NEAR_M: f32 = 0.05;

/// No depth at all.
const NOWHERE: DepthRange = DepthRange {
    near_m: f32::INFINITY,
    far_m: f32::NEG_INFINITY,
};

/// Depths of the blocks of a volume as seen from one pose.
#[derive(Clone, Debug)]
pub struct Sight {
    corner: [f32; 2],
    columns: usize,
    rows: usize,
    cells: Vec<DepthRange>,
}

impl Sight {
    /// What the rays of an image can meet within a range.
    pub fn of(
        volume: &TsdfVolume,
        rays: &RayPlanes,
        world_from_camera: &Pose,
        range: DepthRange,
    ) -> Self {
        let mut sight = Sight::over(rays);
        let camera_from_world = Rigid::new(&world_from_camera.inverse());
        let side_m = volume.voxel_size_m() * BLOCK_SIDE as f32;
        // Half the side of the box around a turned block, on each axis of the camera.
        let half_width = |row: [f32; 3]| 0.5 * side_m * row.iter().map(|x| x.abs()).sum::<f32>();
        let reach = camera_from_world.rows.map(half_width);
        let centre =
            |coord: &BlockCoord| camera_from_world.point(coord.map(|c| (c as f32 + 0.5) * side_m));
        for coord in volume.coords() {
            sight.add(centre(coord), reach, range);
        }
        sight
    }

    /// Nothing yet, for all rays of an image.
    fn over(rays: &RayPlanes) -> Self {
        let bounds = |plane: &[f32]| {
            let seen = plane.iter().filter(|x| !x.is_nan());
            seen.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), &x| {
                (low.min(x), high.max(x))
            })
        };
        let ((left, right), (top, bottom)) = (bounds(&rays.x), bounds(&rays.y));
        let n_cells = |low: f32, high: f32| ((high - low).max(0.0) / CELL) as usize + 1;
        let (columns, rows) = (n_cells(left, right), n_cells(top, bottom));
        Sight {
            corner: [left, top],
            columns,
            rows,
            cells: vec![NOWHERE; columns * rows],
        }
    }

    /// Takes in a box of the camera's frame, metres, by its centre and half its sides.
    fn add(&mut self, centre: [f32; 3], reach: [f32; 3], range: DepthRange) {
        let (near_m, far_m) = (centre[2] - reach[2], centre[2] + reach[2]);
        if far_m < range.near_m || near_m > range.far_m {
            return;
        }
        let (mut columns, mut rows) = (0..self.columns, 0..self.rows);
        if near_m > TOO_NEAR_M {
            let extent = |axis: usize, n_cells: usize| {
                let (low, high) = (centre[axis] - reach[axis], centre[axis] + reach[axis]);
                let low = (low / near_m).min(low / far_m) - self.corner[axis];
                let high = (high / near_m).max(high / far_m) - self.corner[axis];
                // A cell more on both sides than rounding asks for.
                let first = (low / CELL).floor() as i64 - 1;
                let end = (high / CELL).floor() as i64 + 2;
                let within = |cell: i64| cell.clamp(0, n_cells as i64) as usize;
                within(first)..within(end)
            };
            (columns, rows) = (extent(0, self.columns), extent(1, self.rows));
        }
        for row in rows {
            for cell in &mut self.cells[row * self.columns..][columns.clone()] {
                cell.near_m = cell.near_m.min(near_m.max(range.near_m));
                cell.far_m = cell.far_m.max(far_m.min(range.far_m));
            }
        }
    }

    /// The depths between which the ray (X/Z, Y/Z) can meet the volume; near is beyond far where it cannot.
    pub fn along(&self, ray: [f32; 2]) -> DepthRange {
        let cell = |axis: usize| ((ray[axis] - self.corner[axis]) / CELL) as usize;
        let (column, row) = (cell(0).min(self.columns - 1), cell(1).min(self.rows - 1));
        self.cells[row * self.columns + column]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::eye::Eye;
    use crate::fusion::{DepthNoise, FusionParams, MODEL_LEVEL};
    use crate::geometry::camera::tests::distorted_camera;
    use crate::geometry::increment;
    use depth_camera::Sensor;
    use nalgebra::{Point3, Vector6};

    #[test]
    fn every_point_of_every_block_is_in_sight_and_nothing_else_is_looked_for() {
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let eye = Eye::new(
            &distorted_camera(),
            noise,
            FusionParams::default().depth_range(),
        );
        let rays = &eye.level(MODEL_LEVEL).rays;
        let range = DepthRange {
            near_m: 0.3,
            far_m: 2.0,
        };
        let mut volume = FusionParams::default().empty_volume();
        let side_m = volume.voxel_size_m() * BLOCK_SIDE as f32;
        let blocks: [BlockCoord; 5] = [
            [0, 0, 50],
            [-9, 7, 60],
            [20, -3, 70],
            [0, 0, 3],
            [0, 1, -40],
        ];
        for coord in blocks {
            volume.allocate(coord).unwrap();
        }
        let motion = Vector6::new(0.2, -0.1, 0.3, 0.05, 0.02, -0.1);
        let world_from_camera = increment(&motion);
        let sight = Sight::of(&volume, rays, &world_from_camera, range);
        let mut n_seen = 0;
        for corner in blocks {
            for step in 0..1000 {
                let at = [step % 10, step / 10 % 10, step / 100].map(|x| (x as f32 + 0.5) / 10.0);
                let world: [f32; 3] =
                    std::array::from_fn(|axis| (corner[axis] as f32 + at[axis]) * side_m);
                let world = Point3::from(world).cast::<f64>();
                let point = (world_from_camera.inverse() * world).cast::<f32>();
                let (x, y) = (point.x / point.z, point.y / point.z);
                let inside = |x: f32, plane: &[f32]| {
                    plane.iter().any(|&other| other <= x) && plane.iter().any(|&other| other >= x)
                };
                let is_in_view = inside(x, &rays.x) && inside(y, &rays.y);
                if point.z < range.near_m || point.z > range.far_m || !is_in_view {
                    continue;
                }
                n_seen += 1;
                let seen = sight.along([x, y]);
                assert!(seen.near_m <= point.z && point.z <= seen.far_m, "{seen:?}");
            }
        }
        assert!(n_seen > 2000, "{n_seen}");
        let n_empty = sight.cells.iter().filter(|cell| cell.near_m > cell.far_m);
        assert!(n_empty.count() * 10 > 9 * sight.cells.len());
    }
}
