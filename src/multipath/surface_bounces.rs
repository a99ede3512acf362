//! What places receive by the patches of the surface that they lie on.
//!
//! A patch that holds an edge, where depth steps by more than an eighth, is none, and beyond the edge the light is another: the wall of a
//! pot has 10 mm of multipath right beside leaves that have next to none, and before a table that has none. A place that no patch
//! holds has the mean of its neighbours all the same, whatever they lie on ([`RangeBias`](super::RangeBias)).

use super::bounce::Bounce;
use crate::geometry::CellGrid;
use crate::interreflection::{Lit, PLACE_STEP_PX, PatchGrid};
use depth_camera::Image;
use nalgebra::Vector3;
use rayon::prelude::*;

/// A place lies on a patch within so much of its plane, metres: 24 pixels off, at the outline of a pot of 60 mm radius, its wall has left
/// a patch's plane by 10, and leaves stand out from it by 30 and more.
const ON_PATCH_M: f32 = 0.02;
/// So many patches to each side are looked at where none of those around a place holds it; arbitrary.
const REACH: usize = 2;

/// What the places of a frame of the given depth (metres, 0 is none) receive, row by row: between the patches around them as their
/// middles lie, or else as those farther off, by the fourth power of their distance; in both cases by those that hold the place.
/// `None` where none does.
pub(super) fn at_places(
    grid: &PatchGrid,
    depth_m: &Image<f32>,
    patches: &[Option<Lit>],
    bounces: &[Option<Bounce>],
) -> Vec<Option<Bounce>> {
    let (cells, places) = (grid.cells(), grid.places());
    // The last patches stand for what is left over beside them.
    let last = [cells.columns(), cells.rows()].map(|n| n * cells.cell_px() - 1);
    let mean = |weighted: &[(usize, f32)], point: &Vector3<f32>| {
        let (mut sum, mut weights) = (Bounce::default(), 0.0);
        for &(cell, weight) in weighted {
            if weight > 0.0
                && patches[cell]
                    .as_ref()
                    .is_some_and(|patch| holds(patch, point))
                && let Some(bounce) = bounces[cell]
            {
                sum = sum + bounce * weight;
                weights += weight;
            }
        }
        (weights > 0.0).then(|| sum * (1.0 / weights))
    };
    let at_place = |place: usize| {
        let mut pixels = places.square(place, PLACE_STEP_PX).pixels();
        let (u, v) = pixels.find(|&(u, v)| *depth_m.at(u, v) > 0.0)?;
        let point = grid.rays().direction(u, v) * *depth_m.at(u, v);
        let between = cells.around_pixel((u, v));
        mean(&between, &point).or_else(|| {
            let cell = cells.cell_of((u.min(last[0]), v.min(last[1])))?;
            let farther_off = cells.beside(cell, REACH);
            let farther_off = farther_off.map(|beside| (beside, nearness(&cells, beside, (u, v))));
            mean(&farther_off.collect::<Vec<_>>(), &point)
        })
    };
    (0..places.n_cells())
        .into_par_iter()
        .map(at_place)
        .collect()
}

/// One over the fourth power of how far a pixel is from the middle of a cell, in sides of cells.
fn nearness(cells: &CellGrid, cell: usize, (u, v): (usize, usize)) -> f32 {
    let (x, y) = cells.middle(cell);
    let side_px = cells.cell_px() as f32;
    let [x, y] = [x.abs_diff(u), y.abs_diff(v)].map(|pixels| pixels as f32 / side_px);
    (x * x + y * y).powi(-2)
}

/// Whether a point lies on the plane of a patch.
fn holds(patch: &Lit, point: &Vector3<f32>) -> bool {
    let above_m = Vector3::from(patch.normal).dot(&(point - Vector3::from(patch.point)));
    above_m.abs() < ON_PATCH_M
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::RayGrid;
    use crate::geometry::camera::tests::distorted_camera;
    use crate::shading::Calibration;
    use depth_camera::Sensor;
    use std::ops::Range;

    /// Depth of a wall and of another before it, metres.
    const WALLS_M: [f32; 2] = [0.8, 0.7];
    /// Columns of the near one, whose first lie in the middle of a patch; of a strip of it where no patch holds it; and of what is not
    /// seen at all.
    const NEAR: Range<usize> = 264..368;
    const STRIP: Range<usize> = 420..426;
    const UNSEEN: Range<usize> = 480..512;

    fn wall_at(u: usize) -> Option<usize> {
        (!UNSEEN.contains(&u)).then(|| usize::from(NEAR.contains(&u) || STRIP.contains(&u)))
    }

    /// Light that a patch of a wall receives with its middle in a column.
    fn received(wall: usize, u: usize) -> Bounce {
        Bounce {
            share: 0.1 + wall as f32,
            range_m: 0.001 + 0.01 * wall as f32 + 1e-5 * u as f32,
        }
    }

    #[test]
    fn light_of_a_wall_reaches_as_far_as_its_edge_and_no_farther() {
        let calibration = Calibration::shipped(Sensor::Kinect2).expect("shipped");
        let light = calibration.light.near_light([0.05, 0.0, 0.0]);
        let rays = RayGrid::new(distorted_camera());
        let (width, height) = (rays.rays().width(), rays.rays().height());
        let depth_at = |u: usize| wall_at(u).map_or(0.0, |wall| WALLS_M[wall]);
        let depth = (0..width * height).map(|index| depth_at(index % width));
        let depth = Image::from_vec(width, height, depth.collect());
        let grid = PatchGrid::new(rays, light, 65535.0, &calibration);
        let cells = grid.cells();
        let patches = grid.patches(&depth, &vec![0.1; cells.n_cells()]);
        let bounces: Vec<Option<Bounce>> = patches
            .iter()
            .enumerate()
            .map(|(cell, patch)| {
                let wall = usize::from(patch.as_ref()?.point[2] < 0.75);
                Some(received(wall, cells.middle(cell).0))
            })
            .collect();
        for u in [NEAR.start, STRIP.start] {
            let across = cells.cell_of((u, height / 2)).expect("inside");
            assert_eq!(bounces[across], None, "no patch holds both");
        }
        let places = grid.places();
        let at_places = at_places(&grid, &depth, &patches, &bounces);
        for (place, bounce) in at_places.into_iter().enumerate() {
            let (u, _) = places.middle(place);
            let first = places.square(place, 1).u;
            let Some(wall) = wall_at(first).filter(|_| !STRIP.contains(&first)) else {
                assert_eq!(bounce, None, "column {u}");
                continue;
            };
            let (bounce, expected) = (bounce.expect("a wall is there"), received(wall, first));
            assert!((bounce.share - expected.share).abs() < 1e-5, "column {u}");
            let off_m = (bounce.range_m - expected.range_m).abs();
            // As between two patches of one wall to half a pixel, for middles lie between pixels; at most two sides off beside an edge.
            let is_between = (40..220).contains(&u) || (300..350).contains(&u);
            let allowed_m = if is_between { 0.6 * 1e-5 } else { 32.0 * 1e-5 };
            assert!(off_m < allowed_m, "column {u}: {off_m}");
        }
    }
}
