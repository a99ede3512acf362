//! The object's mesh at one edge length, with what the rounds over it need.
//!
//! Rounds begin on a coarse mesh: what the fused surface gets wrong by millimetres is wider than its facets, and a quarter of the
//! sites tell it. The next mesh halves all edges and takes over how far the coarser one was displaced.

use super::albedo::Albedo;
use super::couplings::Couplings;
use super::error::RefineError;
use super::params::RefineParams;
use super::patches::{self, Patch};
use super::pattern::Pattern;
use super::remesh::{RemeshParams, Subdivided, remesh, subdivide};
use super::rounds::State;
use super::sites::SiteKind;
use super::surface::Surface;
use crate::geometry::{EdgeAdjacency, TriMesh, TriangleBvh};

/// A mesh of nearly equal edges, not displaced.
pub struct Level {
    /// The mesh.
    pub mesh: TriMesh,
    /// Length of its edges, metres.
    pub edge_length_m: f64,
    /// Its edges.
    pub edges: EdgeAdjacency,
    /// Patches that depth holds.
    pub patches: Vec<Patch>,
    /// Every two neighbouring faces, where sites are at faces.
    neighbouring_faces: Option<Vec<[u32; 2]>>,
    /// Pattern of the normal matrix.
    pub pattern: Pattern,
    /// As in [`Subdivided`]; empty for the coarsest.
    parents: Vec<[u32; 2]>,
}

/// Facets of the coarsest level have no longer edges, metres, unless the finest has: about two pixels at 0.6 m. Farther away, beyond
/// 0.7 m of a Kinect II, the finest is the only one, which costs time and no detail.
const COARSEST_EDGE_M: f64 = 0.003;

/// The levels of an object, the coarsest first and each of half the edge length of the one before; the last is the one that
/// is asked for. No more than there are rounds before the last.
///
/// # Errors
/// Where nothing is left of the surface.
pub fn levels(object: &TriMesh, params: &RefineParams) -> Result<Vec<Level>, RefineError> {
    let mut levels = vec![coarsest(object, params)?];
    let surface = TriangleBvh::new(object);
    for coarser in 0..n_finer(params) {
        let level = levels[coarser].finer(&surface, params);
        levels.push(level);
    }
    Ok(levels)
}

/// The coarsest of the levels of an object.
///
/// # Errors
/// Where nothing is left of the surface.
pub fn coarsest(object: &TriMesh, params: &RefineParams) -> Result<Level, RefineError> {
    let edge_length_m = params.edge_length_m * f64::from(1 << n_finer(params));
    let mesh = remesh(object, &RemeshParams::new(edge_length_m));
    match mesh.faces.is_empty() {
        true => Err(RefineError::NoSurface),
        false => Ok(Level::new(mesh, edge_length_m, None, params)),
    }
}

/// How often the edges of the coarsest level are halved.
fn n_finer(params: &RefineParams) -> usize {
    let coarser = |n: &usize| params.edge_length_m * f64::from(1 << (n + 1)) <= COARSEST_EDGE_M;
    (0..params.n_rounds.saturating_sub(1))
        .take_while(coarser)
        .count()
}

impl Level {
    fn new(
        mesh: TriMesh,
        edge_length_m: f64,
        from_coarser: Option<(&Pattern, Vec<[u32; 2]>)>,
        params: &RefineParams,
    ) -> Level {
        let edges = EdgeAdjacency::new(&mesh);
        let patches = patches::cut(&mesh, &mesh.vertex_normals(), params.patch_m);
        let couplings = Couplings::new(&mesh, &edges, &patches);
        let neighbouring_faces = (params.sites == SiteKind::Face)
            .then(|| neighbouring_faces(&couplings.of_faces, couplings.pairs.len()));
        let (pattern, parents) = match from_coarser {
            Some((coarser, parents)) => {
                let pattern = coarser.finer(&parents, &mesh.vertices, couplings);
                (pattern, parents)
            }
            None => (Pattern::new(&mesh.vertices, couplings), Vec::new()),
        };
        Level {
            pattern,
            mesh,
            edge_length_m,
            edges,
            patches,
            neighbouring_faces,
            parents,
        }
    }

    fn finer(&self, surface: &TriangleBvh, params: &RefineParams) -> Level {
        let couplings = self.pattern.couplings();
        let (sides, n_edges) = (&couplings.of_faces, couplings.pairs.len());
        let Subdivided { mesh, parents } = subdivide(&self.mesh, sides, n_edges, surface);
        let from_coarser = Some((&self.pattern, parents));
        Level::new(mesh, 0.5 * self.edge_length_m, from_coarser, params)
    }

