//! Rows that are read one after the other. The infrared sensor of a Kinect I is read from the top row to the bottom one in about the
//! time from frame to frame (Ringaby, Forssén, *Scan rectification for structured light range sensors with rolling shutters*,
//! ICCV 2011), so that a turning camera sees the upper part of its image from elsewhere than the lower one: at 50° a second by 1.5°.
//!
//! Nothing in a recording says how long the sensor takes. The frames of a moving camera do, by what differs from the model
//! in proportion to row and velocity once each frame is moved as fits best; it is believed only if what one half of the frames shows
//! explains the other half. Depth is then turned into what the camera would have measured had all rows been read with the middle
//! one, so that tracking, fusion and everything after them know of global shutters alone.

use super::frame_patches::{self, MotionFit, Patch};
use super::keyframes::Keyframe;
use super::noise::DepthNoise;
use super::preprocess::SAME_SURFACE_SIGMAS;
use super::track::STEADY_SECS;
use super::volume::TsdfVolume;
use crate::geometry::{CellGrid, Pose, RayGrid, increment_of};
use depth_camera::Image;
use nalgebra::{Point3, Vector2, Vector3, Vector6};
use rayon::prelude::*;
use std::iter::Sum;

/// How long a sensor takes to read its rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RollingShutter {
    /// Seconds from the first row to the last.
    pub readout_secs: f64,
}

/// Distances to the model beyond this are no error of the shutter, metres: half of what a quick turn of 100° a second does at 2 m.
const MAX_DISTANCE_M: f64 = 0.03;
/// A shutter that explains less of the other half's disagreement is not believed.
const MIN_EXPLAINED: f64 = 0.02;
/// A shorter time is not worth fusing again, seconds.
const MIN_READOUT_SECS: f64 = 0.001;
/// No sensor takes longer than from frame to frame, seconds.
const MAX_READOUT_SECS: f64 = 1.0 / 30.0;
/// Steps of the search for the pixel that saw a ray; each is exact to the change of the shift over the last.
const STEPS: usize = 3;

/// What the patches of one frame say of the readout: the sum of squares that they leave falls by `2 right t − squares t²` with a
/// readout of t, from `left`.
#[derive(Clone, Copy, Debug, Default)]
struct Evidence {
    squares: f64,
    right: f64,
    left: f64,
}

impl RollingShutter {
    /// The shutter that frames show against the model they were fused into; `None` if it is not to be believed.
    pub(super) fn measure(
        frames: &[Keyframe],
        volume: &TsdfVolume,
        rays: &RayGrid,
    ) -> Option<Self> {
        let cells = frame_patches::cells(rays);
        let path: Vec<Waypoint> = frames
            .iter()
            .map(|frame| Waypoint::of(frame, frame.world_from_camera))
            .collect();
        let velocities = velocities(&path);
        let patches = frame_patches::of_frames(frames, volume, rays, &cells, MAX_DISTANCE_M)?;
        let evidence: Vec<Evidence> = patches
            .iter()
            .map(|(index, patches)| evidence(patches, &cells, &velocities[*index]))
            .collect();
        let (even, odd) = frame_patches::halves(&evidence);
        let (even, odd): (Evidence, Evidence) = (even.into_iter().sum(), odd.into_iter().sum());
        let explained =
            0.5 * (odd.explained_by(even.readout_secs()) + even.explained_by(odd.readout_secs()));
        let n_frames = evidence.len();
        let readout_secs = evidence.into_iter().sum::<Evidence>().readout_secs();
        tracing::info!(
            frames = n_frames,
            explained,
            readout_ms = 1e3 * readout_secs,
            "rolling shutter: what one half of the frames explains of the other"
        );
        (explained >= MIN_EXPLAINED && readout_secs >= MIN_READOUT_SECS)
            .then_some(RollingShutter::within_bound(readout_secs))
    }

    fn within_bound(readout_secs: f64) -> Self {
        RollingShutter {
            readout_secs: readout_secs.min(MAX_READOUT_SECS),
        }
    }

    /// The shutter of which this one was measured after that `further` time had been left over.
    pub fn plus(&self, further: &RollingShutter) -> Self {
        Self::within_bound(self.readout_secs + further.readout_secs)
    }

