//! Finding back into the model after tracking was lost: by the places where the camera has been.
//!
//! Small depth images, *thumbnails*, of places well apart are kept with their poses. A lost frame is aligned to the model as
//! seen from the places that look most like it. Inliers and residual cannot tell a false lock from a true one, free space
//! can: what the frame shows and what the model shows from the pose found must agree. Even then the pose is a hypothesis that
//! the next frame has to confirm.
//!
//! A lost frame must not take much longer than a tracked one, or the camera is gone before it is found. So the model is looked
//! at from few places a frame; these views hold as long as nothing is fused, and are kept for the frames that follow.
//!
//! Not handled: places that were never seen from near where the camera is now.

use super::eye::Eye;
use super::icp::{self, CastModel};
use super::pose_correction::PoseCorrection;
use super::pyramid::{FramePyramid, N_REDUCED};
use super::raycast::{ModelMap, raycast_anywhere};
use super::track::Track;
use super::volume::TsdfVolume;
use super::{
    Fit, Fusion, FusionParams, MODEL_LEVEL,
    align::{Beside, align},
    gates,
};
use crate::geometry::{Motion, Pose, motion_between};
use nalgebra::{Point3, Vector3};
use std::collections::BTreeMap;

/// The level at whose resolution the model is looked at from a place, which is only near the camera; what is found is looked at
/// as in tracking.
const NEAR_LEVEL: usize = N_REDUCED - 1;

/// Columns and rows of a thumbnail.
const COLUMNS: usize = 16;
const ROWS: usize = 12;
/// Depths that differ by more than this differ altogether, metres; arbitrary, the size of what is scanned.
const MAX_DIFFERENCE_M: f32 = 0.1;
/// A new place is so far from all others: alignment reaches twice as far.
const PLACE: Motion = Motion {
    rotation_rad: 0.1,
    translation_m: 0.08,
};
/// So many places at most, of 0.9 kB; later ones are not kept.
const MAX_PLACES: usize = 8000;
/// So many of the places that look most alike are tried.
const N_CANDIDATES: usize = 5;
/// The model is looked at from so many of them a frame that it was not looked at from before: rays that march through the whole
/// range are most of what a lost frame costs.
const N_NEW_VIEWS: usize = 2;
/// So many views are kept, of 81 kB for a Kinect II.
const MAX_VIEWS: usize = 32;
/// So many of the poses that lie best on a place's view are looked at closely.
const N_CLOSE_LOOKS: usize = 2;
/// Least share of the frame's points on the model; tracking believes in 0.35, but knows where it was before.
const MIN_INLIER_SHARE: f64 = 0.5;
/// Surfaces closer than this many sigmas of the depth noise are the same: drift of 10 mm and slant are to be allowed for.
const AGREEING_SIGMAS: f32 = 6.0;
/// A camera looks through the model where it sees a surface behind it by so many sigmas, slant allowed for, and not just by what
/// tracking may err: the far side of a real desk is rough by more than that.
const THROUGH_SIGMAS: f32 = 3.0;
/// Least share of the pixels that the model can judge, by which it agrees: 0.987 and more when true, on a real desk too, up to
/// 0.957 when the place is another one, and 0.964 for a lock some centimetres off in the right place.
const MIN_AGREEING_SHARE: f64 = 0.975;
/// The same of a frame of which much found no place, and that does not go on as the camera did before: 0.96 and more when true, fast and
/// over half a model, too, 0.75 to 0.92 where the camera has slid away.
const MIN_AGREEING_SHARE_AFTER_A_JERK: f64 = 0.93;
/// Largest share of the pixels seen through the model: up to 0.03 when true.
const MAX_SEE_THROUGH_SHARE: f64 = 0.05;

/// Mean depths of the cells of a depth image, metres; 0 where most pixels are missing.
type Thumbnail = Vec<f32>;

/// The places where the camera has been.
#[derive(Clone, Debug, Default)]
pub(super) struct Places {
    /// In order of time.
    places: Vec<Place>,
    /// The model as it is now seen from some of them, by their number.
    views: BTreeMap<usize, ModelMap>,
}

