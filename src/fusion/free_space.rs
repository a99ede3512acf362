//! What was fused where the camera now looks through: a hand that was in the picture, an object that was moved away.
//!
//! A frame is fused along its truncation band alone. What hangs before the band as a whole would stay for ever, in the mesh and in the
//! way of finding back. So blocks take turns in being looked through, and one in which something was seen, and which lies in free
//! space as a whole, is told so. What a frame saw there, another one that sees through it takes back.
//!
//! Not handled: what is gone and has nothing measured behind it, as where that is out of range.

use super::band::Taken;
use super::block::{BRICKS, Block, BlockCoord};
use super::observe::{Observations, slope_of};
use super::view::View;
use super::volume::TsdfVolume;

/// In so many frames a block is looked through once, and is then told what as many frames would have told it.
pub const LOOKS_EVERY: usize = 4;

/// For so many frames a block that took one counts as lying in the band: what lies there takes every fourth, and one may miss it.
const IN_BAND_FOR: u32 = 4;

/// What lies so near in the image to what is free has to be free as well, and most of it measured, pixels: at silhouettes and of thin parts a sensor measures
/// what is behind them, in one frame and not in another.
const CLEARANCE_PX: usize = 8;

/// The blocks whose turn it is in a frame, and which are free as it sees them and not so in the volume, in rising order. Those that
/// are in the band are fused as it is.
pub fn find(
    volume: &TsdfVolume,
    (frame, taken): (u32, &[Taken]),
    observations: &Observations,
    view: &View,
    filled: &mut Vec<u32>,
) {
    filled.clear();
    let first = frame as usize % LOOKS_EVERY;
    for block in (first..volume.coords().len()).step_by(LOOKS_EVERY) {
        let is_in_band = taken[block].last + IN_BAND_FOR >= frame;
        if !is_in_band
            && is_free(volume.coords()[block], observations, view)
            && holds_something(&volume.blocks()[block])
        {
            filled.push(block as u32);
        }
    }
}

/// Whether a frame looks through all of a block that falls into its image. Most blocks are told by their middle.
fn is_free(coord: BlockCoord, observations: &Observations, view: &View) -> bool {
    let (pixel, depth_m) = view.centre(coord);
    let seen = observations.pixels()[pixel as usize];
    let measured_m = observations.depth_step().depth_of(seen);
    let is_before_band =
        measured_m > 0.0 && (measured_m - depth_m) * slope_of(seen) > view.truncation_m();
    is_before_band && {
        let bricks = view.bricks(coord);
        let mut extents = (0..BRICKS).filter_map(|brick| bricks.extent(brick));
        extents.all(|extent| {
            let around = view.widened(extent, CLEARANCE_PX);
            observations.band_ends().is_before(&around)
        })
    }
}

/// Whether something was seen in a block from before.
fn holds_something(block: &Block) -> bool {
    let mut voxels = block.tsdf.iter().zip(&block.weight);
    voxels.any(|(&tsdf, &weight)| tsdf < 0 && weight > 0)
}

#[cfg(test)]
mod tests {
    use crate::fusion::DepthNoise;
    use crate::fusion::eye::Eye;
    use crate::fusion::fused_volume::FusedVolume;
    use crate::fusion::tests::small_params;
    use crate::fusion::turns::Turns;
    use crate::geometry::Pose;
    use crate::geometry::camera::tests::distorted_camera;
    use depth_camera::{Image, Sensor};

    const WIDTH: usize = 512;
    const WALL_M: f32 = 1.1;
    const NEAR_M: f32 = 0.6;

    /// A camera that stands still before a wall, and what it has fused.
    struct Scene {
        eye: Eye,
        fused: FusedVolume,
    }

    impl Scene {
        fn new() -> Self {
            let params = small_params();
            let noise = DepthNoise::of_sensor(Sensor::Kinect1);
            Scene {
                eye: Eye::new(&distorted_camera(), noise, params.depth_range()),
                fused: FusedVolume::untouched(params.empty_volume()),
            }
        }

        /// Fuses frames in which pixels for which `is_near` holds show what stands before the wall.
        fn fuse(&mut self, n_frames: usize, turns: Turns, is_near: impl Fn(usize, usize) -> bool) {
            let depth = (0..WIDTH * 424).map(|pixel| match is_near(pixel % WIDTH, pixel / WIDTH) {
                true => NEAR_M,
                false => WALL_M,
            });
            assert!(self.eye.take(&Image::from_vec(WIDTH, 424, depth.collect())));
            for _ in 0..n_frames {
                let at = Pose::identity();
                self.eye.fuse_into(&mut self.fused, &at, turns, &mut |_| {});
            }
        }

