//! A slow error of depth by where a pixel looks, as far as it is told with focal lengths, for which it passes.
//!
//! Not what is taken off depth, which [`DepthField`](crate::fusion::DepthField) tells more finely where frames lie against their model.

use nalgebra::Point3;

/// Products of powers of where a pixel looks, across and down, from the first to the fourth.
pub(super) const N_PARTS: usize = 14;
/// Largest sum of two powers.
const DEGREE: i32 = 4;
/// Tangents about where a Kinect I's image ends, across and down: 1 in the powers.
const TANGENTS: [f64; 2] = [0.55, 0.41];

/// Coefficients of a slow error's parts: depth is too long by so much at the border of the image and a metre, metres, and elsewhere by the
/// square of depth, as disparity errs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct SlowField(pub(super) [f64; N_PARTS]);

impl SlowField {
    /// By what share of itself the depth of a place (m) in the camera's frame is too long.
    pub(super) fn share_at(&self, place: &Point3<f64>) -> f64 {
        let parts = parts(place).into_iter().zip(self.0);
        parts.map(|(part, of_it_m)| part * of_it_m).sum()
    }
}

/// What a metre of each part makes of that share.
pub(super) fn parts(place: &Point3<f64>) -> [f64; N_PARTS] {
    let [x, y] = [
        place.x / place.z / TANGENTS[0],
        place.y / place.z / TANGENTS[1],
    ];
    let powers = (1..=DEGREE).flat_map(|sum| (0..=sum).map(move |of_y| (sum - of_y, of_y)));
    let mut parts = [0.0; N_PARTS];
    for (part, (of_x, of_y)) in parts.iter_mut().zip(powers) {
        *part = place.z * x.powi(of_x) * y.powi(of_y);
    }
    parts
}
