//! Places of an image that receive light, finer than the patches that send it, where the surface is known by a model.
//!
//! A place's share of bounced light is that light over the direct one, which falls where the surface turns away from the lamp. The
//! model's normals tell so only averaged, for they are noisy; the image itself tells it at every place: what is darker than
//! neighbours of the same albedo by some factor receives less light by that factor. So the normals say how much light there is around a
//! place, and brightness how much of it falls on the place itself. That supposes that bounced light is as large a share all around: nearer
//! to where two surfaces meet it is larger, and the bias there is told too small.

use super::patches::{Lit, PLACE_STEP_PX, PatchGrid};
use crate::geometry::CellGrid;
use crate::robust::{Tukey, median};
use depth_camera::Image;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// A place that receives light, and sends none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Receiver {
    /// The place, with the mean normal of its surroundings.
    pub lit: Lit,
    /// How bright it is over how bright that normal would make it.
    pub relative_brightness: f32,
}

/// Neighbours that lie farther off than this are another surface, metres.
const SAME_SURFACE_M: f64 = 0.02;
/// Light that comes in more slantingly is taken to come in at this cosine: by an averaged normal, and in a single place.
const MIN_COSINE: f64 = 0.1;
const MIN_PLACE_COSINE: f64 = 0.05;
/// Brightness is compared with that of so many places on each side: 20 pixels in all on a Kinect II.
const REACH: usize = 2;
/// Neighbours whose albedo seems to be twice as high or half are another material.
const OTHER_MATERIAL: Tukey = Tukey {
    scale: 1.0,
    cutoff: std::f64::consts::LN_2,
};
/// With fewer places of the same material, itself among them, nothing is compared.
const MIN_PLACES: f64 = 2.0;
/// A place is not taken to be brighter or darker than its normal says by more than this factor.
const MAX_RELATIVE: f64 = 3.0;

/// What is known of a place by itself.
struct Place {
    point: Point3<f64>,
    /// Sum of the model's gradients. They are shorter than 1 where the views of a surface disagree, as in folds that light reaches
    /// slantingly: such places weigh less, and are taken to receive less light.
    gradients: Vector3<f64>,
    /// `None` where it is not known, or is that of more than the place.
    brightness: Option<Brightness>,
}

/// How bright a place is.
#[derive(Clone, Copy)]
struct Brightness {
    /// Linear intensity, share of full scale.
    shown: f64,
    /// What a perfectly white place would show by its own gradients.
    facing: f64,
    /// Logarithm of one over the other.
    log_albedo: f64,
}

/// The places of a frame whose surface is known, row by row: `gradient_at` gives that of its signed distance near a point of the camera frame,
/// `depth_m` (metres, 0 is none) where they are, `shown` how bright they are, where that is known.
///
/// # Panics
/// Unless one brightness is given for each place.
pub fn receivers(
    grid: &PatchGrid,
    depth_m: &Image<f32>,
    shown: Option<&[f32]>,
    gradient_at: impl Fn(&Point3<f64>) -> Option<Vector3<f64>> + Sync,
) -> Vec<Option<Receiver>> {
    let cells = grid.places();
    assert!(
        shown.is_none_or(|shown| shown.len() == cells.n_cells()),
        "one brightness a place"
    );
    let place = |cell: usize| {
        let shown = shown.map(|shown| f64::from(shown[cell]));
        place(grid, depth_m, cell, shown, &gradient_at)
    };
    let places: Vec<Option<Place>> = (0..cells.n_cells()).into_par_iter().map(place).collect();
    let receiver = |cell: usize| {
        let own = places[cell].as_ref()?;
        let near = same_surface(&places, &cells, cell, 1);
        let normal: Vector3<f64> = near.map(|other| other.gradients).sum();
        let normal = normal.try_normalize(0.0)?;
        let lit = grid.lit_from(MIN_COSINE, &own.point, &normal, 0.0, 0.0)?;
        let relative =
            received(&places, &cells, cell).map_or(1.0, |light| light / f64::from(lit.direct));
        Some(Receiver {
            lit,
            relative_brightness: relative.clamp(1.0 / MAX_RELATIVE, MAX_RELATIVE) as f32,
        })
    };
    (0..cells.n_cells()).into_par_iter().map(receiver).collect()
}

fn place(
    grid: &PatchGrid,
    depth_m: &Image<f32>,
    cell: usize,
    shown: Option<f64>,
    gradient_at: &impl Fn(&Point3<f64>) -> Option<Vector3<f64>>,
) -> Option<Place> {
    let (mut points, mut gradients) = (Vector3::zeros(), Vector3::zeros());
    let (mut n, mut n_beside_model) = (0, 0);
    for (u, v) in grid.places().square(cell, PLACE_STEP_PX).pixels() {
        let z = *depth_m.at(u, v);
        if z <= 0.0 {
            continue;
        }
        let point = Point3::from((grid.rays().direction(u, v) * z).cast::<f64>());
        match gradient_at(&point) {
            Some(gradient) => {
                points += point.coords;
                gradients += gradient;
                n += 1;
            }
            None => n_beside_model += 1,
        }
    }
    if n == 0 {
        return None;
    }
    let point = Point3::from(points / f64::from(n));
    let brightness = shown.filter(|&shown| shown > 0.0 && n_beside_model == 0);
    let brightness = brightness.map(|shown| {
        let incident = grid.light().incident(&point);
        let facing = incident.dot(&gradients) / f64::from(n);
        let facing = facing.max(MIN_PLACE_COSINE * incident.norm());
        Brightness {
            shown,
            facing,
            log_albedo: (shown / facing).ln(),
        }
    });
    Some(Place {
        point,
        gradients,
        brightness,
    })
}

