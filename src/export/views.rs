//! Where pictures are taken from: three views that frame a mesh, chosen from how the scan looked at it.

use crate::geometry::{CameraModel, Pose, TriMesh};
use depth_camera::Intrinsics;
use nalgebra::{
    Isometry3, Matrix3, Point3, Rotation3, Translation3, Unit, UnitQuaternion, Vector3,
};

/// Half the angle that the mesh's bounding sphere fills: long enough a lens that shapes look natural.
const HALF_ANGLE_RAD: f64 = 0.24;
/// Room around the bounding sphere, share of its radius.
const MARGIN: f64 = 0.03;
/// How far the side views stand aside of the front view.
const SIDE_RAD: f64 = 35.0 * std::f64::consts::PI / 180.0;
/// How far the right view is raised.
const RAISED_RAD: f64 = 20.0 * std::f64::consts::PI / 180.0;
/// A mean direction shorter than this means that the camera went around the object, so that there is no mean; arbitrary.
const MIN_MEAN_LENGTH: f64 = 0.3;

/// A camera and where it stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PictureView {
    /// Pose of the camera in the frame of the mesh.
    pub world_from_camera: Pose,
    /// The camera, with its image size.
    pub camera: CameraModel,
}

/// The size of a picture, pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PictureSize {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl Default for PictureSize {
    /// 960 × 720: two beside each other fill a report on a desktop screen.
    fn default() -> Self {
        PictureSize {
            width: 960,
            height: 720,
        }
    }
}

/// How a scan looked at its object on average: unit vectors at right angles in the frame `world`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeanView {
    forward_world: Unit<Vector3<f64>>,
    up_world: Unit<Vector3<f64>>,
}

impl MeanView {
    /// The mean over the camera poses of a scan, `world_from_camera`.
    ///
    /// Where the directions cancel (a walk around the object) the first pose stands for all; without poses it is the first
    /// camera's own, the axes of `world`.
    pub fn from_poses(world_from_camera: &[Pose]) -> Self {
        let first = world_from_camera.first().copied().unwrap_or_default();
        let mean = |axis: Vector3<f64>| {
            let sum: Vector3<f64> = world_from_camera.iter().map(|pose| pose * axis).sum();
            sum / world_from_camera.len().max(1) as f64
        };
        MeanView::from_directions(mean(Vector3::z()), mean(-Vector3::y())).unwrap_or(MeanView {
            forward_world: Unit::new_unchecked(first * Vector3::z()),
            up_world: Unit::new_unchecked(first * -Vector3::y()),
        })
    }

    /// A view along `forward_world`, upright by `up_world`; `None` if one of them is shorter than 0.3, not finite, or both
    /// are almost parallel.
    pub fn from_directions(forward_world: Vector3<f64>, up_world: Vector3<f64>) -> Option<Self> {
        let forward_world = Unit::try_new(forward_world, MIN_MEAN_LENGTH)?;
        let across = up_world - *forward_world * forward_world.dot(&up_world);
        Some(MeanView {
            forward_world,
            up_world: Unit::try_new(across, MIN_MEAN_LENGTH)?,
        })
    }

    /// The same view after the camera has gone around the object by `right_rad` to its right, then up by `raised_rad`.
    fn moved(&self, right_rad: f64, raised_rad: f64) -> MeanView {
        let around = UnitQuaternion::from_axis_angle(&self.up_world, right_rad);
        let forward = around * self.forward_world;
        let right = Unit::new_unchecked(forward.cross(&self.up_world));
        let over = UnitQuaternion::from_axis_angle(&right, -raised_rad);
        MeanView {
            forward_world: over * forward,
            up_world: over * self.up_world,
        }
    }
}

/// Three views that frame the bounding sphere of a mesh alike: the scan's mean view, from 35° to the left, and from 35° to
/// the right and 20° above. `None` if the mesh has no vertices or the picture no pixels.
///
/// Base and refined mesh are shown alike by taking the views of one of them for both.
pub fn three_views(mesh: &TriMesh, mean: &MeanView, size: PictureSize) -> Option<[PictureView; 3]> {
    let (centre, radius_m) = bounding_sphere(mesh)?;
    if size.width == 0 || size.height == 0 {
        return None;
    }
    let camera = pinhole(size);
    let distance_m = radius_m * (1.0 + MARGIN) / HALF_ANGLE_RAD.sin();
    let views = [
        mean.moved(0.0, 0.0),
        mean.moved(-SIDE_RAD, 0.0),
        mean.moved(SIDE_RAD, RAISED_RAD),
    ];
    Some(views.map(|view| PictureView {
        world_from_camera: look_at(&view, &centre, distance_m),
        camera,
    }))
}