    /// A depth image (metres, 0 is none) as it would be had all rows been read with the middle one, by a camera that moves with
    /// `velocity`: turn (rad/s) and shift (m/s) in its own frame.
    pub fn corrected(
        &self,
        depth_m: &Image<f32>,
        velocity: &Vector6<f64>,
        rays: &RayGrid,
        noise: &DepthNoise,
    ) -> Image<f32> {
        let (width, height) = (depth_m.width(), depth_m.height());
        let scan = Scan {
            depth_m,
            rays,
            noise,
            turn: velocity.fixed_rows::<3>(0).into(),
            shift: velocity.fixed_rows::<3>(3).into(),
            secs_a_row: self.readout_secs / (height - 1) as f64,
        };
        let mut out = vec![0.0f32; width * height];
        out.par_chunks_mut(width).enumerate().for_each(|(v, row)| {
            for (u, out) in row.iter_mut().enumerate() {
                *out = scan.seen_at(u, v).unwrap_or(0.0);
            }
        });
        Image::from_vec(width, height, out)
    }
}

/// Where a camera was at a time of its path.
#[derive(Clone, Copy, Debug)]
pub struct Waypoint {
    time_secs: f64,
    /// Its pose.
    pub world_from_camera: Pose,
    /// Which stretch of unbroken tracking it belongs to.
    stretch: usize,
}

impl Waypoint {
    /// A frame that was fused, at the pose that it has by now.
    pub fn of(frame: &Keyframe, world_from_camera: Pose) -> Self {
        Waypoint {
            time_secs: frame.time_secs,
            world_from_camera,
            stretch: frame.stretch,
        }
    }
}

/// Frames are missing where two are farther apart in time than the median by this factor.
const GAP_FACTOR: f64 = 2.5;

/// The velocity of a camera at each place of its path, in order of time, by the neighbours in time: turn (rad/s) and shift (m/s) in the
/// camera's frame. None is known where frames are missing, and across a break of tracking. Of a long scan
/// fewer frames are kept, most of them where the camera moved fast.
pub fn velocities(path: &[Waypoint]) -> Vec<Vector6<f64>> {
    let passed_secs = |a: usize, b: usize| path[b].time_secs - path[a].time_secs;
    let mut steps: Vec<f64> = (1..path.len()).map(|b| passed_secs(b - 1, b)).collect();
    steps.sort_by(f64::total_cmp);
    let usual_secs = steps.get(steps.len().saturating_sub(1) / 2);
    let longest_secs = usual_secs.map_or(0.0, |usual| (GAP_FACTOR * usual).max(STEADY_SECS));
    let is_near = |a: usize, b: usize| {
        path[a].stretch == path[b].stretch && passed_secs(a, b) <= longest_secs
    };
    let at = |index: usize| {
        let before = index
            .checked_sub(1)
            .filter(|&before| is_near(before, index));
        let after = Some(index + 1).filter(|&after| after < path.len() && is_near(index, after));
        let (start, end) = (before.unwrap_or(index), after.unwrap_or(index));
        let passed = passed_secs(start, end);
        if passed <= 0.0 {
            return Vector6::zeros();
        }
        let [from, here, to] = [start, index, end].map(|at| &path[at].world_from_camera);
        let turn = from.rotation.inverse() * to.rotation;
        let shift = here.rotation.inverse() * (to.translation.vector - from.translation.vector);
        increment_of(&Pose::from_parts(shift.into(), turn)) / passed
    };
    (0..path.len()).map(at).collect()
}

fn evidence(patches: &[Patch], cells: &CellGrid, velocity: &Vector6<f64>) -> Evidence {
    let fit = MotionFit::new(patches);
    // A patch in the lower half is read later, when the camera has moved on: its points lie where the camera's own motion, undone,
    // takes them.
    let rows = cells.rows() as f64;
    let by_readout = |patch: &Patch| {
        let row = (patch.cell / cells.columns()) as f64;
        -((row + 0.5) / rows - 0.5) * patch.by_motion.dot(velocity)
    };
    let motion = fit.explaining(|patch| patch.excess);
    let moved = fit.explaining(by_readout);
    let of_patch = |patch: &Patch| {
        let left = patch.excess - patch.by_motion.dot(&motion);
        let slope = by_readout(patch) - patch.by_motion.dot(&moved);
        Evidence {
            squares: patch.weight * slope * slope,
            right: patch.weight * slope * left,
            left: patch.weight * left * left,
        }
    };
    patches.iter().map(of_patch).sum()
}

impl Sum for Evidence {
    fn sum<I: Iterator<Item = Evidence>>(all: I) -> Evidence {
        all.fold(Evidence::default(), |sum, one| Evidence {
            squares: sum.squares + one.squares,
            right: sum.right + one.right,
            left: sum.left + one.left,
        })
    }
}

impl Evidence {
    /// The readout that leaves least, seconds; negative where rows seem to be read from the bottom.
    fn readout_secs(&self) -> f64 {
        self.right / self.squares.max(f64::MIN_POSITIVE)
    }

    /// Share of what is left that a readout explains.
    fn explained_by(&self, readout_secs: f64) -> f64 {
        let falls_by = (2.0 * self.right - self.squares * readout_secs) * readout_secs;
        falls_by / self.left.max(f64::MIN_POSITIVE)
    }
}

