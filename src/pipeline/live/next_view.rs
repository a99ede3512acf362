//! Where to hold the camera next, in words.

use super::NextView;
use crate::{geometry::Pose, snapshot::Viewpoint};
use nalgebra::Vector3;

/// A way to go that is shorter is not told, metres.
const NEAR_M: f64 = 0.05;

/// A viewpoint as the operator who holds the camera at `world_from_camera` reads it.
pub fn told(viewpoint: &Viewpoint, world_from_camera: &Pose) -> NextView {
    let next = &viewpoint.world_from_camera;
    let way = next.translation.vector - world_from_camera.translation.vector;
    let way_camera = world_from_camera.rotation.inverse() * way;
    let lit = match 100.0 * viewpoint.known {
        known if known < 1.0 => "has not been lit yet".to_owned(),
        known => format!("is known to {known:.0} %"),
    };
    let why = match direction(&way_camera) {
        Some(direction) => format!(
            "Move {:.0} cm {direction} and keep pointing at the middle of the picture, which {lit}.",
            100.0 * way.norm()
        ),
        None => format!("Hold still for a moment: the middle of the picture {lit}."),
    };
    NextView {
        world_from_camera: *next,
        why,
    }
}

/// The main direction of a way in the camera frame (x right, y down, z forward).
fn direction(way_camera: &Vector3<f64>) -> Option<&'static str> {
    let axis = way_camera.iamax();
    let names = [
        ["to the left", "to the right"],
        ["up", "down"],
        ["back", "forward"],
    ];
    let is_far = way_camera.norm() >= NEAR_M;
    is_far.then(|| names[axis][usize::from(way_camera[axis] > 0.0)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    #[test]
    fn ways_are_told_as_the_camera_is_held() {
        let why = |way: [f64; 3], known: f64| {
            // Held with its right side up.
            let now = Pose::rotation(Vector3::z() * std::f64::consts::FRAC_PI_2);
            let viewpoint = Viewpoint {
                world_from_camera: Pose::translation(way[0], way[1], way[2]),
                target_world: Point3::new(0.0, 0.0, 0.6),
                known,
            };
            told(&viewpoint, &now).why
        };
        assert!(why([0.0, 0.24, 0.1], 0.0).starts_with("Move 26 cm to the right and"));
        assert!(why([0.3, 0.0, 0.0], 0.31).starts_with("Move 30 cm up"));
        assert!(why([0.3, 0.0, 0.0], 0.31).ends_with("is known to 31 %."));
        assert!(why([0.0, 0.0, 0.01], 0.0).starts_with("Hold still"));
    }
}