/// A place, when the camera was there first (s), and what it saw.
#[derive(Clone, Debug)]
struct Place {
    world_from_camera: Pose,
    time_secs: f64,
    seen: Thumbnail,
}

/// A pose that the next frame has to confirm.
#[derive(Clone, Debug)]
pub(super) struct Hypothesis {
    pub(super) world_from_camera: Pose,
    /// The model as seen from there.
    pub(super) model: ModelMap,
}

impl Places {
    /// Takes the place of a frame in if it is a new one.
    pub(super) fn visit(&mut self, eye: &Eye, track: &Track) {
        let is_near = |place: &Place| {
            motion_between(&place.world_from_camera, &track.world_from_camera).is_within(&PLACE)
        };
        if self.places.len() == MAX_PLACES || self.places.iter().rev().any(is_near) {
            return;
        }
        self.places.push(Place {
            world_from_camera: track.world_from_camera,
            time_secs: track.time_secs,
            seen: thumbnail(&eye.frame),
        });
        if self.places.len() == MAX_PLACES {
            tracing::warn!(
                n_places = MAX_PLACES,
                "a camera that is lost is found only where it has been by now: no more places are kept"
            );
        }
    }

    /// Moves all places.
    pub(super) fn correct(&mut self, correction: &PoseCorrection) {
        for place in &mut self.places {
            place.world_from_camera = correction.apply(place.time_secs, &place.world_from_camera);
        }
        self.forget_views();
    }

    /// Forgets the places that were found later than `after_secs`.
    pub(super) fn forget_after(&mut self, after_secs: f64) {
        self.places.retain(|place| place.time_secs <= after_secs);
        self.forget_views();
    }

    /// Forgets the views of a model that has changed.
    pub(super) fn forget_views(&mut self) {
        self.views.clear();
    }

    /// The places that look most like a frame, the likest first.
    fn alike(&self, frame: &FramePyramid) -> Vec<usize> {
        let live = thumbnail(frame);
        let differences = self
            .places
            .iter()
            .map(|place| difference(&live, &place.seen));
        let mut places: Vec<(f32, usize)> = differences.zip(0..).collect();
        places.sort_by(|a, b| a.0.total_cmp(&b.0));
        places.truncate(N_CANDIDATES);
        places.into_iter().map(|(_, place)| place).collect()
    }

    /// Looks at the model from some of the places from which that was not done before.
    fn look_from(&mut self, places: &[usize], eye: &Eye, volume: &TsdfVolume) {
        if self.views.len() > MAX_VIEWS {
            self.views.retain(|place, _| places.contains(place));
        }
        let is_new = |place: &&usize| !self.views.contains_key(place);
        let new: Vec<usize> = places.iter().filter(is_new).copied().collect();
        for place in new.into_iter().take(N_NEW_VIEWS) {
            let pose = &self.places[place].world_from_camera;
            let view = seen_from(pose, eye, volume, NEAR_LEVEL);
            self.views.insert(place, view);
        }
    }

    /// Where in the model a frame may have been taken: the candidate that looks least through the model of those that pass
    /// every gate. A frame like one before it is looked for from further places.
    pub(super) fn relocalise(
        &mut self,
        eye: &Eye,
        volume: &TsdfVolume,
        params: &FusionParams,
    ) -> Option<Hypothesis> {
        let places = self.alike(&eye.frame);
        self.look_from(&places, eye, volume);
        let near = places.iter().filter_map(|place| {
            let view = self.views.get(place)?;
            let pose = &self.places[*place].world_from_camera;
            let (pose, fit) = align_to(view, NEAR_LEVEL, pose, eye, volume, params)?;
            (fit.inlier_share >= params.min_inlier_share).then_some((fit.inlier_share, pose))
        });
        let mut near: Vec<(f64, Pose)> = near.collect();
        near.sort_by(|a, b| b.0.total_cmp(&a.0));
        near.truncate(N_CLOSE_LOOKS);
        let found = near
            .iter()
            .filter_map(|(_, pose)| lock(pose, eye, volume, params));
        found
            .min_by(|a, b| a.0.see_through_share.total_cmp(&b.0.see_through_share))
            .map(|(_, hypothesis)| hypothesis)
    }
}

