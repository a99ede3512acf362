//! Rigid motions for kernels.

use super::Pose;

/// A rigid motion in single precision: turns, then shifts.
#[derive(Clone, Copy, Debug)]
pub struct Rigid {
    /// Rows of the rotation.
    pub rows: [[f32; 3]; 3],
    /// Where the origin comes to lie, metres.
    pub shift: [f32; 3],
}

impl Rigid {
    /// The motion of a pose.
    pub fn new(pose: &Pose) -> Self {
        let rotation = pose.rotation.to_rotation_matrix();
        Rigid {
            rows: rotation.matrix().cast::<f32>().transpose().into(),
            shift: pose.translation.vector.cast::<f32>().into(),
        }
    }

    /// Where a point comes to lie.
    #[inline(always)]
    pub fn point(&self, point: [f32; 3]) -> [f32; 3] {
        let [x, y, z] = self.turn(point);
        [x + self.shift[0], y + self.shift[1], z + self.shift[2]]
    }

    /// A direction, turned.
    #[inline(always)]
    pub fn turn(&self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        let [a, b, c] = &self.rows;
        [
            a[0] * x + a[1] * y + a[2] * z,
            b[0] * x + b[1] * y + b[2] * z,
            c[0] * x + c[1] * y + c[2] * z,
        ]
    }

    /// A direction, turned the other way.
    #[inline(always)]
    pub fn turn_back(&self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        let [a, b, c] = &self.rows;
        [
            a[0] * x + b[0] * y + c[0] * z,
            a[1] * x + b[1] * y + c[1] * z,
            a[2] * x + b[2] * y + c[2] * z,
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::increment;
    use nalgebra::{Point3, Vector3, Vector6};

    #[test]
    fn points_and_directions_go_where_the_pose_takes_them() {
        let pose = increment(&Vector6::new(0.4, -1.1, 0.7, 0.3, -0.2, 0.9));
        let rigid = Rigid::new(&pose);
        let place = [0.21f32, -0.34, 1.2];
        let there = pose * Point3::from(place).cast::<f64>();
        let off = Point3::from(rigid.point(place)).cast::<f64>() - there;
        assert!(off.norm() < 1e-6, "{off}");
        let turned = pose.rotation * Vector3::from(place).cast::<f64>();
        let off = Vector3::from(rigid.turn(place)).cast::<f64>() - turned;
        assert!(off.norm() < 1e-6, "{off}");
        let back = rigid.turn_back(rigid.turn(place));
        let off = Vector3::from(back) - Vector3::from(place);
        assert!(off.norm() < 1e-6, "{off}");
    }
}
