//! Which part of a scan is delivered and refined: by default everything and what is found in it, or one object alone.

use super::object::{Roi, select_object, select_roi};
use crate::geometry::{Pose, TriMesh};
use nalgebra::Point3;
use serde::{Deserialize, Serialize};

/// What of a delivered object hangs together by itself and has a smaller share of its area is left out, as what an edge of it left in the
/// air: 0.003 at most on `relief-k2`; a leaf of a plant may be seen without its stalk. Arbitrary.
const CRUMB_SHARE: f64 = 0.01;
const NO_OBJECT: &str = "no object stands out of the scene; give its box by --crop or object.crop of the \
    configuration, or by --roi of relief refine";

/// What of a scan becomes meshes.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct ObjectParams {
    /// Which part of the scene is taken.
    pub crop: Crop,
    /// Whether the holes of the delivered meshes are filled, each component by itself.
    pub watertight: bool,
}

/// Which part of the scene is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Crop {
    /// The base mesh is of the whole scene; the object is found in it and refined.
    #[default]
    Auto,
    /// The whole scene is delivered and refined.
    None,
    /// What stands above the plane that is found under it, alone and without crumbs, is delivered and refined.
    Object,
    /// The largest component in a box is delivered and refined: smallest x, y, z, largest x, y, z, world frame, metres.
    Box([f64; 6]),
}

impl ObjectParams {
    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        match self.crop {
            Crop::Box(bounds) => Roi::of_bounds(bounds)
                .map(|_| ())
                .map_err(|what| format!("object.crop.box: {what}")),
            Crop::Auto | Crop::None | Crop::Object => Ok(()),
        }
    }
}

impl Roi {
    /// A box by its smallest x, y, z and its largest x, y, z, world frame, metres.
    ///
    /// # Errors
    /// Names a bound that is not finite, or the axis along which the box is empty, with both bounds.
    pub fn of_bounds(bounds: [f64; 6]) -> Result<Roi, String> {
        let [x_min, y_min, z_min, x_max, y_max, z_max] = bounds;
        for (axis, min, max) in [
            ("x", x_min, x_max),
            ("y", y_min, y_max),
            ("z", z_min, z_max),
        ] {
            for (end, bound) in [("min", min), ("max", max)] {
                if !bound.is_finite() {
                    return Err(format!("{axis}{end} is {bound}, must be finite"));
                }
            }
            if min >= max {
                return Err(format!(
                    "{axis}min is {min}, must be below {axis}max, {max}"
                ));
            }
        }
        Ok(Roi {
            min: Point3::new(x_min, y_min, z_min),
            max: Point3::new(x_max, y_max, z_max),
        })
    }
}

impl Crop {
    /// The part of a base mesh that is refined.
    ///
    /// # Errors
    /// Says for the operator why nothing is left.
    pub fn object(&self, base: &TriMesh, world_from_cameras: &[Pose]) -> Result<TriMesh, String> {
        if base.faces.is_empty() {
            return Err("the model has no surface".to_owned());
        }
        let (object, missing) = match self {
            Crop::None => return Ok(base.clone()),
            Crop::Auto => (select_object(base, world_from_cameras).0, NO_OBJECT),
            Crop::Object => (
                without_crumbs(&select_object(base, world_from_cameras).0),
                NO_OBJECT,
            ),
            Crop::Box(bounds) => (
                largest_component(&select_roi(base, &Roi::of_bounds(*bounds)?)),
                "no surface lies in the box given by object.crop",
            ),
        };
        match object.faces.is_empty() {
            true => Err(missing.to_owned()),
            false => Ok(object),
        }
    }

    /// Whether the base mesh is delivered without what is not the object.
    pub fn is_for_delivery(&self) -> bool {
        matches!(self, Crop::Object | Crop::Box(_))
    }
}

/// The component of the largest area; empty for an empty mesh.
fn largest_component(mesh: &TriMesh) -> TriMesh {
    let (labels, area_m2) = mesh.components_with_areas();
    let largest = (0..area_m2.len()).max_by(|&a, &b| area_m2[a].total_cmp(&area_m2[b]));
    mesh.filter_faces(|face| Some(labels[face] as usize) == largest)
}

