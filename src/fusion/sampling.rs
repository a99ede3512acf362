//! Samples of the volume by trilinear interpolation, one by one or of many points together.

use super::block::{BLOCK_VOXELS, BlockCoord, TSDF_ONE, UNSEEN, index_parts, voxel_index};
use super::volume::TsdfVolume;
use crate::geometry::lanes::{LANES, Lane, floor};
use nalgebra::Vector3;

/// What the volume holds at many points; both are 0 where it does not know.
pub struct Samples {
    /// Signed distances, metres.
    pub distance: Lane,
    /// Their gradients, m per m.
    pub gradient: [Lane; 3],
}

impl Samples {
    /// Squares of the gradients' lengths.
    #[inline(always)]
    pub fn squared_gradient(&self) -> Lane {
        let [x, y, z] = &self.gradient;
        let mut squared = [0.0; LANES];
        for i in 0..LANES {
            squared[i] = x[i] * x[i] + y[i] * y[i] + z[i] * z[i];
        }
        squared
    }
}

impl TsdfVolume {
    /// Signed distance (m) and its gradient (m per m); `None` unless all eight voxels around were seen.
    #[inline]
    pub fn sample_with_gradient(&self, point: &Vector3<f32>) -> Option<(f32, Vector3<f32>)> {
        let (voxel, fraction) = self.place([point.x, point.y, point.z]);
        let corners = self.corners(voxel)?;
        if corners.contains(&UNSEEN) {
            return None;
        }
        let (distance, gradient) = self.interpolate(&corners.map(f32::from), fraction);
        Some((distance, Vector3::from(gradient)))
    }

    /// [`Self::sample_with_gradient`] at the `wanted` ones of many points, to the bit.
    #[allow(
        clippy::needless_range_loop,
        reason = "one index runs through all the lanes, which is what becomes vector code"
    )]
    #[inline(always)]
    pub fn sample_lanes(&self, points: &[Lane; 3], wanted: &[bool; LANES]) -> Samples {
        let (mut voxels, mut fractions) = ([[0; LANES]; 3], [[0.0; LANES]; 3]);
        for i in 0..LANES {
            let (voxel, fraction) = self.place([points[0][i], points[1][i], points[2][i]]);
            for axis in 0..3 {
                voxels[axis][i] = voxel[axis];
                fractions[axis][i] = fraction[axis];
            }
        }
        let mut corners = [[UNSEEN; LANES]; 8];
        for i in 0..LANES {
            if wanted[i]
                && let Some(found) = self.corners([voxels[0][i], voxels[1][i], voxels[2][i]])
            {
                for (corner, found) in corners.iter_mut().zip(found) {
                    corner[i] = found;
                }
            }
        }
        let mut samples = Samples {
            distance: [0.0; LANES],
            gradient: [[0.0; LANES]; 3],
        };
        for i in 0..LANES {
            let (mut values, mut all_seen) = ([0.0; 8], true);
            for corner in 0..8 {
                all_seen &= corners[corner][i] != UNSEEN;
                values[corner] = f32::from(corners[corner][i]);
            }
            let fraction = [fractions[0][i], fractions[1][i], fractions[2][i]];
            let (distance, gradient) = self.interpolate(&values, fraction);
            samples.distance[i] = if all_seen { distance } else { 0.0 };
            for axis in 0..3 {
                samples.gradient[axis][i] = if all_seen { gradient[axis] } else { 0.0 };
            }
        }
        samples
    }

    /// The voxel at the low corner of a point's cell, and the point's place in the cell.
    #[inline(always)]
    fn place(&self, point: [f32; 3]) -> ([i32; 3], [f32; 3]) {
        let grid = point.map(|x| x * self.inv_voxel());
        let voxel = grid.map(floor);
        let fraction = [0, 1, 2].map(|axis| grid[axis] - voxel[axis] as f32);
        (voxel, fraction)
    }

    /// Distance (m) and gradient (m per m) between the eight corners of a cell, x fastest, in raw steps.
    #[inline(always)]
    fn interpolate(&self, corners: &[f32; 8], [fx, fy, fz]: [f32; 3]) -> (f32, [f32; 3]) {
        let [c000, c100, c010, c110, c001, c101, c011, c111] = *corners;
        let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let (x00, x10) = (lerp(c000, c100, fx), lerp(c010, c110, fx));
        let (x01, x11) = (lerp(c001, c101, fx), lerp(c011, c111, fx));
        let (y0, y1) = (lerp(x00, x10, fy), lerp(x01, x11, fy));
        let dx = lerp(
            lerp(c100 - c000, c110 - c010, fy),
            lerp(c101 - c001, c111 - c011, fy),
            fz,
        );
        let dy = lerp(x10 - x00, x11 - x01, fz);
        let scale = self.truncation_m() / TSDF_ONE;
        let gradient = [dx, dy, y1 - y0].map(|d| d * (scale * self.inv_voxel()));
        (lerp(y0, y1, fz) * scale, gradient)
    }

    /// The raw distances of the eight voxels from `voxel` on, x fastest; `None` where there is no block.
    #[inline(always)]
    fn corners(&self, voxel: [i32; 3]) -> Option<[i16; 8]> {
        if voxel.iter().any(|i| i & 7 == 7) {
            return self.corners_of_several(voxel);
        }
        Some(self.corners_within(self.find(voxel.map(|i| i >> 3))?, voxel))
    }

    /// The same where all of them lie in one block.
    #[inline(always)]
    fn corners_within(&self, block: usize, voxel: [i32; 3]) -> [i16; 8] {
        let local = voxel.map(|i| i & 7);
        let tsdf = &self.blocks()[block].tsdf;
        let (low, high) = (index_parts(local), index_parts(local.map(|i| (i + 1) & 7)));
        let at = |x: usize, y: usize, z: usize| tsdf[(x | y | z) % BLOCK_VOXELS];
        let row = |y: usize, z: usize| [at(low[0], y, z), at(high[0], y, z)];
        let [c000, c100] = row(low[1], low[2]);
        let [c010, c110] = row(high[1], low[2]);
        let [c001, c101] = row(low[1], high[2]);
        let [c011, c111] = row(high[1], high[2]);
        [c000, c100, c010, c110, c001, c101, c011, c111]
    }

    /// The same where the voxels lie in two, four or eight blocks; each block is looked up once.
    fn corners_of_several(&self, voxel: [i32; 3]) -> Option<[i16; 8]> {
        let local = voxel.map(|i| i & 7);
        // Bit a is set where the neighbour along axis a lies in another block.
        let across = (0..3).fold(0, |across, axis| {
            across | usize::from(local[axis] == 7) << axis
        });
        let parts = [index_parts(local), index_parts(local.map(|i| (i + 1) & 7))];
        let mut blocks = [0; 8];
        let mut side = across;
        loop {
            let step = [side & 1, side >> 1 & 1, side >> 2];
            blocks[side] =
                self.find([0, 1, 2].map(|axis| (voxel[axis] >> 3) + step[axis] as i32))?;
            if side == 0 {
                break;
            }
            // The next smaller subset of the axes across which there are other blocks.
            side = (side - 1) & across;
        }
        let corners = std::array::from_fn(|side| {
            let index = parts[side & 1][0] | parts[side >> 1 & 1][1] | parts[side >> 2][2];
            self.blocks()[blocks[side & across]].tsdf[index % BLOCK_VOXELS]
        });
        Some(corners)
    }
}