/// A depth image whose rows were read by a moving camera.
struct Scan<'a> {
    depth_m: &'a Image<f32>,
    rays: &'a RayGrid,
    noise: &'a DepthNoise,
    turn: Vector3<f64>,
    shift: Vector3<f64>,
    secs_a_row: f64,
}

impl Scan<'_> {
    /// Depth along the ray of a pixel at the time of the middle row.
    fn seen_at(&self, u: usize, v: usize) -> Option<f32> {
        let ray = self.rays.direction(u, v).cast::<f64>();
        if ray.x.is_nan() {
            return None;
        }
        // The pixel that saw the point on this ray, and when, are found in turn, from this one on.
        let mut pixel = Vector2::new(u as f64, v as f64);
        for _ in 0..STEPS {
            let z = f64::from(
                *self
                    .depth_m
                    .at(pixel.x.round() as usize, pixel.y.round() as usize),
            );
            let secs = self.secs_since_middle(pixel.y);
            // Without depth nothing is known of the shift, which is less than the turn.
            let shift = if z > 0.0 {
                self.shift / z
            } else {
                Vector3::zeros()
            };
            let seen = ray - secs * (self.turn.cross(&ray) + shift);
            pixel = self.rays.camera().project(&Point3::from(seen))?;
            if !self.rays.camera().contains(&pixel, 0.0) {
                return None;
            }
        }
        let z = self.depth_between(&pixel)?;
        let secs = self.secs_since_middle(pixel.y);
        let [x, y] = *self
            .rays
            .rays()
            .at(pixel.x.round() as usize, pixel.y.round() as usize);
        let turned = self.turn.x * f64::from(y) - self.turn.y * f64::from(x);
        Some((z * (1.0 + secs * turned) + secs * self.shift.z) as f32)
    }

    fn secs_since_middle(&self, row: f64) -> f64 {
        (row - 0.5 * (self.depth_m.height() - 1) as f64) * self.secs_a_row
    }

    /// Depth between pixels of one surface, otherwise that of the nearest pixel.
    fn depth_between(&self, pixel: &Vector2<f64>) -> Option<f64> {
        let nearest = *self
            .depth_m
            .at(pixel.x.round() as usize, pixel.y.round() as usize);
        if nearest <= 0.0 {
            return None;
        }
        let (left, top) = (pixel.x.floor() as usize, pixel.y.floor() as usize);
        let right = (left + 1).min(self.depth_m.width() - 1);
        let bottom = (top + 1).min(self.depth_m.height() - 1);
        let corners = [(left, top), (right, top), (left, bottom), (right, bottom)]
            .map(|(u, v)| *self.depth_m.at(u, v));
        let reach = SAME_SURFACE_SIGMAS * self.noise.sigma_m(nearest);
        if corners.iter().any(|z| (z - nearest).abs() > reach) {
            return Some(f64::from(nearest));
        }
        let (along, down) = (pixel.x.fract(), pixel.y.fract());
        let [a, b, c, d] = corners.map(f64::from);
        Some((a + (b - a) * along) * (1.0 - down) + (c + (d - c) * along) * down)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::Fusion;
    use crate::fusion::packed_depth::PackedDepth;
    use crate::fusion::tests::{frames, small_params};
    use crate::geometry::camera::tests::distorted_camera;
    use crate::geometry::increment;
    use depth_camera::Sensor;

    const READOUT: RollingShutter = RollingShutter { readout_secs: 0.03 };

    /// Depth of a slanted plane along a ray of a camera at a pose.
    fn plane_depth(ray: &Vector3<f64>, from_camera: &Pose) -> f64 {
        let (normal, distance_m) = (Vector3::new(0.3, -0.2, -1.0) / 1.13f64.sqrt(), -1.1);
        (distance_m - normal.dot(&from_camera.translation.vector))
            / normal.dot(&(from_camera.rotation * ray))
    }

    #[test]
    fn rows_are_put_where_the_middle_one_saw_them() {
        let rays = RayGrid::new(distorted_camera());
        let (width, height) = (rays.rays().width(), rays.rays().height());
        // 70° a second, and half a metre.
        let velocity = Vector6::new(0.7, 0.9, -0.5, 0.2, -0.3, 0.4);
        let secs = |v: usize| (v as f64 / (height - 1) as f64 - 0.5) * READOUT.readout_secs;
        let image = |pose_of_row: &dyn Fn(usize) -> Pose| {
            let depth = (0..width * height).map(|pixel| {
                let ray = rays.direction(pixel % width, pixel / width).cast();
                plane_depth(&ray, &pose_of_row(pixel / width)) as f32
            });
            Image::from_vec(width, height, depth.collect())
        };
        let read = image(&|v| increment(&(velocity * secs(v))));
        let at_once = image(&|_| Pose::identity());
        let noise = DepthNoise::of_sensor(Sensor::Kinect1);
        let corrected = READOUT.corrected(&read, &velocity, &rays, &noise);
        let worst = |image: &Image<f32>| {
            let pairs = image.data().iter().zip(at_once.data());
            let off = pairs.filter(|(z, _)| **z > 0.0).map(|(a, b)| (a - b).abs());
            off.fold(0.0f32, f32::max)
        };
        let n_seen = corrected.data().iter().filter(|z| **z > 0.0).count();
        assert!(n_seen as f64 > 0.9 * (width * height) as f64, "{n_seen}");
        let (before, after) = (worst(&read), worst(&corrected));
        assert!(
            before > 0.01 && after < 0.02 * before,
            "{before} -> {after}"
        );
    }

    /// The model of frames that were read at once, and these as read with a readout, in a scan so quick that it shows.
    fn measured(readout_secs: f64) -> Option<RollingShutter> {
        const FRAME_SECS: f64 = 1.0 / 30.0;
        let (frames, truth, camera) = frames(24);
        let rays = RayGrid::new(camera);
        let noise = DepthNoise::of_sensor(Sensor::Kinect1);
        let mut fusion = Fusion::new(camera, noise, small_params());
        let path: Vec<Waypoint> = truth
            .iter()
            .enumerate()
            .map(|(k, pose)| Waypoint {
                time_secs: k as f64 * FRAME_SECS,
                world_from_camera: *pose,
                stretch: 0,
            })
            .collect();
        let undone = RollingShutter {
            readout_secs: -readout_secs,
        };
        let mut keyframes = Vec::new();
        for ((frame, at), velocity) in frames.iter().zip(&path).zip(velocities(&path)) {
            let depth = frame.depth.as_ref().expect("Kinect II");
            fusion.fuse_at(depth, at.time_secs, &at.world_from_camera);
            let read = undone.corrected(depth, &velocity, &rays, &noise);
            keyframes.push(Keyframe {
                depth: PackedDepth::pack(read.data(), depth.width(), 1.5, &mut Vec::new()),
                time_secs: at.time_secs,
                world_from_camera: at.world_from_camera,
                given: None,
                stretch: at.stretch,
                n_frames: 1,
            });
        }
        RollingShutter::measure(&keyframes, &fusion.fused.volume, &rays)
    }

    #[test]
    fn the_readout_is_told_by_the_frames() {
        let found = measured(READOUT.readout_secs)
            .expect("a shutter")
            .readout_secs;
        assert!((found - READOUT.readout_secs).abs() < 0.005, "{found}");
    }

    #[test]
    fn frames_that_are_read_at_once_show_none() {
        assert_eq!(measured(0.0), None);
    }

    #[test]
    fn rows_read_from_the_bottom_are_not_believed() {
        assert_eq!(measured(-READOUT.readout_secs), None);
    }

    /// Shifts along x (m/s) of a camera that is at places along x (m) at times (s), of stretches.
    fn shifts(path: &[(f64, f64, usize)]) -> Vec<f64> {
        let path: Vec<Waypoint> = path
            .iter()
            .map(|&(time_secs, x, stretch)| Waypoint {
                time_secs,
                world_from_camera: Pose::translation(x, 0.0, 0.0),
                stretch,
            })
            .collect();
        let along_x = |v: &Vector6<f64>| (1e9 * v[3]).round() * 1e-9;
        velocities(&path).iter().map(along_x).collect()
    }

    #[test]
    fn no_velocity_is_known_across_missing_frames_and_breaks_of_tracking() {
        let missing = [(0.0, 0.0, 0), (0.1, 0.01, 0), (1.0, 1.0, 0)];
        assert_eq!(shifts(&missing), [0.1, 0.1, 0.0]);
        let broken = [(0.0, 0.0, 0), (0.1, 0.01, 0), (0.2, 0.5, 2), (0.3, 0.51, 2)];
        assert_eq!(shifts(&broken), [0.1; 4]);
    }

    #[test]
    fn of_a_long_scan_whose_frames_are_thinned_velocities_are_known() {
        // The older frames are thinned once more than the newer.
        let thinned = [0, 8, 16, 20, 24, 28, 32, 36];
        let thinned = thinned.map(|k| (f64::from(k) / 30.0, f64::from(k) / 300.0, 0));
        assert_eq!(shifts(&thinned), [0.1; 8]);
        assert_eq!(shifts(&thinned[..1]), [0.0]);
    }
}