    /// Root mean square of the slopes of a change of displacements along the edges, radians where it is small.
    pub fn turned_rad(&self, before_m: &[f64], after_m: &[f64]) -> f64 {
        let change = |vertex: u32| after_m[vertex as usize] - before_m[vertex as usize];
        let edges = &self.edges.edges;
        let squares = edges
            .iter()
            .map(|&[p, q]| (change(p) - change(q)).powi(2))
            .sum::<f64>();
        (squares / edges.len().max(1) as f64).sqrt() / self.edge_length_m
    }

    /// Every two neighbouring sites.
    pub fn neighbours(&self) -> &[[u32; 2]] {
        let of_faces = self.neighbouring_faces.as_deref();
        of_faces.unwrap_or(&self.edges.edges)
    }

    /// What a state of the next coarser level, with sites of a kind, is on this one.
    pub fn prolonged(&self, coarser: &Level, kind: SiteKind, state: &State) -> State {
        let State {
            surface,
            views,
            albedo,
        } = state;
        let places = coarser.mesh.vertices.iter().zip(&surface.mesh.vertices);
        let moved: Vec<_> = places.map(|(from, to)| to - from).collect();
        let mut mesh = self.mesh.clone();
        let parents = || self.parents.iter().map(|ends| ends.map(|end| end as usize));
        for (vertex, [p, q]) in mesh.vertices.iter_mut().zip(parents()) {
            *vertex += 0.5 * (moved[p] + moved[q]);
        }
        let total = |[p, q]: [usize; 2]| 0.5 * (surface.total_m[p] + surface.total_m[q]);
        State {
            surface: Surface {
                total_m: parents().map(total).collect(),
                directions: mesh.vertex_normals(),
                mesh,
            },
            views: views.clone(),
            albedo: Albedo {
                by_site: self.of_children(kind, &albedo.by_site),
                labels: self.of_children(kind, &albedo.labels),
                tints: self.of_children(kind, &albedo.tints),
                ..albedo.clone()
            },
        }
    }

    /// What holds of the coarser level's sites, for the four that each face becomes, or for vertices and the first end of the edges
    /// that others halve.
    pub fn of_children<T: Copy>(&self, kind: SiteKind, of_sites: &[T]) -> Vec<T> {
        match kind {
            SiteKind::Face => of_sites.iter().flat_map(|&value| [value; 4]).collect(),
            SiteKind::Vertex => {
                let parents = self.parents.iter();
                parents.map(|&[p, _]| of_sites[p as usize]).collect()
            }
        }
    }
}

