//! Which blocks a frame touches: those along its truncation band.

use super::block::{BLOCK_SIDE, BlockCoord};
use super::free_space;
use super::noise::DepthNoise;
use super::observe::Observations;
use super::pyramid::FramePyramid;
use super::turns::Turns;
use super::view::View;
use super::volume::{Refusal, TsdfVolume};
use crate::geometry::lanes::{LANES, Lane};
use crate::geometry::{Pose, Rigid};
use pulp::{Arch, Simd, WithSimd};

/// Rays are looked at on a grid of so many pixels, the coarsest that leaves them close enough.
const STRIDES: [usize; 3] = [2, 4, 8];
const FINEST: usize = STRIDES[0];

/// Rays this share of a block's side apart miss no block but for its corners, which the next frames see.
const MAX_SPACING_BLOCKS: f32 = 0.75;

/// The blocks that the last frame touched, and what the volume refused.
#[derive(Clone, Debug, Default)]
pub struct Band {
    /// Frame that touched each block last.
    touched_in: Vec<u32>,
    frame: u32,
    /// What each block took along the band.
    taken: Vec<Taken>,
    /// The touched blocks: those that are not settled, then those that are.
    touched: [Touched; 2],
    /// Blocks in free space that hold something, of those that the frame looked through.
    filled: Vec<u32>,
    refused: Refused,
    /// Where rays cross blocks, by how deep in the band.
    crossings: Vec<BlocksCrossed>,
}

/// The frames that a block took because it lay in their band.
#[derive(Clone, Copy, Debug, Default)]
pub struct Taken {
    /// How many, 255 at most, since it was last looked through.
    n_frames: u8,
    /// The last of them.
    pub last: u32,
}

/// Blocks that take a frame alike.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Touched {
    /// For so many frames it counts there.
    pub n_frames: i32,
    /// The blocks, in rising order.
    pub blocks: Vec<u32>,
}

/// Blocks that were seen and not allocated; one that is seen in many frames counts once for each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Refused {
    /// Beyond the volume's border.
    pub n_outside: u64,
    /// Beyond the memory budget.
    pub n_over_budget: u64,
}

impl Refused {
    /// What was refused, as a sentence for the operator; `None` if nothing was. `memory_budget_mb` is of all volumes, of which the model
    /// may have `model_mb`.
    pub fn sentence(&self, memory_budget_mb: usize, model_mb: usize) -> Option<String> {
        let over_budget = (self.n_over_budget > 0).then(|| {
            format!(
                "the model has reached its {model_mb} MiB of fusion.memory_budget_mb, {memory_budget_mb}: new parts of the scene are not \
                 fused"
            )
        });
        let outside = (self.n_outside > 0).then(|| {
            "parts of the scene lie beyond the volume's border and are not fused".to_owned()
        });
        match (over_budget, outside) {
            (Some(budget), Some(outside)) => Some(format!("{budget}; {outside}")),
            (one, other) => one.or(other),
        }
    }
}

impl Band {
    /// The touched blocks: those that are not settled, then those that are.
    pub fn touched(&self) -> &[Touched; 2] {
        &self.touched
    }

    /// How many frames were taken in.
    pub fn frame(&self) -> u32 {
        self.frame
    }

    /// The frame that touched a block last, counted from one.
    pub fn touched_in(&self, block: u32) -> u32 {
        self.touched_in[block as usize]
    }

    /// The blocks that were touched after so many frames, in rising order.
    pub fn touched_since(&self, frame: u32) -> impl Iterator<Item = u32> {
        let touched_in = self.touched_in.iter().enumerate();
        touched_in
            .filter(move |(_, last)| **last > frame)
            .map(|(block, _)| block as u32)
    }

    /// Looks through the blocks whose turn it is, for those that hold something where the frame sees free space: [`Self::filled`].
    /// What comes to stand there later is new.
    pub fn look_through(&mut self, volume: &TsdfVolume, observations: &Observations, view: &View) {
        let taken = (self.frame, self.taken.as_slice());
        free_space::find(volume, taken, observations, view, &mut self.filled);
        for &block in &self.filled {
            self.touched_in[block as usize] = self.frame;
            self.taken[block as usize].n_frames = 0;
        }
    }