/// What a ray meets at one of its points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Met {
    /// A signed distance, metres.
    Distance(f32),
    /// A block, but not all eight voxels around the point were seen.
    Unseen,
    /// No block.
    Nothing,
}

/// Asks for distances along a ray, most of whose steps stay in the block they are in: that one is looked up once.
pub struct Walk<'a> {
    volume: &'a TsdfVolume,
    /// Where the ray last was, and the block there.
    last: (BlockCoord, Option<usize>),
}

impl<'a> Walk<'a> {
    /// A ray that begins at a point.
    pub fn from(volume: &'a TsdfVolume, start: &Vector3<f32>) -> Self {
        let (voxel, _) = volume.place([start.x, start.y, start.z]);
        let coord = voxel.map(|i| i >> 3);
        Walk {
            volume,
            last: (coord, volume.find(coord)),
        }
    }

    /// What is at a point; distances are those of [`TsdfVolume::sample_with_gradient`], to the bit.
    #[inline]
    pub fn at(&mut self, point: &Vector3<f32>) -> Met {
        let (voxel, fraction) = self.volume.place([point.x, point.y, point.z]);
        let coord = voxel.map(|i| i >> 3);
        if coord != self.last.0 {
            self.last = (coord, self.volume.find(coord));
        }
        let Some(block) = self.last.1 else {
            return Met::Nothing;
        };
        if self.volume.blocks()[block].tsdf[voxel_index(voxel) % BLOCK_VOXELS] == UNSEEN {
            return Met::Unseen;
        }
        let corners = if voxel.iter().any(|i| i & 7 == 7) {
            self.volume.corners_of_several(voxel)
        } else {
            Some(self.volume.corners_within(block, voxel))
        };
        let Some(corners) = corners.filter(|corners| !corners.contains(&UNSEEN)) else {
            return Met::Unseen;
        };
        let (distance, _) = self.volume.interpolate(&corners.map(f32::from), fraction);
        Met::Distance(distance)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::fusion::block::BLOCK_SIDE;

    /// A volume of 2 mm voxels within 48 mm of the origin, all seen often, that hold a closed-form distance (m).
    pub fn volume_of(truncation_m: f32, distance_m: impl Fn(f64, f64, f64) -> f64) -> TsdfVolume {
        let mut volume = TsdfVolume::new(0.002, truncation_m, usize::MAX);
        for bx in -3..3 {
            for by in -3..3 {
                for bz in -3..3 {
                    volume.allocate([bx, by, bz]).expect("within the volume");
                }
            }
        }
        let (coords, blocks) = volume.blocks_mut();
        for (coord, block) in coords.iter().zip(blocks) {
            for number in 0..BLOCK_VOXELS as i32 {
                let voxel = [number & 7, number >> 3 & 7, number >> 6];
                let index = voxel_index(voxel);
                let at = |axis: usize| f64::from(coord[axis] * BLOCK_SIDE + voxel[axis]) * 0.002;
                let d = distance_m(at(0), at(1), at(2));
                let share = (d / truncation_m as f64).clamp(-1.0, 1.0);
                block.tsdf[index] = (share * TSDF_ONE as f64) as i16;
                block.weight[index] = 1000;
            }
        }
        volume
    }

    #[test]
    fn trilinear_distance_and_gradient_of_a_sphere() {
        let volume = volume_of(0.02, |x, y, z| (x * x + y * y + z * z).sqrt() - 0.03);
        for direction in [[1.0, 0.2, -0.4], [-0.3, 0.9, 0.1], [0.1, -0.5, -0.8]] {
            let direction = Vector3::from(direction)
                .try_normalize(0.0)
                .expect("not zero");
            let p = direction * 0.031f32;
            let (distance, gradient) = volume.sample_with_gradient(&p).expect("inside");
            // Second-order error of trilinear interpolation: h²/4R = 0.03 mm.
            assert!((distance - 0.001).abs() < 5e-5);
            assert!((gradient - direction).norm() < 0.05);
        }
    }

    #[test]
    fn lanes_are_samples_one_by_one() {
        let volume = volume_of(0.02, |x, y, z| 0.8 * x - 0.3 * y + (z * 90.0).sin() * 0.01);
        let (mut n_known, mut n_unknown) = (0, 0);
        for start in 0..400 {
            let at = |i: usize, axis: usize| {
                let mixed = (start * LANES + i) * [2_654_435_761, 40_503, 97_561][axis];
                ((mixed >> 3) % 1000) as f32 * 1e-4 - 0.05
            };
            let points = std::array::from_fn(|axis| std::array::from_fn(|i| at(i, axis)));
            let wanted = std::array::from_fn(|i| i != 5);
            let samples = volume.sample_lanes(&points, &wanted);
            for i in 0..LANES {
                let point = Vector3::new(points[0][i], points[1][i], points[2][i]);
                let one = volume.sample_with_gradient(&point).filter(|_| wanted[i]);
                n_known += usize::from(one.is_some());
                n_unknown += usize::from(one.is_none());
                let (distance, gradient) = one.unwrap_or_default();
                assert_eq!(samples.distance[i], distance);
                assert_eq!(
                    [0, 1, 2].map(|axis| samples.gradient[axis][i]),
                    <[f32; 3]>::from(gradient)
                );
            }
        }
        assert!(n_known > 1000 && n_unknown > 1000, "{n_known} {n_unknown}");
    }

    #[test]
    fn a_walk_meets_what_samples_tell_one_by_one() {
        let mut volume = volume_of(0.02, |x, y, z| 0.8 * x - 0.3 * y + (z * 90.0).sin() * 0.01);
        let (coords, blocks) = volume.blocks_mut();
        for (coord, block) in coords.iter().zip(blocks) {
            for (number, tsdf) in block.tsdf.iter_mut().enumerate() {
                // Single voxels of some blocks, and other blocks whole.
                let is_unseen = match coord[0] {
                    -2 => number.is_multiple_of(37),
                    x => x == 1,
                };
                if is_unseen {
                    *tsdf = UNSEEN;
                }
            }
        }
        let [mut n_known, mut n_known_across, mut n_unseen, mut n_nothing] = [0; 4];
        for number in 0..40 {
            // Through all blocks from one side to the other, and beyond them; 0.3 mm a step.
            let aside = |k: i32| (number * k % 40 - 20) as f32 * 0.002;
            let start = Vector3::new(-0.06, aside(7), aside(11));
            let end = Vector3::new(0.06, aside(13), aside(17));
            let mut walk = Walk::from(&volume, &start);
            for step in 0..400 {
                let point = start + (end - start) * (step as f32 / 400.0);
                let (voxel, _) = volume.place(point.into());
                let expected = match volume.sample_with_gradient(&point) {
                    Some((distance, _)) => Met::Distance(distance),
                    None if volume.find(voxel.map(|i| i >> 3)).is_some() => Met::Unseen,
                    None => Met::Nothing,
                };
                assert_eq!(walk.at(&point), expected, "{point}");
                let is_across = voxel.iter().any(|i| i & 7 == 7);
                match expected {
                    Met::Distance(_) if is_across => n_known_across += 1,
                    Met::Distance(_) => n_known += 1,
                    Met::Unseen => n_unseen += 1,
                    Met::Nothing => n_nothing += 1,
                }
            }
        }
        let met = [n_known, n_known_across, n_unseen, n_nothing];
        assert!(met.iter().all(|&n| n > 1000), "{met:?}");
    }
}