/// Aligns the frame in hand to the model as seen from a pose.
fn align_to(
    map: &ModelMap,
    level: usize,
    pose: &Pose,
    eye: &Eye,
    volume: &TsdfVolume,
    params: &FusionParams,
) -> Option<(Pose, Fit)> {
    let model = CastModel {
        map,
        lens: &eye.level(level).lens,
        world_from_camera: pose,
    };
    align(
        eye,
        &model,
        volume,
        pose,
        params,
        Beside::default(),
        &mut |_| {},
    )
}

/// Aligns the frame in hand to the model as seen from near where it was taken.
pub(super) fn align_closely(
    near: &Pose,
    eye: &Eye,
    volume: &TsdfVolume,
    params: &FusionParams,
) -> Option<(Pose, Fit)> {
    let view = seen_from(near, eye, volume, MODEL_LEVEL);
    align_to(&view, MODEL_LEVEL, near, eye, volume, params)
}

/// As [`align_closely`], and judges the result.
fn lock(
    near: &Pose,
    eye: &Eye,
    volume: &TsdfVolume,
    params: &FusionParams,
) -> Option<(Fit, Hypothesis)> {
    let (pose, fit) = align_closely(near, eye, volume, params)?;
    gates::judge_fit(&fit, &eye.frame, &eye.noise, params).ok()?;
    let Believed { model, .. } = believe(&pose, &fit, eye, volume)?;
    Some((
        fit,
        Hypothesis {
            world_from_camera: pose,
            model,
        },
    ))
}

/// A pose that does not follow from the one before, and is believed.
pub(super) struct Believed {
    /// The model as seen from there.
    pub(super) model: ModelMap,
    /// Share of the pixels of frame and model that show the same surface.
    pub(super) agreeing_share: f64,
}

/// Looks at the model from a pose that does not follow from the one before; `None` if it cannot be believed.
pub(super) fn believe(pose: &Pose, fit: &Fit, eye: &Eye, volume: &TsdfVolume) -> Option<Believed> {
    let model = seen_from(pose, eye, volume, MODEL_LEVEL);
    let shares = compare(eye, &model, pose, volume.voxel_size_m());
    let is_true = fit.inlier_share >= MIN_INLIER_SHARE
        && shares.seen_through <= MAX_SEE_THROUGH_SHARE
        && shares.agreeing >= MIN_AGREEING_SHARE;
    is_true.then_some(Believed {
        model,
        agreeing_share: shares.agreeing,
    })
}

/// Whether the model shows something else than the frame in hand from a pose that the camera came to with a jerk.
pub(super) fn has_slid(pose: &Pose, eye: &Eye, volume: &TsdfVolume) -> bool {
    let model = seen_from(pose, eye, volume, MODEL_LEVEL);
    let shares = compare(eye, &model, pose, volume.voxel_size_m());
    shares.agreeing < MIN_AGREEING_SHARE_AFTER_A_JERK
}

impl Fusion {
    /// The model as the camera would see it from a pose, at a quarter of the resolution.
    pub fn seen_from(&self, world_from_camera: &Pose) -> ModelMap {
        seen_from(
            world_from_camera,
            &self.eye,
            &self.fused.volume,
            MODEL_LEVEL,
        )
    }
}

fn seen_from(pose: &Pose, eye: &Eye, volume: &TsdfVolume, level: usize) -> ModelMap {
    raycast_anywhere(volume, eye.level(level), pose, eye.range)
}

/// Shares of the pixels that show a surface both in the frame and in the model as seen from the frame's own pose.
struct Shares {
    /// The camera looks through the model.
    seen_through: f64,
    /// It is the same surface, drift and slant allowed for: neither does the camera look far through the model, nor does something stand
    /// where the model was seen to be empty.
    agreeing: f64,
}

