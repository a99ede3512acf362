//! Directions within a surface.

use nalgebra::Vector3;

/// Two unit vectors across a unit normal and across one another; `None` where there is no normal.
pub fn tangents(normal: &Vector3<f64>) -> Option<[Vector3<f64>; 2]> {
    // The axis that it has least of is never parallel to it.
    let least_axis = Vector3::ith(normal.iamin(), 1.0);
    let first = normal.cross(&least_axis).try_normalize(0.0)?;
    Some([first, normal.cross(&first)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tangents_make_a_right_handed_frame_with_any_normal() {
        for normal in [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.6, -0.48, 0.64]] {
            let normal = Vector3::from(normal);
            let [first, second] = tangents(&normal).expect("not zero");
            assert!((first.norm() - 1.0).abs() < 1e-12);
            assert!(first.dot(&normal).abs() < 1e-12);
            assert!((first.cross(&second) - normal).norm() < 1e-12);
        }
        assert_eq!(tangents(&Vector3::zeros()), None);
    }
}
