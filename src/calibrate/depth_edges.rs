//! Silhouettes in a depth image: where a near surface ends in front of a far one.
//!
//! Only the near side counts: behind it a structured-light sensor may have a hole, where the near surface hides the far one
//! from the projector, and the hole's far border is no edge of anything that the IR image shows. On the side of that hole
//! the near surface's own limb lies in the projector's shadow too and is missing, by more on round objects than on flat
//! ones; a wide hole therefore makes an edge worthless.

use depth_camera::Image;
use nalgebra::{Point2, Vector2};

/// A step in depth is an edge from this share of the nearer depth on; above noise and slope, below any object's thickness.
const MIN_STEP_SHARE: f32 = 0.05;
/// A wider hole at an edge is the projector's shadow, pixels: a step of [`MIN_STEP_SHARE`] at 0.6 m casts one of 3.5, an
/// object 0.1 m before its background one of 10; mixed pixels lose 1 or 2.
const MAX_HOLE_PX: usize = 4;
/// Half the side of the window that gives an edge its direction, pixels.
const HALF_WINDOW: isize = 4;
/// Edges nearer to the image's border are not used, pixels.
const BORDER_PX: usize = 20;

/// A place on a silhouette.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct DepthEdge {
    /// Between the last pixel of the near surface and its neighbour, pixels.
    pub(super) place: Point2<f64>,
    /// Unit normal, from the near surface outwards.
    pub(super) outward: Vector2<f64>,
}

/// The silhouettes of an image (metres, 0 is none), pixel by pixel in its order.
pub(super) fn depth_edges(depth_m: &Image<f32>) -> Vec<DepthEdge> {
    let (width, height) = (depth_m.width(), depth_m.height());
    let mut edges = Vec::new();
    for v in BORDER_PX..height.saturating_sub(BORDER_PX) {
        for u in BORDER_PX..width.saturating_sub(BORDER_PX) {
            for (du, dv) in [(-1, 0), (1, 0), (0, -1), (0, 1)] {
                edges.extend(edge_at(depth_m, (u, v), (du, dv)));
            }
        }
    }
    edges
}

/// The edge between a pixel of a near surface and its neighbour in one direction, if there is one.
fn edge_at(
    depth_m: &Image<f32>,
    (u, v): (usize, usize),
    (du, dv): (isize, isize),
) -> Option<DepthEdge> {
    let near = *depth_m.at(u, v);
    let far_from = near * (1.0 + MIN_STEP_SHARE);
    if near <= 0.0 {
        return None;
    }
    let ahead = (1..=MAX_HOLE_PX as isize + 1).map_while(|step| {
        let u = u
            .checked_add_signed(step * du)
            .filter(|u| *u < depth_m.width())?;
        let v = v
            .checked_add_signed(step * dv)
            .filter(|v| *v < depth_m.height())?;
        Some(*depth_m.at(u, v))
    });
    let beyond = ahead.into_iter().find(|depth| *depth > 0.0)?;
    if beyond < far_from {
        return None;
    }
    let outward = outward_normal(depth_m, (u, v), far_from)?;
    let step = Vector2::new(du as f64, dv as f64);
    // A staircase has steps across the edge and along it; those along it tell little of where it is.
    (outward.dot(&step) > 0.6).then(|| DepthEdge {
        place: Point2::new(u as f64, v as f64) + 0.5 * step,
        outward,
    })
}

/// From the pixels about this one that belong to the near surface towards those that do not.
fn outward_normal(
    depth_m: &Image<f32>,
    (u, v): (usize, usize),
    far_from: f32,
) -> Option<Vector2<f64>> {
    let mut away = Vector2::zeros();
    for dv in -HALF_WINDOW..=HALF_WINDOW {
        let row = depth_m.row(v.checked_add_signed(dv)?);
        for du in -HALF_WINDOW..=HALF_WINDOW {
            let depth = row[u.checked_add_signed(du)?];
            let is_near = depth > 0.0 && depth < far_from;
            let arm = Vector2::new(du as f64, dv as f64);
            away += if is_near { -arm } else { arm };
        }
    }
    away.try_normalize(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disc_has_a_round_edge_but_for_the_side_of_its_shadow() {
        let centre = Point2::new(80.0, 60.0);
        let in_disc = |place: Point2<f64>| (place - centre).norm() < 30.0;
        let depth = (0..160 * 120).map(|pixel| {
            let place = Point2::new(f64::from(pixel % 160), f64::from(pixel / 160));
            // The disc hides the wall from a projector on its right.
            let in_shadow = in_disc(place + Vector2::new(15.0, 0.0));
            match (in_disc(place), in_shadow) {
                (true, _) => 0.6,
                (false, true) => 0.0,
                (false, false) => 1.0,
            }
        });
        let edges = depth_edges(&Image::from_vec(160, 120, depth.collect()));
        assert!(edges.len() > 90, "{}", edges.len());
        for edge in &edges {
            let arm = edge.place - centre;
            assert!((arm.norm() - 30.0).abs() < 1.0, "{edge:?}");
            assert!(arm.dot(&edge.outward) > 0.95 * arm.norm(), "{edge:?}");
        }
        let n_towards = |x: f64, y: f64| {
            let direction = Vector2::new(x, y);
            let towards = edges.iter().filter(|e| e.outward.dot(&direction) > 0.7);
            towards.count()
        };
        assert!(n_towards(1.0, 0.0) > 40 && n_towards(-1.0, 0.0) == 0);
        assert!(n_towards(0.0, 1.0) > 25 && n_towards(0.0, -1.0) > 25);
    }

    #[test]
    fn a_slope_and_a_hole_in_a_wall_have_no_edge() {
        let slope = (0..160 * 120).map(|pixel| 0.5 + 0.005 * (pixel % 160) as f32);
        assert_eq!(depth_edges(&Image::from_vec(160, 120, slope.collect())), []);
        let hole = (0..160 * 120).map(|pixel| match (pixel % 160) / 20 {
            3 => 0.0,
            _ => 0.8,
        });
        assert_eq!(depth_edges(&Image::from_vec(160, 120, hole.collect())), []);
    }
}