/// A sphere around all vertices, about the middle of their bounding box; at least 1 mm in radius.
fn bounding_sphere(mesh: &TriMesh) -> Option<(Point3<f64>, f64)> {
    let first = mesh.vertices.first()?;
    let (low, high) = mesh
        .vertices
        .iter()
        .fold((*first, *first), |(low, high), vertex| {
            (low.inf(vertex), high.sup(vertex))
        });
    let centre = nalgebra::center(&low, &high);
    let radius_m = mesh
        .vertices
        .iter()
        .map(|vertex| (vertex - centre).norm())
        .fold(1e-3, f64::max);
    Some((centre, radius_m))
}

/// A camera without distortion whose shorter side sees twice [`HALF_ANGLE_RAD`].
fn pinhole(size: PictureSize) -> CameraModel {
    let focal_px = 0.5 * size.width.min(size.height) as f64 / HALF_ANGLE_RAD.tan();
    CameraModel::new(Intrinsics {
        width: size.width,
        height: size.height,
        fx: focal_px,
        fy: focal_px,
        cx: (size.width as f64 - 1.0) / 2.0,
        cy: (size.height as f64 - 1.0) / 2.0,
        k1: 0.0,
        k2: 0.0,
        p1: 0.0,
        p2: 0.0,
        k3: 0.0,
    })
}

fn look_at(view: &MeanView, centre: &Point3<f64>, distance_m: f64) -> Pose {
    let (forward, down) = (*view.forward_world, -*view.up_world);
    let axes = Matrix3::from_columns(&[down.cross(&forward), down, forward]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    Isometry3::from_parts(
        Translation3::from(centre.coords - forward * distance_m),
        rotation,
    )
}

#[cfg(test)]
mod tests {
    use super::super::tests::bumpy_sphere;
    use super::*;
    use crate::geometry::increment;
    use nalgebra::Vector6;

    #[test]
    fn every_view_frames_the_whole_mesh_and_looks_from_where_it_says() {
        let mesh = bumpy_sphere(16);
        let poses = [-0.1, 0.1].map(|a| increment(&Vector6::new(0.0, a, 0.0, 0.2, 0.0, 0.0)));
        let views =
            three_views(&mesh, &MeanView::from_poses(&poses), PictureSize::default()).unwrap();
        for view in &views {
            let camera_from_world = view.world_from_camera.inverse();
            for vertex in &mesh.vertices {
                let pixel = view.camera.project(&(camera_from_world * vertex)).unwrap();
                assert!(view.camera.contains(&pixel, 5.0));
            }
        }
        let centre = bounding_sphere(&mesh).unwrap().0;
        let [front, left, right] =
            views.map(|view| view.world_from_camera.translation.vector - centre.coords);
        // World: x right, y down, z forward; the mean view looks along z.
        assert!(front.x.abs() < 1e-9 && front.y.abs() < 1e-9 && front.z < 0.0);
        assert!(left.x < -0.1 * front.norm() && left.y.abs() < 1e-9);
        assert!(right.x > 0.1 * front.norm() && right.y < -0.1 * front.norm());
        assert!((left.angle(&front) - SIDE_RAD).abs() < 1e-9);
    }

    #[test]
    fn a_walk_around_the_object_falls_back_to_the_first_pose() {
        let turns = [0.0, 0.25, 0.5, 0.75].map(|t| t * std::f64::consts::TAU);
        let poses = turns.map(|a| increment(&Vector6::new(0.0, a, 0.0, 0.0, 0.0, 0.0)));
        let mean = MeanView::from_poses(&poses);
        assert!((mean.forward_world.into_inner() - Vector3::z()).norm() < 1e-12);
        assert_eq!(MeanView::from_poses(&[]), mean);
        assert!(three_views(&TriMesh::default(), &mean, PictureSize::default()).is_none());
    }
}
