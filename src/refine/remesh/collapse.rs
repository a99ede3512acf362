//! Collapsing of short edges.

use super::dynamic_mesh::{DynamicMesh, EdgeStar, VertexKind, is_sliver};
use nalgebra::{Point3, Vector3};

/// Sweeps at most; each sees the edges that the one before has shortened. Arbitrary: rounds repeat the pass anyway.
const MAX_SWEEPS: usize = 2;

/// Cosine of the angle by which a face may turn, 60°.
const MIN_TURN_COSINE: f64 = 0.5;

/// Cosine of the bend up to which a border counts as straight, 20°.
const STRAIGHT_COSINE: f64 = 0.94;

/// Distance of a removed border vertex from its new border edge at most, in units of the longest edge allowed.
/// Arbitrary: a few hundredths of an edge do not show. Corners of the border are kept by the angle.
const STRAIGHT_DISTANCE: f64 = 0.03;

/// Lengths between which collapses may work, metres.
#[derive(Clone, Copy, Debug)]
pub(super) struct CollapseLimits {
    /// Edges shorter than this are collapsed.
    pub min_length_m: f64,
    /// No collapse makes an edge longer than this.
    pub max_length_m: f64,
}

/// A vertex to be joined to its neighbour at a position.
#[derive(Clone, Copy, Debug)]
struct Collapse {
    removed: u32,
    kept: u32,
    position: Point3<f64>,
}

/// Collapses edges that are too short, the shortest of each sweep first, wherever the surface allows it.
pub(super) fn collapse_short_edges(mesh: &mut DynamicMesh, limits: &CollapseLimits) {
    let limit = limits.min_length_m * limits.min_length_m;
    let mut rings = [Vec::new(), Vec::new()];
    for _ in 0..MAX_SWEEPS {
        let mut edges = mesh.edges_by_length(|length_squared| length_squared < limit);
        edges.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut n_collapsed = 0;
        for (_, [a, b]) in edges {
            if mesh.length_squared(a, b) >= limit || !keeps_topology(mesh, a, b, &mut rings) {
                continue;
            }
            let allowed = candidates(mesh, a, b, limits)
                .into_iter()
                .flatten()
                .find(|collapse| keeps_shape(mesh, collapse, limits));
            if let Some(Collapse {
                removed,
                kept,
                position,
            }) = allowed
            {
                mesh.collapse_edge(removed, kept, position);
                n_collapsed += 1;
            }
        }
        if n_collapsed == 0 {
            return;
        }
    }
}

/// The link condition: the ends of the edge share no neighbours but the apexes of its faces, the outside of the border
/// counting as a neighbour of all border vertices, and every apex keeps a fan.
fn keeps_topology(mesh: &DynamicMesh, a: u32, b: u32, rings: &mut [Vec<u32>; 2]) -> bool {
    let apexes = match mesh.edge_star(a, b) {
        EdgeStar::Interior { left, right } => [Some(left.apex), Some(right.apex)],
        EdgeStar::Border(side) => [Some(side.apex), None],
        EdgeStar::Irregular => return false,
    };
    let n_interior_ends = [a, b]
        .iter()
        .filter(|&&end| mesh.kind(end) == VertexKind::Interior)
        .count();
    if apexes[1].is_some() && n_interior_ends == 0 {
        return false;
    }
    let keeps_fan = |apex: u32| {
        mesh.faces_of(apex).len()
            > if mesh.kind(apex) == VertexKind::Interior {
                3
            } else {
                1
            }
    };
    if !apexes.into_iter().flatten().all(keeps_fan) {
        return false;
    }
    let [ring_a, ring_b] = rings;
    mesh.one_ring(a, ring_a);
    mesh.one_ring(b, ring_b);
    let n_shared = ring_a
        .iter()
        .filter(|neighbour| ring_b.contains(neighbour))
        .count();
    n_shared == apexes.into_iter().flatten().count()
}