/// Compares a frame with the model as seen from its pose. A pixel may show what the model shows at it or beside it: in fast
/// turns rims are a pixel off, and a real desk is full of them.
fn compare(eye: &Eye, model: &ModelMap, pose: &Pose, voxel_size_m: f32) -> Shares {
    let level = eye.level(MODEL_LEVEL);
    let (width, height) = (level.rays.width, level.rays.height);
    let depths = depths_of(model, pose);
    let behind_m = icp::BEHIND_VOXELS * voxel_size_m;
    let (mut n_seen, mut n_through, mut n_agreeing) = (0usize, 0usize, 0usize);
    for (pixel, &z) in level.depth.iter().enumerate() {
        if z <= 0.0 || depths[pixel] <= 0.0 {
            continue;
        }
        let (u, v) = (pixel % width, pixel / width);
        let (mut near_m, mut far_m) = (depths[pixel], depths[pixel]);
        for row in v.saturating_sub(1)..(v + 2).min(height) {
            let around = u.saturating_sub(1)..(u + 2).min(width);
            for &beside in &depths[row * width..][around] {
                near_m = near_m.min(if beside > 0.0 { beside } else { near_m });
                far_m = far_m.max(beside);
            }
        }
        // A pixel's depth varies over the pixel as it does on a slope of 75°.
        let slope_m = 4.0 * z / width as f32;
        let sigma_m = eye.noise.sigma_m(z);
        let margin_m = AGREEING_SIGMAS * sigma_m + slope_m;
        let through_m = behind_m.max(THROUGH_SIGMAS * sigma_m + slope_m);
        n_seen += 1;
        n_through += usize::from(z > far_m + through_m);
        n_agreeing += usize::from((near_m - margin_m..=far_m + margin_m).contains(&z));
    }
    let share = |n: usize| n as f64 / n_seen.max(1) as f64;
    Shares {
        seen_through: share(n_through),
        agreeing: share(n_agreeing),
    }
}

/// Depths of a model's surfaces from the pose that it was looked at from, metres; 0 where there is none.
fn depths_of(model: &ModelMap, pose: &Pose) -> Vec<f32> {
    let camera_from_world = pose.inverse();
    let surfaces = model.points.data().iter().zip(model.normals.data());
    let depth = |(surface, normal): (&Vector3<f32>, &Vector3<f32>)| {
        if *normal == Vector3::zeros() {
            return 0.0;
        }
        (camera_from_world * Point3::from(surface.cast::<f64>())).z as f32
    };
    surfaces.map(depth).collect()
}

fn thumbnail(frame: &FramePyramid) -> Thumbnail {
    let level = &frame.reduced[N_REDUCED - 1];
    let (width, height) = (level.rays.width, level.rays.height);
    let mut cells = Vec::with_capacity(COLUMNS * ROWS);
    for row in 0..ROWS {
        for column in 0..COLUMNS {
            let (mut sum, mut n_valid, mut n) = (0.0, 0, 0);
            for v in row * height / ROWS..(row + 1) * height / ROWS {
                for u in column * width / COLUMNS..(column + 1) * width / COLUMNS {
                    let z = level.depth[v * width + u];
                    n += 1;
                    n_valid += usize::from(z > 0.0);
                    sum += z;
                }
            }
            cells.push(if 2 * n_valid > n {
                sum / n_valid as f32
            } else {
                0.0
            });
        }
    }
    cells
}

/// Mean difference of the cells in which either shows something, metres.
fn difference(a: &Thumbnail, b: &Thumbnail) -> f32 {
    let (mut sum, mut n) = (0.0, 0);
    for (a, b) in a.iter().zip(b) {
        match (*a > 0.0, *b > 0.0) {
            (false, false) => continue,
            (true, true) => sum += (a - b).abs().min(MAX_DIFFERENCE_M),
            _ => sum += MAX_DIFFERENCE_M,
        }
        n += 1;
    }
    sum / n.max(1) as f32
}