    /// Blocks in free space that hold something, of those that the frame looked through, in rising order.
    pub fn filled(&self) -> &[u32] {
        &self.filled
    }

    /// What the volume refused so far.
    pub fn refused(&self) -> Refused {
        self.refused
    }

    /// Finds the blocks within the truncation distance of a frame's depth and allocates those that are new. Pixels on rims that
    /// mix two surfaces find none: most lie in the air between, and where there is surface others see it. Blocks that are not new
    /// are touched when it is their turn.
    pub fn find(
        &mut self,
        arch: Arch,
        volume: &mut TsdfVolume,
        frame: &FramePyramid,
        noise: &DepthNoise,
        world_from_camera: &Pose,
        turns: Turns,
    ) {
        self.frame += 1;
        let band = BandOfRays::new(volume, world_from_camera);
        self.crossings.clear();
        self.crossings
            .resize(band.n_samples, BlocksCrossed::default());
        let block_m = volume.voxel_size_m() * BLOCK_SIDE as f32;
        let pitch = 0.5 * frame.reduced[0].pitch;
        // Beyond this depth a grid's rays are too far apart, and blocks could fall between them.
        let until_m = STRIDES.map(|stride| MAX_SPACING_BLOCKS * block_m / (pitch * stride as f32));
        // A pixel of the finest grid for each of the half image.
        let half = &frame.reduced[0];
        let faces =
            |row: usize, column: usize| half.normals[2][row * half.rays.width + column] < 0.0;
        let mut rays = RayLanes::default();
        for (row, v) in (FINEST / 2..frame.rays.height).step_by(FINEST).enumerate() {
            for (column, u) in (FINEST / 2..frame.rays.width).step_by(FINEST).enumerate() {
                let pixel = v * frame.rays.width + u;
                let depth = frame.depth[pixel];
                // The coarsest grid that the pixel belongs to, and the depth up to which a coarser one will do.
                let grid = ((row | column).trailing_zeros() as usize).min(STRIDES.len() - 1);
                let coarser_until_m = until_m.get(grid + 1).copied().unwrap_or(0.0);
                if depth > coarser_until_m && (!noise.mixes_at_rims() || faces(row, column)) {
                    rays.push([frame.rays.x[pixel], frame.rays.y[pixel], depth]);
                }
                if rays.n == LANES {
                    self.mark(arch, volume, &band, &rays, turns);
                    rays.n = 0;
                }
            }
        }
        self.mark(arch, volume, &band, &rays, turns);
        self.count_touched(turns);
    }

    /// Tells apart the touched blocks by how often they take a frame, and counts this one.
    fn count_touched(&mut self, turns: Turns) {
        for touched in &mut self.touched {
            touched.blocks.clear();
        }
        for (block, taken) in self.taken.iter_mut().enumerate() {
            if self.touched_in[block] == self.frame {
                let touched = &mut self.touched[usize::from(turns.is_settled(taken.n_frames))];
                touched.n_frames = turns.period(taken.n_frames);
                touched.blocks.push(block as u32);
                taken.n_frames = taken.n_frames.saturating_add(1);
                taken.last = self.frame;
            }
        }
    }

    /// Marks the blocks that rays cross from their depth less the truncation distance to their depth plus it.
    fn mark(
        &mut self,
        arch: Arch,
        volume: &mut TsdfVolume,
        band: &BandOfRays,
        rays: &RayLanes,
        turns: Turns,
    ) {
        let mut crossings = std::mem::take(&mut self.crossings);
        arch.dispatch(Cross {
            volume,
            band,
            rays,
            crossings: &mut crossings,
        });
        for at_depth in &crossings {
            let fresh = at_depth.is_fresh[..rays.n].iter().enumerate();
            for (ray, _) in fresh.filter(|(_, is_fresh)| **is_fresh) {
                let [x, y, z] = &at_depth.coords;
                self.touch(volume, [x[ray], y[ray], z[ray]], turns);
            }
        }
        self.crossings = crossings;
    }

