//! Which pixels of a shading image show the surface alone.

use super::optics::Optics;
use depth_camera::Image;

/// Live depth nearer than the model by this much is something in front of it, metres.
const OCCLUDER_M: f32 = 0.015;
/// So is one by as many standard deviations of the depth, where these are more: from 1.6 m on with a Kinect I.
const OCCLUDER_SIGMAS: f32 = 4.0;
/// Depth differences beyond this between neighbouring pixels are an edge, metres; 83° at 0.6 m on Kinect II, along rows and columns. With
/// 20 mm what mixes there moved whole surfaces, 10 mm left out more (docs/experiments-refinement.md).
const DEPTH_EDGE_M: f32 = 0.014;
/// So are those beyond as many pixels' widths, where these are more: slants of 83° at any distance.
const DEPTH_EDGE_PX: f32 = 8.5;
/// The live depth denies an edge of the model if it has none within so many pixels of there: that of a Kinect I ends half its window
/// beyond what it sees.
const DENIED_WITHIN_PX: usize = 4;

/// Marks pixels at depth edges of the model, and where the live depth sees something in front of it, as unusable (NaN). Where the
/// model ends but the live depth goes on as far as the model does beside it, as round what few frames saw, there is no edge, but for five
/// pixels along the border of the image.
///
/// Returns which pixels are clear of edges: those within two pixels of one may still show a little of both sides.
pub fn mask_edges_and_occluders(
    optics: &Optics,
    linear: &mut Image<f32>,
    model_depth_m: &Image<f32>,
    live_depth_m: &Image<f32>,
) -> Image<bool> {
    let is_before = |live: f32, z_m: f32| {
        let occluder_m = OCCLUDER_M.max(OCCLUDER_SIGMAS * optics.depth_noise.sigma_m(live));
        live > 0.0 && live < z_m - occluder_m
    };
    // The model, with the live depth where that lies before it.
    let mut foremost_m = model_depth_m.clone();
    for (foremost, &live) in foremost_m.data_mut().iter_mut().zip(live_depth_m.data()) {
        if is_before(live, *foremost) {
            *foremost = live;
        }
    }
    let nearest_m = of_pixels_around(model_depth_m, lesser);
    let model_edges = depth_edges(model_depth_m, &nearest_m, optics);
    let foremost_nearest_m = of_pixels_around(&foremost_m, lesser);
    let mut foremost_edges = depth_edges(&foremost_m, &foremost_nearest_m, optics);
    for _ in 0..DENIED_WITHIN_PX {
        foremost_edges = of_pixels_around(&foremost_edges, greater);
    }
    let model_m = model_depth_m.data().iter().zip(nearest_m.data());
    let edges = model_edges.data().iter().zip(foremost_edges.data());
    let depths = live_depth_m.data().iter().zip(model_m);
    let pixels = linear.data_mut().iter_mut().zip(edges.zip(depths));
    for (value, ((&of_model, &of_foremost), (&live, (&centre, &nearest)))) in pixels {
        let is_usable = match of_model == 0.0 {
            true => !is_before(live, centre),
            // Beyond the model's end it shows what the model does beside it. On the border of the image this is NaN.
            false => of_foremost == 0.0 && !is_before(live, nearest),
        };
        if !is_usable {
            *value = f32::NAN;
        }
    }
    of_pixels_around(&model_edges, greater).map(|&near| near == 0.0)
}

/// 1 at the depth edges of an image, given the nearest round each pixel, and on its border, 0 elsewhere.
fn depth_edges(depth_m: &Image<f32>, nearest_m: &Image<f32>, optics: &Optics) -> Image<f32> {
    let edge_share = DEPTH_EDGE_PX / optics.rays.camera().intrinsics().fx as f32;
    let farthest_m = of_pixels_around(depth_m, greater);
    let mut edges = depth_m.clone();
    let around = nearest_m.data().iter().zip(farthest_m.data());
    for (edge, (nearest, farthest)) in edges.data_mut().iter_mut().zip(around) {
        let centre = *edge;
        let edge_m = DEPTH_EDGE_M.max(edge_share * centre);
        // Not so where one of them is infinite, or beyond the border.
        let is_smooth = centre - nearest < edge_m && farthest - centre < edge_m;
        *edge = f32::from(u8::from(!is_smooth));
    }
    edges
}

