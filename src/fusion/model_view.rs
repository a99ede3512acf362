//! The model as the camera sees it from where the last frame was fused, cast when it is asked for.
//!
//! A frame that lies where the motion of the camera leads needs no view of the model ([`carry_on`](super::carry_on)), and casting one
//! costs more than a third of what all else of such a frame does.

use super::eye::Eye;
use super::icp::CastModel;
use super::pyramid::Level;
use super::raycast::{ModelMap, Window, raycast};
use super::volume::TsdfVolume;
use super::{Fusion, MODEL_LEVEL};
use crate::geometry::Pose;

/// A view of the model. Rays start at the depth of the frame that was fused last, so that is kept.
#[derive(Clone, Debug)]
pub struct ModelView {
    /// Camera, rays and depth of that frame; the normals are not kept up.
    level: Level,
    world_from_camera: Pose,
    map: ModelMap,
    /// What has been cast since the last move.
    cast: Option<Window>,
    /// Whether tracking has looked at it since, and had before that.
    is_tracked_by: bool,
    was_tracked_by: bool,
}

impl ModelView {
    /// A view with the pixels of a level, from the pose that its frame was fused at.
    pub fn from(level: &Level, world_from_camera: &Pose) -> Self {
        ModelView {
            map: ModelMap::of_level(level),
            level: level.clone(),
            world_from_camera: *world_from_camera,
            cast: None,
            is_tracked_by: false,
            was_tracked_by: false,
        }
    }

    /// Moves to where the next frame was fused.
    pub fn move_to(&mut self, level: &Level, world_from_camera: &Pose) {
        self.was_tracked_by = std::mem::take(&mut self.is_tracked_by);
        self.level.depth.copy_from_slice(&level.depth);
        self.moved(world_from_camera);
    }

    /// Moves with the frame that it is of, whose pose was corrected, or whose model is another now.
    pub fn moved(&mut self, world_from_camera: &Pose) {
        self.world_from_camera = *world_from_camera;
        self.cast = None;
    }

    /// Casts the model, if it has not been since the last move; whether it did.
    pub fn cast(&mut self, eye: &Eye, volume: &TsdfVolume) -> bool {
        self.cast_in(Window::whole(&self.level), eye, volume)
    }

    /// Casts the model in a window, if it has not been there since the last move; whether it did.
    fn cast_in(&mut self, window: Window, eye: &Eye, volume: &TsdfVolume) -> bool {
        let is_cast = self
            .cast
            .as_ref()
            .is_some_and(|cast| cast.contains(&window));
        if !is_cast {
            let place = (&self.level, &window);
            let pose = &self.world_from_camera;
            raycast(eye.arch, volume, place, pose, eye.range, &mut self.map);
            self.cast = Some(window);
        }
        !is_cast
    }

    /// What it was when the model was cast last, in the window that was.
    pub fn map(&self) -> &ModelMap {
        &self.map
    }

    /// What a frame is aligned to.
    pub fn model(&self) -> CastModel<'_> {
        CastModel {
            map: &self.map,
            lens: &self.level.lens,
            world_from_camera: &self.world_from_camera,
        }
    }
}

impl Fusion {
    /// The model as the camera saw it after the last frame that was fused, and not fused anew, at a quarter of the resolution; cast if it
    /// was not needed yet, which costs what [`FusionStep::Raycast`](super::FusionStep::Raycast) says.
    pub fn model(&mut self) -> Option<&ModelMap> {
        let (eye, volume) = (&self.eye, &self.fused.volume);
        let seen = self.seen.as_mut()?;
        seen.cast(eye, volume);
        Some(seen.map())
    }

    /// The same, of which only what lies so near to the optical axis, radians below a right angle, need be seen: the less, the cheaper.
    pub fn model_near_axis(&mut self, from_axis_rad: f64) -> Option<&ModelMap> {
        let (eye, volume) = (&self.eye, &self.fused.volume);
        let seen = self.seen.as_mut()?;
        let window = match seen.was_tracked_by {
            // Frames that need all of it come one after the other, and the next would have it cast once more.
            true => Window::whole(&seen.level),
            false => Window::near_axis(&seen.level, from_axis_rad),
        };
        seen.cast_in(window, eye, volume);
        Some(seen.map())
    }