/// The ways to collapse an edge, best first: interior vertices meet halfway or go to the border, border vertices go
/// along a straight border.
fn candidates(
    mesh: &DynamicMesh,
    a: u32,
    b: u32,
    limits: &CollapseLimits,
) -> [Option<Collapse>; 2] {
    use VertexKind::{Border, Interior};
    let (at_a, at_b) = (*mesh.position(a), *mesh.position(b));
    let onto_a = Collapse {
        removed: b,
        kept: a,
        position: at_a,
    };
    let onto_b = Collapse {
        removed: a,
        kept: b,
        position: at_b,
    };
    match (mesh.kind(a), mesh.kind(b)) {
        (Interior, Interior) => [
            Some(Collapse {
                position: nalgebra::center(&at_a, &at_b),
                ..onto_a
            }),
            None,
        ],
        (Interior, _) => [Some(onto_b), None],
        (_, Interior) => [Some(onto_a), None],
        (Border, Border) => [
            is_straight(mesh, b, limits).then_some(onto_a),
            is_straight(mesh, a, limits).then_some(onto_b),
        ],
        _ => [None, None],
    }
}

/// Whether the border runs nearly straight through a vertex.
fn is_straight(mesh: &DynamicMesh, vertex: u32, limits: &CollapseLimits) -> bool {
    let Some([before, after]) = mesh.border_neighbours(vertex) else {
        return false;
    };
    let to_before = mesh.position(before) - mesh.position(vertex);
    let to_after = mesh.position(after) - mesh.position(vertex);
    let (n_before, n_after) = (to_before.norm(), to_after.norm());
    if n_before == 0.0 || n_after == 0.0 {
        return true;
    }
    let distance = to_before.cross(&to_after).norm() / (to_before - to_after).norm();
    -to_before.dot(&to_after) >= STRAIGHT_COSINE * n_before * n_after
        && distance <= STRAIGHT_DISTANCE * limits.max_length_m
}

/// Whether a collapse makes no edge too long and turns no face over.
fn keeps_shape(mesh: &DynamicMesh, collapse: &Collapse, limits: &CollapseLimits) -> bool {
    let Collapse {
        removed,
        kept,
        position,
    } = *collapse;
    let limit = limits.max_length_m * limits.max_length_m;
    let moved_faces =
        |vertex: u32, other: u32| mesh.fan(vertex).filter(move |face| !face.contains(&other));
    let kept_moves = position != *mesh.position(kept);
    let faces = || {
        let of_kept = moved_faces(kept, removed).take(if kept_moves { usize::MAX } else { 0 });
        moved_faces(removed, kept).chain(of_kept)
    };
    let is_short = |vertex: u32| (mesh.position(vertex) - position).norm_squared() <= limit;
    faces().all(|[_, b, c]| is_short(b) && is_short(c))
        && faces().all(|face| keeps_facing(mesh, face, collapse))
}

/// Whether a face still points its way when its first corner moves to the position of the collapse.
fn keeps_facing(mesh: &DynamicMesh, face: [u32; 3], collapse: &Collapse) -> bool {
    let mut old = mesh.normal(face);
    if is_sliver(face.map(|vertex| mesh.position(vertex)), &old) {
        // Its own says nothing.
        old = surrounding_normal(mesh, collapse);
    }
    let [_, b, c] = face;
    let position = &collapse.position;
    let new = (mesh.position(b) - position).cross(&(mesh.position(c) - position));
    new.dot(&old) > MIN_TURN_COSINE * (new.norm_squared() * old.norm_squared()).sqrt()
}

/// Sum of the normals of all faces at the two vertices.
fn surrounding_normal(mesh: &DynamicMesh, collapse: &Collapse) -> Vector3<f64> {
    mesh.fan(collapse.removed)
        .chain(mesh.fan(collapse.kept))
        .map(|face| mesh.normal(face))
        .sum()
}
