//! Points sorted into cubic cells, to find those within a radius.

use nalgebra::Point3;

/// Points in cells as wide as the radius asked for, sorted by cell.
#[derive(Clone, Debug)]
pub struct PointGrid {
    radius: f64,
    /// Cell and index of each point, ascending.
    items: Vec<([i32; 3], u32)>,
    points: Vec<Point3<f64>>,
}

impl PointGrid {
    /// Sorts points for queries of one radius, metres.
    ///
    /// # Panics
    /// If the radius is not positive.
    pub fn new(points: Vec<Point3<f64>>, radius: f64) -> Self {
        assert!(radius > 0.0, "radius is {radius}, must be positive");
        let mut items: Vec<_> = points
            .iter()
            .enumerate()
            .map(|(index, point)| (cell_of(point, radius), index as u32))
            .collect();
        items.sort_unstable();
        PointGrid {
            radius,
            items,
            points,
        }
    }

    /// The points no farther than the radius from a place, by their numbers.
    pub fn near(&self, place: &Point3<f64>) -> impl Iterator<Item = usize> + '_ {
        let centre = cell_of(place, self.radius);
        let place = *place;
        (0..9)
            .flat_map(move |column| {
                let [x, y, z] = centre;
                let (x, y) = (x + column / 3 - 1, y + column % 3 - 1);
                // Cells of a column follow each other in the order of the items.
                let start = self
                    .items
                    .partition_point(|(cell, _)| *cell < [x, y, z - 1]);
                let end = self
                    .items
                    .partition_point(|(cell, _)| *cell <= [x, y, z + 1]);
                &self.items[start..end]
            })
            .map(|&(_, index)| index as usize)
            .filter(move |&index| {
                (self.points[index] - place).norm_squared() <= self.radius * self.radius
            })
    }
}

/// The cell that a point lies in among cubes of some width, counted along each axis from the origin.
pub fn cell_of(point: &Point3<f64>, width: f64) -> [i32; 3] {
    [point.x, point.y, point.z].map(|x| (x / width).floor() as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_what_a_search_over_all_points_finds() {
        let spread = |i: usize, step: f64| (i as f64 * step).fract() - 0.5;
        let point = |i| {
            Point3::new(
                spread(i, 0.618_034),
                spread(i, 0.754_878),
                spread(i, 0.569_840),
            )
        };
        let points: Vec<_> = (0..2000).map(point).collect();
        let grid = PointGrid::new(points.clone(), 0.2);
        for place in [Point3::origin(), points[7], Point3::new(0.5, -0.5, 0.3)] {
            let mut found: Vec<usize> = grid.near(&place).collect();
            found.sort_unstable();
            let near = |&i: &usize| (points[i] - place).norm() <= 0.2;
            let all: Vec<usize> = (0..2000).filter(near).collect();
            assert!(!all.is_empty());
            assert_eq!(found, all);
        }
    }
}