    /// The model is to be seen from where the frame in hand was fused, or starts.
    pub(super) fn stand_at(&mut self, world_from_camera: &Pose) {
        let level = self.eye.level(MODEL_LEVEL);
        match &mut self.seen {
            Some(seen) => seen.move_to(level, world_from_camera),
            None => self.seen = Some(ModelView::from(level, world_from_camera)),
        }
    }

    /// Looks at the model from where it is to be seen, to track by it, if that has not been done; whether it was.
    pub(super) fn look(&mut self) -> bool {
        let (eye, volume) = (&self.eye, &self.fused.volume);
        self.seen.as_mut().is_some_and(|seen| {
            seen.is_tracked_by = true;
            seen.cast(eye, volume)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::tests::{frames_of, fusion};
    use depth_camera::Sensor;
    use nalgebra::{Point3, Vector3};
    use simulated::{Infrared, Scene, Setup, Shape, SimulatedCamera, Solid, Trajectory};

    /// What has seen a ball and a table.
    fn fused() -> Fusion {
        let ball = Solid::new(Shape::Sphere { radius: 0.1 }, Pose::identity(), 0.6);
        let table = Shape::Table {
            half_size: [0.5, 0.5],
        };
        let camera = SimulatedCamera::new(Setup {
            scene: Scene::new(vec![ball, Solid::new(table, Pose::identity(), 0.5)], 1),
            trajectory: Trajectory::hand_held(Point3::origin(), 2),
            sensor: Sensor::Kinect2,
            infrared: Infrared::of_sensor(Sensor::Kinect2),
            n_moving_frames: 2,
            shading_frames: Vec::new(),
            reduction: 1,
            seed: 7,
        });
        let (frames, _, camera) = frames_of(camera.expect("full size"), 2);
        let mut fusion = fusion(camera);
        for frame in &frames {
            let depth = frame.depth.as_ref().expect("Kinect II");
            fusion.fuse(depth, frame.device_time_secs);
        }
        fusion
    }

    #[test]
    fn what_is_seen_near_the_axis_is_what_is_seen_of_all() {
        const NEAR_RAD: f64 = 0.2;
        let fused = fused();
        let whole = fused.clone().model().expect("fused").clone();
        let mut looking = fused.clone();
        // As after a frame that needed no view of it.
        looking.seen.as_mut().expect("fused").was_tracked_by = false;
        let near = looking.model_near_axis(NEAR_RAD).expect("fused").clone();
        let rays = &fused.eye.level(MODEL_LEVEL).rays;
        let (mut n_near, mut n_left_out) = (0, 0);
        for pixel in 0..rays.x.len() {
            let normal = near.normals.data()[pixel];
            if normal == Vector3::zeros() && whole.normals.data()[pixel] != normal {
                n_left_out += 1;
                let from_axis_rad = f64::from(rays.x[pixel].hypot(rays.y[pixel])).atan();
                assert!(from_axis_rad > NEAR_RAD, "{pixel}: {from_axis_rad}");
            } else if normal != Vector3::zeros() {
                n_near += 1;
                assert_eq!(normal, whole.normals.data()[pixel]);
                assert_eq!(near.points.data()[pixel], whole.points.data()[pixel]);
            }
        }
        assert!(
            n_near > 500 && n_left_out > 2 * n_near,
            "{n_near}, {n_left_out}"
        );
        // Asked for all of it afterwards, and then for less again.
        let seen_after = looking.model().expect("fused").clone();
        assert_eq!(seen_after.normals, whole.normals);
        let seen_last = looking.model_near_axis(NEAR_RAD).expect("fused");
        assert_eq!(seen_last.normals, whole.normals);
    }
}