fn lesser(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

fn greater(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// What `of_two` takes of each pixel and the eight round it; NaN on the border, and beside it where it is on the border of the image already.
fn of_pixels_around(image: &Image<f32>, of_two: impl Fn(f32, f32) -> f32) -> Image<f32> {
    let (width, height) = (image.width(), image.height());
    let mut of_rows = Image::filled(width, height, f32::NAN);
    let mut of_all = of_rows.clone();
    if width < 3 || height < 3 {
        return of_all;
    }
    let inner = 1..width - 1;
    for (v, out) in of_rows.data_mut().chunks_exact_mut(width).enumerate() {
        let [a, b, c] = [0, 1, 2].map(|left| &image.row(v)[left..]);
        for (u, out) in out[inner.clone()].iter_mut().enumerate() {
            *out = of_two(of_two(a[u], b[u]), c[u]);
        }
    }
    let rows = of_all.data_mut().chunks_exact_mut(width);
    for (above, out) in rows.skip(1).take(height - 2).enumerate() {
        let [a, b, c] = [0, 1, 2].map(|below| of_rows.row(above + below));
        for u in inner.clone() {
            out[u] = of_two(of_two(a[u], b[u]), c[u]);
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
        live[at(4, 8)] = 0.0;
        live[at(4, 3)] = 0.58;
        live[at(5, 3)] = 0.0;
        let image = |values: &[f32]| Image::from_vec(width, height, values.to_vec());
        let mut linear = Image::filled(width, height, 1.0);
        let (rays, calibration) = (rays(), calibration());
        let optics = optics(&rays, &calibration);
        mask_edges_and_occluders(&optics, &mut linear, &image(&model), &image(&live));
        let differs = |u: usize, v: usize| {
            let around = (v - 1..=v + 1).flat_map(|y| (u - 1..=u + 1).map(move |x| (x, y)));
            let mut apart = around.map(|(x, y)| (model[at(x, y)] - model[at(u, v)]).abs());
            apart.any(|apart| apart >= DEPTH_EDGE_M || apart.is_nan())
        };
        for v in 0..height {
            for u in 0..width {
                let is_inside = u >= 1 && v >= 1 && u + 1 < width && v + 1 < height;
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
        // 83° and 84°; nearer than 0.82 m what is 14 mm deep is no edge.
        for z_m in [1.5, 3.0] {
            assert!(is_used(z_m, 8.1, 0.0) && !is_used(z_m, 9.5, 0.0), "{z_m}");
        }
        assert!(is_used(0.6, 9.5, 0.0));
        // The slant itself lends an occluder nothing.
        assert!(is_used(0.6, 8.0, 0.014) && !is_used(0.6, 8.0, 0.016));
        // Four standard deviations of a Kinect I are 56 mm at 3 m.
        assert!(is_used(3.0, 0.0, 0.05) && !is_used(3.0, 0.0, 0.06));
        assert!(is_used(0.6, 0.0, 0.014) && !is_used(0.6, 0.0, 0.016));
    }

    /// Which pixels of a row in the middle of images whose columns have these depths are used.
    fn used(model_m: &[f32], live_m: &[f32]) -> Vec<bool> {
        const HEIGHT: usize = 21;
        let (rays, calibration) = (rays(), calibration());
        let optics = optics(&rays, &calibration);
        let image = |row: &[f32]| Image::from_vec(row.len(), HEIGHT, row.repeat(HEIGHT));
        let mut linear = Image::filled(model_m.len(), HEIGHT, 1.0);
        mask_edges_and_occluders(&optics, &mut linear, &image(model_m), &image(live_m));
        let row = linear.row(HEIGHT / 2);
        row.iter().map(|value| !value.is_nan()).collect()
    }

    #[test]
    fn where_the_model_ends_and_the_live_depth_goes_on_is_no_edge() {
        let live = [0.6; 30];
        let used_beside = |behind: f32| {
            let mut model = live;
            model[15..].fill(behind);
            used(&model, &live)[1..16].iter().all(|&is_used| is_used)
        };
        // Through a hole one sees nothing, or what is behind.
        assert!(used_beside(f32::INFINITY) && used_beside(0.8));
        // Not where nothing is measured.
        let (mut model, mut live_in_part) = (live, live);
        model[15..].fill(f32::INFINITY);
        live_in_part[15..].fill(0.0);
        assert!(!used(&model, &live_in_part)[14]);
        // A hand before the model hides it, also where the model has an edge.
        let hand = [0.5; 30];
        let mut model = live;
        model[15..].fill(0.8);
        assert!(!used(&model, &hand).contains(&true));
    }

    #[test]
    fn pixels_two_from_an_edge_are_used_and_not_clear_of_it() {
        let (rays, calibration) = (rays(), calibration());
        let optics = optics(&rays, &calibration);
        let columns = (0..15 * 15).map(|pixel| if pixel % 15 < 7 { 0.6 } else { 0.8 });
        let model = Image::from_vec(15, 15, columns.collect());
        let mut linear = Image::filled(15, 15, 1.0);
        let clear = mask_edges_and_occluders(&optics, &mut linear, &model, &model);
        let used: Vec<bool> = linear.row(7).iter().map(|value| !value.is_nan()).collect();
        assert_eq!([5, 6, 7, 8].map(|u| used[u]), [true, false, false, true]);
        assert_eq!(
            [4, 5, 8, 9].map(|u| clear.row(7)[u]),
            [true, false, false, true]
        );
    }

    #[test]
    fn live_depth_that_ends_a_little_beyond_the_model_denies_no_edge() {
        let mut model = [0.6; 30];
        model[15..].fill(0.8);
        let used_where_it_ends = |column: usize| {
            let mut live = [0.6; 30];
            live[column..].fill(0.8);
            used(&model, &live)
        };
        for column in 15..=19 {
            let used = used_where_it_ends(column);
            assert!(used[1..14].iter().all(|&is_used| is_used), "{column}");
            assert!(!used[14], "{column}");
        }
        assert!(used_where_it_ends(20)[14]);
    }
}
