//! From where one more view would tell most: the tilt that is known least, of the patch that the operator points at.
//!
//! Light and camera are almost together, so that light from another side is a camera at another place. Not handled: what
//! stands in the way.

use super::coverage::{Coverage, share_of};
use super::information::{Information, Optics, SAMPLE_PX, attention_at};
use crate::fusion::ModelMap;
use crate::geometry::Pose;
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// Light falls onto the patch at this angle (30°): it changes the brightness by half of what a tilt can, and is seen well.
const LIGHT_ANGLE_RAD: f64 = 0.52;
/// A patch known by more than this share lacks no view.
const KNOWN: f64 = 0.9;
/// Patches are judged by what is seen this close to the optical axis, as its cosine: 11°. Farther away the operator does not
/// look; arbitrary.
const MIN_COS_AXIS: f64 = 0.98;

/// Where to hold the camera for the next view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Viewpoint {
    /// The camera's pose.
    pub world_from_camera: Pose,
    /// The patch that it looks at, world frame.
    pub target_world: Point3<f64>,
    /// How well the patch's tilt is known, 0 to 1: see [`Coverage::share`].
    pub known: f64,
}

/// A place on the model near the optical axis.
struct Spot {
    point: Point3<f64>,
    normal: Vector3<f64>,
    information: Information,
    known: f64,
    /// What is not known, weighed by how near the axis it lies.
    need: f64,
}

/// The viewpoint that a camera at this pose lacks most for what it looks at; `None` if nothing near its axis lacks a view.
pub(super) fn next_viewpoint(
    coverage: &Coverage,
    model: &ModelMap,
    world_from_camera: &Pose,
    optics: &Optics,
) -> Option<Viewpoint> {
    let neediest =
        spots(coverage, model, world_from_camera).max_by(|a, b| a.need.total_cmp(&b.need))?;
    if neediest.known > KNOWN {
        return None;
    }
    let eye = Point3::from(world_from_camera.translation.vector);
    let to_eye = eye - neediest.point;
    let current = to_eye.try_normalize(0.0)?;
    let tilt = missing_tilt(&neediest, &current)?;
    let light_world = neediest.normal * LIGHT_ANGLE_RAD.cos() + tilt * LIGHT_ANGLE_RAD.sin();
    let pose = pose_lighting(
        &neediest.point,
        &light_world,
        to_eye.norm(),
        world_from_camera,
        optics,
    )?;
    Some(Viewpoint {
        world_from_camera: pose,
        target_world: neediest.point,
        known: neediest.known,
    })
}

fn spots<'a>(
    coverage: &'a Coverage,
    model: &'a ModelMap,
    world_from_camera: &Pose,
) -> impl Iterator<Item = Spot> + 'a {
    let eye = Point3::from(world_from_camera.translation.vector);
    let axis = world_from_camera.rotation * Vector3::z();
    let (width, height) = (model.points.width(), model.points.height());
    let pixels = (0..height)
        .step_by(SAMPLE_PX)
        .flat_map(move |v| (0..width).step_by(SAMPLE_PX).map(move |u| (u, v)));
    pixels.filter_map(move |(u, v)| {
        let normal = model.normals.at(u, v).cast::<f64>();
        let point = Point3::from(model.points.at(u, v).cast::<f64>());
        let cos_axis = (point - eye).try_normalize(0.0)?.dot(&axis);
        if normal == Vector3::zeros() || cos_axis < MIN_COS_AXIS {
            return None;
        }
        let information = coverage.information(&point, &normal);
        let known = share_of(information.least_tilt(&normal)?.1);
        Some(Spot {
            point,
            normal,
            information,
            known,
            need: attention_at(cos_axis) * (1.0 - known),
        })
    })
}

/// The tilt to be lit, on the side where the camera is; where nothing is known yet, the way the camera leans already.
fn missing_tilt(spot: &Spot, current: &Vector3<f64>) -> Option<Vector3<f64>> {
    let leaning = current - spot.normal * spot.normal.dot(current);
    if spot.information == Information::default()
        && let Some(leaning) = leaning.try_normalize(1e-3)
    {
        return Some(leaning);
    }
    let (tilt, _) = spot.information.least_tilt(&spot.normal)?;
    Some(if tilt.dot(&leaning) < 0.0 {
        -tilt
    } else {
        tilt
    })
}

