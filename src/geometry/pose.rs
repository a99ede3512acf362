//! Rigid poses. Increments multiply on the left; the 6-vector is rotation (rad), then translation (m).

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3, Vector6};

/// A rigid transform, named `target_from_source`.
pub type Pose = Isometry3<f64>;

/// The left increment of a small motion: `increment(xi) * pose` moves `pose` by the rotation vector `xi[0..3]`, then by
/// the translation `xi[3..6]`.
pub fn increment(xi: &Vector6<f64>) -> Pose {
    Isometry3::from_parts(
        Translation3::new(xi[3], xi[4], xi[5]),
        UnitQuaternion::from_scaled_axis(Vector3::new(xi[0], xi[1], xi[2])),
    )
}

/// The same of an increment about a centre: what lies there is moved by the translation alone.
pub fn increment_about(centre: &Vector3<f64>, xi: &Vector6<f64>) -> Pose {
    let mut pose = increment(xi);
    let shift = centre - pose.rotation * centre;
    pose.translation.vector += shift;
    pose
}

/// The increment that a motion is: the inverse of [`increment`] up to half a turn.
pub fn increment_of(motion: &Pose) -> Vector6<f64> {
    let (turn, shift) = (motion.rotation.scaled_axis(), motion.translation.vector);
    Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z)
}

/// How the distance of a point to a plane grows with an increment about a centre: `lever` is the point from that centre, metres,
/// `normal` the unit normal of the plane.
pub fn point_to_plane_row(lever: &Vector3<f64>, normal: &Vector3<f64>) -> Vector6<f64> {
    let (turn, n) = (lever.cross(normal), normal);
    Vector6::new(turn.x, turn.y, turn.z, n.x, n.y, n.z)
}

/// How far two poses of a camera are apart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Angle between them, radians.
    pub rotation_rad: f64,
    /// Distance of their origins, metres.
    pub translation_m: f64,
}

impl Motion {
    /// Whether it turns and moves by less than another.
    pub fn is_within(&self, bound: &Motion) -> bool {
        self.rotation_rad < bound.rotation_rad && self.translation_m < bound.translation_m
    }
}

/// The motion that leads from one pose to another.
pub fn motion_between(world_from_a: &Pose, world_from_b: &Pose) -> Motion {
    Motion {
        rotation_rad: world_from_a.rotation.angle_to(&world_from_b.rotation),
        translation_m: (world_from_a.translation.vector - world_from_b.translation.vector).norm(),
    }
}

/// The length of the way over the origins of poses, one after another, metres.
pub fn path_length_m<'a>(world_from_cameras: impl IntoIterator<Item = &'a Pose>) -> f64 {
    let mut origins = world_from_cameras
        .into_iter()
        .map(|pose| pose.translation.vector);
    let mut previous = origins.next().unwrap_or_default();
    let steps_m = origins.map(|origin| (origin - std::mem::replace(&mut previous, origin)).norm());
    // A sum of nothing is -0.
    0.0 + steps_m.sum::<f64>()
}

/// A pose whose quaternion has unit length again. A product is off by as much as its factors are together, and so is an inverse: where
/// poses are multiplied by what was made of poses, time and again, nothing else keeps that from doubling each time.
pub fn of_unit_length(pose: &Pose) -> Pose {
    let rotation = UnitQuaternion::new_normalize(pose.rotation.into_inner());
    Isometry3::from_parts(pose.translation, rotation)
}

/// The pose halfway between two poses.
pub fn mean_pose(a: &Pose, b: &Pose) -> Pose {
    between(a, b, 0.5)
}

/// The pose that lies a share of the way, 0 to 1, from `a` to `b`.
pub fn between(a: &Pose, b: &Pose, share: f64) -> Pose {
    let relative = a.rotation.inverse() * b.rotation;
    let turn = UnitQuaternion::from_scaled_axis(relative.scaled_axis() * share);
    let (from, to) = (a.translation.vector, b.translation.vector);
    Isometry3::from_parts(
        Translation3::from(from + (to - from) * share),
        a.rotation * turn,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_of_no_pose_or_one_is_no_negative_zero_long() {
        for poses in [&[][..], &[Pose::identity()]] {
            let length_m = path_length_m(poses);
            assert!(length_m == 0.0 && length_m.is_sign_positive());
        }
    }

    #[test]
    fn an_increment_is_found_back_and_moves_a_point_along_a_normal_as_its_row_says() {
        let xi = Vector6::new(1.3, -0.4, 0.9, 0.1, -0.7, 0.2);
        assert!((increment_of(&increment(&xi)) - xi).norm() < 1e-12);
        let (centre, place) = (Vector3::new(0.2, 0.5, -0.3), Vector3::new(0.7, -0.1, 0.9));
        let normal = Vector3::new(0.48, -0.6, 0.64);
        let row = point_to_plane_row(&(place - centre), &normal);
        let step = 1e-5;
        for k in 0..6 {
            let moved = |by: f64| {
                let motion = increment_about(&centre, &(by * Vector6::ith(k, 1.0)));
                (motion.rotation * place + motion.translation.vector).dot(&normal)
            };
            let slope = (moved(step) - moved(-step)) / (2.0 * step);
            assert!((slope - row[k]).abs() < 1e-8, "{k}: {slope} {}", row[k]);
        }
    }

    #[test]
    fn mean_pose_lies_halfway() {
        let a = increment(&Vector6::new(0.1, -0.2, 0.05, 0.3, 0.1, -0.4));
        let b = increment(&Vector6::new(-0.2, 0.1, 0.4, 0.1, 0.0, 0.2));
        let mean = mean_pose(&a, &b);
        let (to_a, to_b) = (motion_between(&mean, &a), motion_between(&mean, &b));
        assert!((to_a.rotation_rad - to_b.rotation_rad).abs() < 1e-12);
        assert!((to_a.translation_m - to_b.translation_m).abs() < 1e-12);
        let whole = motion_between(&a, &b);
        assert!((whole.rotation_rad - 2.0 * to_a.rotation_rad).abs() < 1e-9);
    }
}