    fn touch(&mut self, volume: &mut TsdfVolume, coord: BlockCoord, turns: Turns) {
        match volume.allocate(coord) {
            Ok(block) if block >= self.touched_in.len() => {
                self.touched_in.push(self.frame);
                self.taken.push(Taken::default());
            }
            Ok(block) => {
                if turns.is_due(coord, self.frame, self.taken[block].n_frames) {
                    self.touched_in[block] = self.frame;
                }
            }
            Err(Refusal::Outside) => self.refused.n_outside += 1,
            Err(Refusal::OverBudget) => self.refused.n_over_budget += 1,
        }
    }
}

/// The truncation band along rays from a pose.
struct BandOfRays {
    world_from_camera: Rigid,
    truncation_m: f32,
    /// Samples along each ray: half a block's side apart, so that they jump none but at a corner.
    n_samples: usize,
}

impl BandOfRays {
    fn new(volume: &TsdfVolume, world_from_camera: &Pose) -> Self {
        let block_m = volume.voxel_size_m() * BLOCK_SIDE as f32;
        BandOfRays {
            world_from_camera: Rigid::new(world_from_camera),
            truncation_m: volume.truncation_m(),
            n_samples: (4.0 * volume.truncation_m() / block_m).ceil() as usize + 1,
        }
    }
}

/// Rays with unit depth in the camera frame, and the depth measured along each.
#[derive(Default)]
struct RayLanes {
    x: Lane,
    y: Lane,
    depth: Lane,
    n: usize,
}

impl RayLanes {
    fn push(&mut self, [x, y, depth]: [f32; 3]) {
        (self.x[self.n], self.y[self.n], self.depth[self.n]) = (x, y, depth);
        self.n += 1;
    }
}

/// The blocks in which one sample of each ray lies.
#[derive(Clone, Debug)]
struct BlocksCrossed {
    coords: [[i32; LANES]; 3],
    /// Whether it is another block than that of the ray before, and than that of the shallower sample of the same ray.
    is_fresh: [bool; LANES],
}

impl Default for BlocksCrossed {
    /// No block of any volume.
    fn default() -> Self {
        BlocksCrossed {
            coords: [[i32::MIN; LANES]; 3],
            is_fresh: [false; LANES],
        }
    }
}

/// Finds the blocks that rays cross, from those of the rays before.
struct Cross<'a> {
    volume: &'a TsdfVolume,
    band: &'a BandOfRays,
    rays: &'a RayLanes,
    crossings: &'a mut [BlocksCrossed],
}