/// The places up to `reach` from one, itself among them, that lie on its surface.
fn same_surface<'a>(
    places: &'a [Option<Place>],
    cells: &CellGrid,
    cell: usize,
    reach: usize,
) -> impl Iterator<Item = &'a Place> {
    let point = places[cell].as_ref().map(|place| place.point);
    let around = cells.beside(cell, reach).filter_map(|k| places[k].as_ref());
    around.filter(move |other| point.is_some_and(|p| (other.point - p).norm() < SAME_SURFACE_M))
}

/// What a perfectly white surface would show in a place by its brightness among places of its material; `None` with too few of
/// them.
fn received(places: &[Option<Place>], cells: &CellGrid, cell: usize) -> Option<f64> {
    let own = places[cell].as_ref()?.brightness?;
    let around = |reach| same_surface(places, cells, cell, reach).filter_map(|p| p.brightness);
    // A median keeps the border between two materials sharp.
    let mut albedos: Vec<f64> = around(1).map(|other| other.log_albedo).collect();
    let log_albedo = median(&mut albedos)?;
    let (mut facing, mut shown, mut n) = (0.0, 0.0, 0.0);
    for other in around(REACH) {
        let weight = OTHER_MATERIAL.weight(other.log_albedo - log_albedo);
        facing += weight * other.facing;
        shown += weight * other.shown;
        n += weight;
    }
    (n > MIN_PLACES).then(|| own.shown * facing / shown)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::RayGrid;
    use crate::geometry::camera::tests::distorted_camera;
    use crate::shading::Calibration;
    use depth_camera::Sensor;

    const FULL_SCALE: f64 = 65535.0;
    /// How far the whole plane is turned out of the image's, radians.
    const TILT: f64 = 0.5;

    fn turned(angle: f64) -> Vector3<f64> {
        Vector3::new(angle.sin(), 0.0, -angle.cos())
    }

    /// A plane 0.5 m away whose albedo and further turn vary from column to column, as a model sees it that knows its tilt alone:
    /// how much light arrives over how much would by the tilt, and relative brightness, of places off the border.
    fn seen(albedo: impl Fn(usize) -> f64, turn: impl Fn(usize) -> f64) -> Vec<(f64, f64)> {
        let calibration = Calibration::shipped(Sensor::Kinect2).expect("shipped");
        let light = calibration.light.near_light([0.05, 0.0, 0.0]);
        let rays = RayGrid::new(distorted_camera());
        let (width, height) = (rays.rays().width(), rays.rays().height());
        let normal = turned(TILT);
        let (mut depth, mut ir) = (Vec::new(), Vec::new());
        for (index, &[x, y]) in rays.rays().data().iter().enumerate() {
            let ray = Vector3::new(f64::from(x), f64::from(y), 1.0);
            let z = 0.5 * normal.z / normal.dot(&ray);
            let incident = light.incident(&Point3::from(ray * z));
            let facing = incident.dot(&turned(TILT + turn(index % width)));
            let flat = calibration.flat_field.factor(ray.x, ray.y);
            let linear = 0.1 * albedo(index % width) * flat * facing.max(0.0);
            depth.push(z as f32);
            ir.push((FULL_SCALE * linear.min(1.0).powf(calibration.gamma)) as u16);
        }
        let depth = Image::from_vec(width, height, depth);
        let ir = Image::from_vec(width, height, ir);
        let grid = PatchGrid::new(rays, light, FULL_SCALE, &calibration);
        let shown = grid.radiances(&depth, &ir).places;
        let cells = grid.places();
        let receivers = receivers(&grid, &depth, Some(&shown), |_| Some(normal));
        let inside = receivers.iter().enumerate().filter_map(|(cell, receiver)| {
            let (u, v) = cells.middle(cell);
            let is_inside = (150..350).contains(&u) && (150..250).contains(&v);
            let receiver = receiver.filter(|_| is_inside)?;
            let incident = light.incident(&Point3::from(receiver.lit.point).cast());
            let columns = (u - 2..u + 2).map(|u| incident.dot(&turned(TILT + turn(u))));
            let arriving = columns.sum::<f64>() / 4.0 / incident.dot(&normal);
            Some((arriving, f64::from(receiver.relative_brightness)))
        });
        let inside: Vec<(f64, f64)> = inside.collect();
        assert!(inside.len() > 1000, "{}", inside.len());
        inside
    }

    #[test]
    fn brightness_tells_how_places_are_turned_that_the_model_shows_flat() {
        // Nine places a ripple: five of them, with which brightness is compared, hold a part of it.
        let ripple = |u: usize| 0.15 * (u as f64 * std::f64::consts::TAU / 36.0).sin();
        let places = seen(|_| 0.6, ripple);
        let [mut left, mut missed] = [0.0, 0.0];
        for (arriving, relative) in &places {
            left += (relative - arriving).powi(2);
            missed += (arriving - 1.0).powi(2);
        }
        let n = places.len() as f64;
        let [left, missed] = [left, missed].map(|sum| (sum / n).sqrt());
        assert!(missed > 0.04 && left < 0.6 * missed, "{missed}, {left}");
    }

    #[test]
    fn print_is_not_taken_for_slant() {
        // The border lies between two places.
        for (_, relative) in seen(|u| if u < 252 { 0.6 } else { 0.25 }, |_| 0.0) {
            assert!((relative - 1.0).abs() < 0.02, "{relative}");
        }
    }
}