/// Every two faces that share a side, from each face's sides.
fn neighbouring_faces(sides: &[[u32; 3]], n_edges: usize) -> Vec<[u32; 2]> {
    let mut first = vec![u32::MAX; n_edges];
    let mut pairs = Vec::with_capacity(sides.len() * 3 / 2);
    for (face, edges) in (0u32..).zip(sides) {
        for &edge in edges {
            match &mut first[edge as usize] {
                first @ &mut u32::MAX => *first = face,
                &mut first => pairs.push([first, face]),
            }
        }
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::super::scenes::{RippledPlane, surface_of};
    use super::*;
    use crate::shading::Gloss;
    use nalgebra::Vector3;

    fn of_edge(edge_length_m: f64, n_rounds: usize) -> RefineParams {
        RefineParams {
            edge_length_m,
            n_rounds,
            ..RefineParams::default()
        }
    }

    #[test]
    fn levels_double_the_edge_up_to_two_pixels_and_are_no_more_than_rounds() {
        let object = RippledPlane { amplitude_m: 0.0 }.mesh(0.002);
        let edges = |params: &RefineParams| -> Vec<f64> {
            let levels = levels(&object, params).expect("a surface");
            levels.iter().map(|level| level.edge_length_m).collect()
        };
        assert_eq!(edges(&of_edge(0.0013, 3)), [0.0026, 0.0013]);
        assert_eq!(edges(&of_edge(0.0007, 3)), [0.0028, 0.0014, 0.0007]);
        assert_eq!(edges(&of_edge(0.0007, 2)), [0.0014, 0.0007]);
        assert_eq!(edges(&of_edge(0.0013, 1)), [0.0013]);
        assert_eq!(edges(&of_edge(0.002, 3)), [0.002]);
    }

    #[test]
    fn a_finer_level_takes_over_what_the_coarser_was_displaced_by() {
        let object = RippledPlane { amplitude_m: 0.0 }.mesh(0.002);
        let levels = levels(&object, &of_edge(0.0013, 3)).expect("a surface");
        let [coarse, fine] = &levels[..] else {
            panic!("{} levels", levels.len());
        };
        // A tilt, which linear interpolation keeps.
        let mut surface = surface_of(coarse.mesh.clone());
        let by = |x: f64| 0.01 * x;
        for (vertex, total) in surface.mesh.vertices.iter_mut().zip(&mut surface.total_m) {
            *total = by(vertex.x);
            *vertex += Vector3::new(0.0, 0.0, *total);
        }
        // Halves of two materials.
        let labels_of = |mesh: &TriMesh| -> Vec<u8> {
            let places = mesh.vertices.iter();
            places.map(|p| u8::from(p.y > 0.0)).collect()
        };
        let labels = labels_of(&coarse.mesh);
        let state = State {
            surface,
            views: Vec::new(),
            albedo: Albedo {
                by_site: labels.iter().map(|&label| f64::from(label)).collect(),
                tints: vec![1.0; labels.len()],
                labels,
                groups: vec![0.0, 1.0],
                gloss: vec![Gloss::default(); 2],
                spread: 0.0,
            },
        };
        let State {
            surface, albedo, ..
        } = fine.prolonged(coarse, SiteKind::Vertex, &state);
        // Relaxed vertices lie up to half an edge from where they began.
        let tolerance_m = by(0.5 * coarse.edge_length_m);
        let pairs = fine.mesh.vertices.iter().zip(&surface.mesh.vertices);
        for ((from, to), total) in pairs.zip(&surface.total_m) {
            assert!((to.z - from.z - by(from.x)).abs() < tolerance_m);
            assert!((to.z - from.z - total).abs() < 1e-12);
        }
        let expected = labels_of(&fine.mesh);
        let places = fine.mesh.vertices.iter().zip(&albedo.labels);
        for ((place, &label), expected) in places.zip(expected) {
            // Between the two and beside them either will do.
            assert!(label == expected || place.y.abs() < coarse.edge_length_m);
        }
        assert_eq!(albedo.labels.len(), fine.mesh.vertices.len());
        assert_eq!(albedo.tints.len(), fine.mesh.vertices.len());
        let mut pairs = albedo.by_site.iter().zip(&albedo.labels);
        assert!(pairs.all(|(&albedo, &label)| albedo == f64::from(label)));
    }

    #[test]
    fn a_tilt_turns_a_plane_by_its_slope_along_edges_and_a_shift_by_nothing() {
        let object = RippledPlane { amplitude_m: 0.0 }.mesh(0.004);
        let level = levels(&object, &of_edge(0.004, 1)).expect("a surface");
        let [level] = &level[..] else {
            panic!("{} levels", level.len());
        };
        let by = |slope: f64| -> Vec<f64> {
            let places = level.mesh.vertices.iter();
            places.map(|p| 0.001 + slope * p.x).collect()
        };
        let (flat, shifted, tilted) = (vec![0.0; by(0.0).len()], by(0.0), by(0.1));
        assert!(level.turned_rad(&flat, &shifted) < 1e-9);
        // Edges go every way: half of the square of a tilt lies along them.
        let turned = level.turned_rad(&flat, &tilted) / (0.1 / 2f64.sqrt());
        assert!((turned - 1.0).abs() < 0.15, "{turned}");
        assert_eq!(
            level.turned_rad(&shifted, &tilted),
            level.turned_rad(&tilted, &shifted)
        );
    }

    #[test]
    fn sides_part_neighbouring_sites_of_either_kind() {
        let object = RippledPlane { amplitude_m: 0.0 }.mesh(0.004);
        let of_kind = |sites| {
            let params = RefineParams {
                sites,
                ..of_edge(0.004, 1)
            };
            levels(&object, &params).expect("a surface").remove(0)
        };
        let level = of_kind(SiteKind::Face);
        let inner = level.edges.n_faces.iter().filter(|&&n| n == 2).count();
        assert_eq!(level.neighbours().len(), inner);
        for &pair in level.neighbours() {
            let [face, other] = pair.map(|face| level.mesh.faces[face as usize]);
            let shared = face.iter().filter(|vertex| other.contains(vertex)).count();
            assert_eq!(shared, 2);
        }
        let level = of_kind(SiteKind::Vertex);
        assert_eq!(level.neighbours(), level.edges.edges);
    }
}