impl WithSimd for Cross<'_> {
    type Output = ();

    #[allow(
        clippy::needless_range_loop,
        reason = "one index runs through all the lanes, which is what becomes vector code"
    )]
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Cross { band, rays, .. } = self;
        let mut rays_world = [[0.0; LANES]; 3];
        for i in 0..LANES {
            let ray = band.world_from_camera.turn([rays.x[i], rays.y[i], 1.0]);
            for axis in 0..3 {
                rays_world[axis][i] = ray[axis];
            }
        }
        let [x, y, z] = &rays_world;
        let mut reach = [0.0; LANES];
        for i in 0..LANES {
            let length = (x[i] * x[i] + y[i] * y[i] + z[i] * z[i]).sqrt();
            reach[i] = band.truncation_m / length;
        }
        let mut shallower = [[i32::MIN; LANES]; 3];
        for (sample, crossings) in self.crossings.iter_mut().enumerate() {
            // From -1 at the band's beginning to 1 at its end.
            let share = 2.0 * sample as f32 / (band.n_samples - 1) as f32 - 1.0;
            let (mut from_ray, mut from_sample) = ([0; LANES], [0; LANES]);
            for axis in 0..3 {
                let before = crossings.coords[axis][LANES - 1];
                let coords = &mut crossings.coords[axis];
                for i in 0..LANES {
                    let depth = rays.depth[i] + reach[i] * share;
                    let place = band.world_from_camera.shift[axis] + rays_world[axis][i] * depth;
                    coords[i] = self.volume.block_coord(place);
                }
                let mut of_ray_before = [before; LANES];
                of_ray_before[1..].copy_from_slice(&coords[..LANES - 1]);
                for i in 0..LANES {
                    from_ray[i] |= coords[i] ^ of_ray_before[i];
                    from_sample[i] |= coords[i] ^ shallower[axis][i];
                }
            }
            for i in 0..LANES {
                crossings.is_fresh[i] = (from_ray[i] != 0) & (from_sample[i] != 0);
            }
            shallower = crossings.coords;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::preprocess::build_levels;
    use crate::geometry::camera::tests::distorted_camera;
    use crate::geometry::increment;
    use crate::geometry::lanes::arch_levels;
    use depth_camera::Sensor;
    use nalgebra::{Point3, Vector6};

    #[test]
    fn what_is_seen_lies_in_touched_blocks_whatever_the_instruction_set() {
        let pose = increment(&Vector6::new(0.02, -0.1, 0.3, 0.01, -0.004, 0.02));
        let mut frame = FramePyramid::new(&distorted_camera());
        for (pixel, depth) in frame.depth.iter_mut().enumerate() {
            let (x, y) = (frame.rays.x[pixel], frame.rays.y[pixel]);
            *depth = if x.is_nan() {
                0.0
            } else {
                1.0 / (1.0 + 0.4 * x - 0.3 * y)
            };
        }
        let noise = DepthNoise::of_sensor(Sensor::Kinect1);
        for voxel_size_m in [0.002, 0.005] {
            let mut first: Option<Vec<BlockCoord>> = None;
            for arch in arch_levels() {
                let mut volume = TsdfVolume::new(voxel_size_m, 5.0 * voxel_size_m, usize::MAX);
                let mut band = Band::default();
                band.find(arch, &mut volume, &frame, &noise, &pose, Turns::EveryFrame);
                let [touched, _] = band.touched();
                assert_eq!(touched.blocks.len(), volume.coords().len());
                let expected = first.get_or_insert_with(|| volume.coords().to_vec());
                assert_eq!(expected, volume.coords());
                let (mut n_seen, mut n_missed) = (0, 0);
                for pixel in 0..frame.depth.len() {
                    let z = frame.depth[pixel];
                    let place = [frame.rays.x[pixel] * z, frame.rays.y[pixel] * z, z];
                    let place = (pose * Point3::from(place).cast::<f64>()).cast::<f32>();
                    n_seen += u32::from(z > 0.0);
                    let block = volume.find([0, 1, 2].map(|axis| volume.block_coord(place[axis])));
                    n_missed += u32::from(z > 0.0 && block.is_none());
                }
                // Rays three quarters of a block apart miss some corners.
                assert!(n_missed * 100 < n_seen, "{n_missed} of {n_seen}");
            }
        }
    }

    #[test]
    fn what_lies_between_two_surfaces_finds_blocks_only_where_pixels_do_not_mix() {
        let mut frame = FramePyramid::new(&distorted_camera());
        let width = frame.rays.width;
        // A step from 0.8 m to 1 m, and on it a column of pixels at every depth between.
        for (pixel, depth) in frame.depth.iter_mut().enumerate() {
            let (u, v) = (pixel % width, pixel / width);
            *depth = match u.cmp(&(width / 2 + 1)) {
                std::cmp::Ordering::Less => 0.8,
                std::cmp::Ordering::Equal => 0.85 + 0.1 * v as f32 / frame.rays.height as f32,
                std::cmp::Ordering::Greater => 1.0,
            };
        }
        let arch = Arch::new();
        let n_blocks_between = |sensor| {
            let noise = DepthNoise::of_sensor(sensor);
            let mut frame = frame.clone();
            build_levels(arch, &noise, &mut frame);
            let mut volume = TsdfVolume::new(0.002, 0.01, usize::MAX);
            Band::default().find(
                arch,
                &mut volume,
                &frame,
                &noise,
                &Pose::identity(),
                Turns::EveryFrame,
            );
            let (near, far) = (volume.block_coord(0.83), volume.block_coord(0.97));
            let between = |coord: &&BlockCoord| (near..far).contains(&coord[2]);
            (
                volume.coords().iter().filter(between).count(),
                volume.coords().len(),
            )
        };
        let (between, n_blocks) = n_blocks_between(Sensor::Kinect2);
        assert!(between == 0 && n_blocks > 1000, "{between} of {n_blocks}");
        assert!(n_blocks_between(Sensor::Kinect1).0 > 10);
    }
}
