//! The model as the camera sees it from where the last frame was fused, cast when it is asked for.
//!
//! A frame that lies where the motion of the camera leads needs no view of the model ([`carry_on`](super::carry_on)), and casting one
//! costs more than a third of what all else of such a frame does.

use super::eye::Eye;
use super::icp::CastModel;
use super::pyramid::Level;
use super::raycast::{ModelMap, raycast};
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
    is_cast: bool,
}

impl ModelView {
    /// A view with the pixels of a level, from the pose that its frame was fused at.
    pub fn from(level: &Level, world_from_camera: &Pose) -> Self {
        ModelView {
            map: ModelMap::of_level(level),
            level: level.clone(),
            world_from_camera: *world_from_camera,
            is_cast: false,
        }
    }

    /// Moves to where the next frame was fused.
    pub fn move_to(&mut self, level: &Level, world_from_camera: &Pose) {
        self.level.depth.copy_from_slice(&level.depth);
        self.moved(world_from_camera);
    }

    /// Moves with the frame that it is of, whose pose was corrected, or whose model is another now.
    pub fn moved(&mut self, world_from_camera: &Pose) {
        self.world_from_camera = *world_from_camera;
        self.is_cast = false;
    }

    /// Casts the model, if it has not been since the last move; whether it did.
    pub fn cast(&mut self, eye: &Eye, volume: &TsdfVolume) -> bool {
        let casts = !self.is_cast;
        if casts {
            let Self {
                level,
                world_from_camera,
                map,
                ..
            } = self;
            raycast(eye.arch, volume, level, world_from_camera, eye.range, map);
            self.is_cast = true;
        }
        casts
    }

    /// What it was when the model was cast last.
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
        self.look();
        self.seen.as_ref().map(ModelView::map)
    }

    /// The model is to be seen from where the frame in hand was fused, or starts.
    pub(super) fn stand_at(&mut self, world_from_camera: &Pose) {
        let level = self.eye.level(MODEL_LEVEL);
        match &mut self.seen {
            Some(seen) => seen.move_to(level, world_from_camera),
            None => self.seen = Some(ModelView::from(level, world_from_camera)),
        }
    }

    /// Looks at the model from where it is to be seen, if that has not been done; whether it was.
    pub(super) fn look(&mut self) -> bool {
        let (eye, volume) = (&self.eye, &self.fused.volume);
        self.seen
            .as_mut()
            .is_some_and(|seen| seen.cast(eye, volume))
    }
}