/// The pose whose light shines onto a point from a direction at a distance, the camera looking at the point as upright as it
/// is held now.
fn pose_lighting(
    point: &Point3<f64>,
    light_world: &Vector3<f64>,
    distance: f64,
    now: &Pose,
    optics: &Optics,
) -> Option<Pose> {
    let light = point + light_world * distance;
    let down = now.rotation * Vector3::y();
    // Where the light lies from the camera hangs on how the camera is turned: twice is enough for a lever of 0.2.
    let mut eye = light;
    let mut rotation = now.rotation;
    for _ in 0..2 {
        rotation = looking(&(point - eye), &down)?;
        eye = light - rotation * optics.light_camera.coords;
    }
    Some(Isometry3::from_parts(
        Translation3::from(eye.coords),
        rotation,
    ))
}

/// The camera's orientation that looks along `forward` with its rows across `down`.
fn looking(forward: &Vector3<f64>, down: &Vector3<f64>) -> Option<UnitQuaternion<f64>> {
    let z = forward.try_normalize(0.0)?;
    let x = down.cross(&z).try_normalize(1e-3)?;
    let columns = Matrix3::from_columns(&[x, z.cross(&x), z]);
    let rotation = Rotation3::from_matrix_unchecked(columns);
    Some(UnitQuaternion::from_rotation_matrix(&rotation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::snapshot::information::view_information;
    use crate::snapshot::scenes::{self, Plane};
    use depth_camera::Sensor;

    fn optics() -> Optics {
        Optics::new(&scenes::camera_info(Sensor::Kinect2)).unwrap()
    }

    /// A wall that does not lie on the border between two layers of patches.
    fn plane() -> Plane {
        Plane {
            point: Point3::new(0.0, 0.0, 0.61),
            ..Plane::tilted(0.0, 0.0)
        }
    }

    fn turned(plane: &Plane, about_x: f64, about_y: f64) -> Pose {
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(about_x, about_y, 0.0));
        Pose::rotation_wrt_point(turn, plane.point)
    }

    #[test]
    fn light_is_asked_for_across_the_direction_that_it_came_from() {
        let plane = plane();
        // Views from left and right: the vertical tilt is missing.
        let views = [-0.5, 0.5].map(|about_y| turned(&plane, 0.0, about_y));
        let coverage = Coverage::of(views.iter().flat_map(|pose| {
            let (snapshot, model) = scenes::view_of_plane(&plane, pose);
            view_information(&snapshot, &model, &optics()).patches
        }));
        let now = Pose::identity();
        let (_, model) = scenes::view_of_plane(&plane, &now);
        let next = next_viewpoint(&coverage, &model, &now, &optics()).unwrap();
        let light = next.world_from_camera * optics().light_camera;
        let l = (light - next.target_world).try_normalize(0.0).unwrap();
        assert!(
            (l.dot(&plane.normal) - LIGHT_ANGLE_RAD.cos()).abs() < 0.03,
            "{l}"
        );
        assert!(l.y.abs() > 0.4 && l.x.abs() < 0.15, "{l}");
        // As far away as before, upright, looking at the patch.
        let eye = Point3::from(next.world_from_camera.translation.vector);
        let apart = (eye - next.target_world).norm();
        assert!(
            (apart - next.target_world.coords.norm()).abs() < 0.02,
            "{apart}"
        );
        let seen = next.world_from_camera.inverse() * next.target_world;
        assert!(seen.coords.xy().norm() < 0.02 * seen.z, "{seen}");
        assert!((next.world_from_camera.rotation * Vector3::x()).y.abs() < 1e-9);
        assert!(next.known < 0.5);
    }

    #[test]
    fn what_is_known_well_lacks_nothing() {
        let plane = plane();
        let angles = [-0.6, -0.3, 0.3, 0.6];
        let around = angles
            .iter()
            .flat_map(|&angle| [[angle, 0.0], [0.0, angle]]);
        let views: Vec<Pose> = around.map(|[x, y]| turned(&plane, x, y)).collect();
        let coverage = Coverage::of(views.iter().flat_map(|pose| {
            let (snapshot, model) = scenes::view_of_plane(&plane, pose);
            view_information(&snapshot, &model, &optics()).patches
        }));
        let now = Pose::identity();
        let (_, model) = scenes::view_of_plane(&plane, &now);
        assert_eq!(next_viewpoint(&coverage, &model, &now, &optics()), None);
        let nothing = Coverage::default();
        let first = next_viewpoint(&nothing, &model, &now, &optics()).unwrap();
        assert_eq!(first.known, 0.0);
    }
}