        /// Voxels well before the wall that lie behind a surface.
        fn n_before_wall(&self) -> usize {
            let volume = &self.fused.volume;
            let wall = volume.block_coord(WALL_M - 0.1);
            let blocks = volume.coords().iter().zip(volume.blocks());
            let before = blocks.filter(|(coord, _)| coord[2] < wall);
            let voxels = before.flat_map(|(_, block)| block.tsdf.iter().zip(&block.weight));
            let behind = voxels.filter(|&(&tsdf, &weight)| tsdf < 0 && weight > 0);
            behind.count()
        }
    }

    fn in_the_middle(u: usize, v: usize) -> bool {
        (200..312).contains(&u) && (160..260).contains(&v)
    }

    #[test]
    fn what_is_gone_goes_after_as_long_as_it_was_there_and_not_at_once() {
        for turns in [Turns::EveryFrame, Turns::ByAge] {
            let mut scene = Scene::new();
            scene.fuse(40, turns, in_the_middle);
            let n_there = scene.n_before_wall();
            assert!(n_there > 1000, "{n_there}");
            scene.fuse(8, turns, |_, _| false);
            let n_after_few = scene.n_before_wall();
            assert!(2 * n_after_few > n_there, "{n_after_few} of {n_there}");
            scene.fuse(40, turns, |_, _| false);
            assert_eq!(scene.n_before_wall(), 0, "of {n_there}");
        }
    }

    #[test]
    fn what_is_there_stays_and_so_does_its_silhouette_that_wavers() {
        let mut scene = Scene::new();
        scene.fuse(20, Turns::EveryFrame, in_the_middle);
        let n_there = scene.n_before_wall();
        // Six columns and rows less than before, on each side.
        let smaller = |u: usize, v: usize| (206..306).contains(&u) && (166..254).contains(&v);
        for _ in 0..60 {
            scene.fuse(1, Turns::EveryFrame, smaller);
            assert!(scene.fused.band.filled().is_empty());
        }
        let n_after = scene.n_before_wall();
        assert!(10 * n_after > 8 * n_there, "{n_after} of {n_there}");
    }

    #[test]
    fn a_stick_that_some_frames_miss_stays() {
        let mut scene = Scene::new();
        let is_on_stick = |u: usize, v: usize| (256..259).contains(&u) && in_the_middle(u, v);
        scene.fuse(10, Turns::ByAge, is_on_stick);
        let n_there = scene.n_before_wall();
        assert!(n_there > 100, "{n_there}");
        for _ in 0..10 {
            scene.fuse(9, Turns::ByAge, is_on_stick);
            scene.fuse(1, Turns::ByAge, |_, _| false);
        }
        let n_after = scene.n_before_wall();
        assert!(10 * n_after > 9 * n_there, "{n_after} of {n_there}");
        // Nor does it go at once.
        scene.fuse(4, Turns::ByAge, |_, _| false);
        assert!(scene.n_before_wall() > 0);
    }

    #[test]
    fn a_settled_stick_that_one_frame_misses_is_not_looked_through() {
        let is_on_stick = |u: usize, v: usize| (256..259).contains(&u) && in_the_middle(u, v);
        let mut scene = Scene::new();
        // Each of the four turns misses it once.
        for n_frames in [40, 20, 21, 21, 21] {
            scene.fuse(n_frames, Turns::ByAge, is_on_stick);
            scene.fuse(1, Turns::ByAge, |_, _| false);
            assert!(scene.fused.band.filled().is_empty());
        }
    }

    #[test]
    fn where_nothing_is_measured_nothing_is_taken_back() {
        let mut scene = Scene::new();
        scene.fuse(10, Turns::EveryFrame, in_the_middle);
        let n_there = scene.n_before_wall();
        let nothing = |pixel: usize| match in_the_middle(pixel % WIDTH, pixel / WIDTH) {
            true => 0.0,
            false => WALL_M,
        };
        let depth = (0..WIDTH * 424).map(nothing).collect();
        assert!(scene.eye.take(&Image::from_vec(WIDTH, 424, depth)));
        for _ in 0..40 {
            let (fused, turns) = (&mut scene.fused, Turns::EveryFrame);
            let eye = &mut scene.eye;
            eye.fuse_into(fused, &Pose::identity(), turns, &mut |_| {});
        }
        let n_after = scene.n_before_wall();
        assert!(10 * n_after > 9 * n_there, "{n_after} of {n_there}");
    }
}
