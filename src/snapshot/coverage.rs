//! Which surface still lacks which view: the information of all views so far, patch by patch.
//!
//! Of a patch's two tilts the one counts that is known less: a surface lit from one side over and over has that tilt known
//! well and the other not at all.

use super::information::{Information, PatchKey, SurfaceKey};
use nalgebra::{Point3, Vector3};
use std::collections::BTreeMap;

/// A patch is seen well enough when what is known of its lesser tilt is worth this share of all that it can be worth; with
/// [`HALF_INFORMATION`](super::information) that takes four views at 13° from 0.6 m to either side. Arbitrary.
const ENOUGH: f64 = 0.8;
/// A normal belongs to the faces along whose axes it points by this share of its largest component: the noise of a normal
/// between two axes makes no holes.
const BESIDE: f64 = 0.6;

/// What views tell of the surface's tilts.
#[derive(Clone, Debug, Default)]
pub struct Coverage(BTreeMap<SurfaceKey, Information>);

impl Coverage {
    /// The sums over the sides that patches were lit from.
    pub(super) fn of(patches: impl Iterator<Item = (PatchKey, Information)>) -> Self {
        let mut sums: BTreeMap<SurfaceKey, Information> = BTreeMap::new();
        for (key, information) in patches {
            let sum = sums.entry(key.surface()).or_default();
            *sum = sum.plus(&information);
        }
        Coverage(sums)
    }

    /// How well the tilt of the surface is known at a point of the world with a unit normal: 0 not at all, 1 well enough.
    pub fn share(&self, point_world: &Point3<f64>, normal_world: &Vector3<f64>) -> f64 {
        let information = self.information(point_world, normal_world);
        let least = information.least_tilt(normal_world);
        least.map_or(0.0, |(_, known)| share_of(known))
    }

    /// What is known of the patch at a point.
    pub(super) fn information(
        &self,
        point_world: &Point3<f64>,
        normal_world: &Vector3<f64>,
    ) -> Information {
        let beside = BESIDE * normal_world.amax();
        let axes = (0..3).filter(|&axis| normal_world[axis].abs() >= beside);
        let patches = axes.filter_map(|axis| {
            self.0
                .get(&SurfaceKey::of(&point_world.coords, normal_world, axis))
        });
        patches.fold(Information::default(), |sum, patch| sum.plus(patch))
    }
}

/// An eigenvalue of the information as a share of what is enough.
pub(super) fn share_of(known: f64) -> f64 {
    (known / (1.0 + known) / ENOUGH).min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::snapshot::information::{Optics, view_information};
    use crate::snapshot::scenes::{self, Plane};
    use depth_camera::Sensor;
    use nalgebra::UnitQuaternion;

    /// What views of one plane tell from poses that are turned about its middle by so many degrees (about x, about y).
    fn coverage(turns: &[[f64; 2]], plane: &Plane) -> Coverage {
        let optics = Optics {
            light_camera: Point3::origin(),
            ..Optics::new(&scenes::camera_info(Sensor::Kinect2)).unwrap()
        };
        let views = turns.iter().flat_map(|[x, y]| {
            let turn = Vector3::new(x.to_radians(), y.to_radians(), 0.0);
            let turn = UnitQuaternion::from_scaled_axis(turn);
            let pose = Pose::rotation_wrt_point(turn, plane.point);
            let (snapshot, model) = scenes::view_of_plane(plane, &pose);
            view_information(&snapshot, &model, &optics).patches
        });
        let mut sums: BTreeMap<PatchKey, Information> = BTreeMap::new();
        for (key, information) in views {
            let sum = sums.entry(key).or_default();
            *sum = sum.plus(&information);
        }
        Coverage::of(sums.into_iter())
    }

    #[test]
    fn a_patch_is_covered_only_when_lit_across_two_directions() {
        let plane = Plane::tilted(0.0, 0.0);
        // Inside of a patch: the plane lies on the border between two layers of them.
        let at = |x: f64| Point3::new(x, 0.01, 0.6);
        let share = |turns: &[[f64; 2]]| coverage(turns, &plane).share(&at(0.01), &plane.normal);
        assert_eq!(share(&[]), 0.0);
        let one_side = share(&[[0.0, 30.0]; 8]);
        let two_sides = share(&[[0.0, 30.0], [30.0, 0.0]]);
        let many = share(&[[[0.0, 30.0], [30.0, 0.0]]; 4].concat());
        assert!(one_side < 0.1 && two_sides > 0.5, "{one_side} {two_sides}");
        assert_eq!(many, 1.0);
        // Where the camera did not look, and on the other side of the wall, nothing is known.
        let both = coverage(&[[0.0, 30.0], [30.0, 0.0]], &plane);
        assert_eq!(both.share(&at(0.9), &plane.normal), 0.0);
        assert_eq!(both.share(&at(0.01), &-plane.normal), 0.0);
    }
}
