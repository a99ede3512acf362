//! Which pixels of a shading image show the surface alone.

use super::optics::Optics;
use depth_camera::Image;

/// Live depth nearer than the model by this much is something in front of it, metres.
const OCCLUDER_M: f32 = 0.015;
/// So is one by as many standard deviations of the depth, where these are more: from 1.6 m on with a Kinect I.
const OCCLUDER_SIGMAS: f32 = 4.0;
/// Depth differences beyond this between pixels two apart are an edge, metres; 81° at 0.6 m on Kinect II.
const DEPTH_EDGE_M: f32 = 0.02;
/// So are those beyond as many pixels' widths, where these are more: slants of 81° at any distance.
const DEPTH_EDGE_PX: f32 = 12.0;

/// Marks pixels at depth edges of the model, and where the live depth sees something in front of it, as unusable (NaN).
pub fn mask_edges_and_occluders(
    optics: &Optics,
    linear: &mut Image<f32>,
    model_depth_m: &Image<f32>,
    live_depth_m: &Image<f32>,
) {
    let nearest = of_pixels_around(model_depth_m, |a, b| if a < b { a } else { b });
    let farthest = of_pixels_around(model_depth_m, |a, b| if a > b { a } else { b });
    let edge_share = DEPTH_EDGE_PX / optics.rays.camera().intrinsics().fx as f32;
    let depths = model_depth_m.data().iter().zip(live_depth_m.data());
    let around = nearest.data().iter().zip(farthest.data());
    let pixels = linear.data_mut().iter_mut().zip(depths.zip(around));
    for (value, ((&centre, &live), (nearest, farthest))) in pixels {
        // Not so where one of them is infinite, or beyond the border.
        let edge_m = DEPTH_EDGE_M.max(edge_share * centre);
        let is_smooth = centre - nearest < edge_m && farthest - centre < edge_m;
        let occluder_m = OCCLUDER_M.max(OCCLUDER_SIGMAS * optics.depth_noise.sigma_m(centre));
        let is_hidden = live > 0.0 && live < centre - occluder_m;
        if !is_smooth || is_hidden {
            *value = f32::NAN;
        }
    }
}

/// What `of_two` takes of all pixels up to two beside each, which are numbers; NaN for pixels that are not so far from the border.
fn of_pixels_around(image: &Image<f32>, of_two: impl Fn(f32, f32) -> f32) -> Image<f32> {
    const REACH: usize = 2;
    const SIDE: usize = 2 * REACH + 1;
    let (width, height) = (image.width(), image.height());
    let mut of_rows = Image::filled(width, height, f32::NAN);
    let mut of_all = of_rows.clone();
    if width < SIDE || height < SIDE {
        return of_all;
    }
    let inner = REACH..width - REACH;
    for (v, out) in of_rows.data_mut().chunks_exact_mut(width).enumerate() {
        let [a, b, c, d, e] = [0, 1, 2, 3, 4].map(|left| &image.row(v)[left..]);
        for (u, out) in out[inner.clone()].iter_mut().enumerate() {
            *out = of_two(of_two(of_two(a[u], b[u]), of_two(c[u], d[u])), e[u]);
        }
    }
    let rows = of_all.data_mut().chunks_exact_mut(width);
    for (above, out) in rows.skip(REACH).take(height - 2 * REACH).enumerate() {
        let [a, b, c, d, e] = [0, 1, 2, 3, 4].map(|below| of_rows.row(above + below));
        for u in inner.clone() {
            out[u] = of_two(of_two(of_two(a[u], b[u]), of_two(c[u], d[u])), e[u]);
        }
    }
    of_all
}

#[cfg(test)]
mod tests {
    use super::super::scenes::{calibration, optics, rays};
    use super::*;
    use crate::fusion::DepthNoise;
    use depth_camera::Sensor;

    #[test]
    fn pixels_near_edges_the_border_and_what_stands_before_the_model_are_not_used() {
        let (width, height) = (16, 11);
        let at = |u: usize, v: usize| v * width + u;
        let mut model = vec![0.6f32; width * height];
        for v in 0..height {
            for u in 10..width {
                model[at(u, v)] = if v < 6 { 0.65 } else { 0.61 };
            }
        }
        let mut live = model.clone();
        model[at(4, 8)] = f32::INFINITY;
        live[at(4, 3)] = 0.58;
        live[at(5, 3)] = 0.0;
        let image = |values: &[f32]| Image::from_vec(width, height, values.to_vec());
        let mut linear = Image::filled(width, height, 1.0);
        let (rays, calibration) = (rays(), calibration());
        let optics = optics(&rays, &calibration);
        mask_edges_and_occluders(&optics, &mut linear, &image(&model), &image(&live));
        let differs = |u: usize, v: usize| {
            let around = (v - 2..=v + 2).flat_map(|y| (u - 2..=u + 2).map(move |x| (x, y)));
            let mut apart = around.map(|(x, y)| (model[at(x, y)] - model[at(u, v)]).abs());
            apart.any(|apart| apart >= DEPTH_EDGE_M || apart.is_nan())
        };
        for v in 0..height {
            for u in 0..width {
                let is_inside = u >= 2 && v >= 2 && u + 2 < width && v + 2 < height;
                let expected = is_inside && !differs(u, v) && (u, v) != (4, 3);
                assert_eq!(!linear.at(u, v).is_nan(), expected, "{u}, {v}");
            }
        }
    }

    #[test]
    fn far_away_slants_and_the_noise_of_depth_are_neither_edges_nor_occluders() {
        let (rays, calibration) = (rays(), calibration());
        let optics = Optics {
            depth_noise: DepthNoise::of_sensor(Sensor::Kinect1),
            ..optics(&rays, &calibration)
        };
        let (side, middle) = (9, (4, 4));
        // A slant whose depth changes by `slope` pixels' widths a pixel, and live depth before it.
        let is_used = |z_m: f32, slope: f32, before_m: f32| {
            let width_m = z_m / 500.0;
            let columns = (0..side * side).map(|pixel| (pixel % side) as f32 - 4.0);
            let model = columns.map(|column| z_m + slope * width_m * column);
            let model = Image::from_vec(side, side, model.collect());
            let live = model.map(|&z| z - before_m);
            let mut linear = Image::filled(side, side, 1.0);
            mask_edges_and_occluders(&optics, &mut linear, &model, &live);
            !linear.at(middle.0, middle.1).is_nan()
        };
        // 80° and 82°; nearer than 0.83 m what is 20 mm deep is no edge.
        for z_m in [1.5, 3.0] {
            assert!(is_used(z_m, 5.67, 0.0) && !is_used(z_m, 7.1, 0.0), "{z_m}");
        }
        assert!(is_used(0.6, 7.1, 0.0));
        // Four standard deviations of a Kinect I are 56 mm at 3 m.
        assert!(is_used(3.0, 0.0, 0.05) && !is_used(3.0, 0.0, 0.06));
        assert!(is_used(0.6, 0.0, 0.014) && !is_used(0.6, 0.0, 0.016));
    }
}