/// The components that are more than crumbs.
fn without_crumbs(mesh: &TriMesh) -> TriMesh {
    let is_kept = mesh.is_of_large_component(CRUMB_SHARE * mesh.area_m2());
    mesh.filter_faces(|face| is_kept[face])
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// A square of 2·side² faces in the plane z = `z`, its corner at (`x`, 0).
    fn square(x: f64, z: f64, side: usize) -> TriMesh {
        let step = 0.01;
        let mut mesh = TriMesh::default();
        for row in 0..=side {
            for column in 0..=side {
                let (u, v) = (column as f64 * step, row as f64 * step);
                mesh.vertices.push(Point3::new(x + u, v, z));
            }
        }
        let at = |row: usize, column: usize| (row * (side + 1) + column) as u32;
        for row in 0..side {
            for column in 0..side {
                let [a, b] = [at(row, column), at(row, column + 1)];
                let [c, d] = [at(row + 1, column), at(row + 1, column + 1)];
                mesh.faces.extend([[a, c, b], [b, c, d]]);
            }
        }
        mesh
    }

    fn together(meshes: &[TriMesh]) -> TriMesh {
        let mut all = TriMesh::default();
        for mesh in meshes {
            let first = all.vertices.len() as u32;
            all.vertices.extend_from_slice(&mesh.vertices);
            let faces = mesh.faces.iter();
            all.faces.extend(faces.map(|face| face.map(|v| v + first)));
        }
        all
    }

    #[test]
    fn a_box_gives_its_largest_component() {
        let (large, small) = (square(0.0, 0.5, 20), square(0.5, 0.5, 5));
        let scene = together(&[large.clone(), small.clone()]);
        let within = |bounds| Crop::Box(bounds).object(&scene, &[]);
        let all = [-1.0, -1.0, 0.0, 1.0, 1.0, 1.0];
        assert_eq!(within(all).unwrap().faces.len(), large.faces.len());
        // Of the large square only a strip lies in the box: now the small one is the larger.
        let right = [0.185, -1.0, 0.0, 1.0, 0.06, 1.0];
        assert_eq!(within(right).unwrap(), small);
        let none = within([2.0, 0.0, 0.0, 3.0, 1.0, 1.0]).unwrap_err();
        assert!(none.contains("no surface lies in the box"), "{none}");
    }

    #[test]
    fn the_object_stands_above_the_plane_and_none_takes_everything() {
        // A table seen from above, and a smaller square 50 mm nearer to the camera.
        let (table, top) = (square(-0.2, 0.6, 40), square(-0.1, 0.55, 20));
        let scene = together(&[table, top.clone()]);
        let above = Pose::translation(0.0, 0.1, 0.0);
        let object = Crop::Object.object(&scene, &[above]).unwrap();
        assert_eq!(object.faces.len(), top.faces.len());
        let mean = object
            .vertices
            .iter()
            .map(|p| p.coords)
            .sum::<Vector3<f64>>();
        assert!((mean.z / object.vertices.len() as f64 - 0.55).abs() < 1e-9);
        assert_eq!(Crop::None.object(&scene, &[above]).unwrap(), scene);
    }

    #[test]
    fn crumbs_beside_a_delivered_object_are_left_out_and_a_large_part_is_not() {
        let table = square(-0.2, 0.6, 40);
        let (top, part, crumb) = (
            square(-0.1, 0.55, 20),
            square(0.105, 0.55, 4),
            square(-0.125, 0.55, 2),
        );
        let scene = together(&[table, top.clone(), part.clone(), crumb.clone()]);
        let above = Pose::translation(0.0, 0.1, 0.0);
        let n_faces = |crop: Crop| crop.object(&scene, &[above]).unwrap().faces.len();
        let n_of_parts = top.faces.len() + part.faces.len();
        assert_eq!(n_faces(Crop::Object), n_of_parts);
        assert_eq!(n_faces(Crop::Auto), n_of_parts + crumb.faces.len());
    }

    #[test]
    fn of_a_model_without_surface_nothing_is_said_to_be_missing_but_that() {
        let all = Crop::Box([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0]);
        for crop in [Crop::Auto, Crop::None, Crop::Object, all] {
            let reason = crop.object(&TriMesh::default(), &[]).unwrap_err();
            assert_eq!(reason, "the model has no surface", "{crop:?}");
        }
    }

    #[test]
    fn a_floor_that_the_object_encloses_is_of_it_and_the_table_in_a_ring_is_not() {
        let object = |floor_height_m: f64, gap_m: f64| {
            let mut scene = square(-0.2, 0.6, 40);
            for vertex in &mut scene.vertices {
                vertex.z -= match vertex.x.hypot(vertex.y - 0.2) {
                    r if r < 0.045 => floor_height_m,
                    r if r < 0.105 => 0.05,
                    _ => 0.0,
                };
            }
            let is_gap =
                |p: &Point3<f64>| gap_m > 0.0 && (p.x.hypot(p.y - 0.2) - 0.04).abs() < gap_m;
            let scene = scene.filter_faces(|face| !scene.corners(face).iter().all(is_gap));
            let above = Pose::translation(0.0, 0.2, 0.0);
            Crop::Object.object(&scene, &[above]).unwrap().area_m2()
        };
        let ring = object(0.0, 0.0);
        let with_floor = object(0.004, 0.0);
        // The floor and the inner wall of the ring, which reaches down to it.
        assert!(with_floor > ring + 0.006, "{with_floor} for {ring}");
        // What a shadow parts from the object is not enclosed by it.
        assert!((object(0.004, 0.015) - ring).abs() < 1e-9);
    }

    #[test]
    fn bad_boxes_are_named() {
        let error = |z_max: f64| {
            let bad = ObjectParams {
                crop: Crop::Box([0.0, 0.0, 0.5, 1.0, 1.0, z_max]),
                ..ObjectParams::default()
            };
            bad.validate().unwrap_err()
        };
        assert_eq!(
            error(0.5),
            "object.crop.box: zmin is 0.5, must be below zmax, 0.5"
        );
        assert_eq!(
            error(f64::NAN),
            "object.crop.box: zmax is NaN, must be finite"
        );
    }
}
