//! Flipping of edges towards even valences.

use super::dynamic_mesh::{DynamicMesh, EdgeStar, Side, VertexKind};

/// Passes over all edges at most; later ones find little.
const MAX_SWEEPS: usize = 2;

/// Cosine of the angle by which the new faces may deviate from the mean of the old ones, 45°.
const MIN_NORMAL_COSINE: f64 = 0.7;

/// Height over the flipped edge below which a new face would be a sliver, in units of that edge.
const MIN_HEIGHT: f64 = 0.05;

/// Flips edges wherever that brings the numbers of faces of their four vertices closer to 6, or 3 on the border.
pub(super) fn equalise_valences(mesh: &mut DynamicMesh) {
    for _ in 0..MAX_SWEEPS {
        let mut n_flipped = 0;
        for face in 0..mesh.n_face_slots() {
            for side in 0..3 {
                // Read anew: the flip of one side changes the others.
                let Some(corners) = mesh.face(face) else {
                    break;
                };
                let (a, b) = (corners[side], corners[(side + 1) % 3]);
                if a < b && flip_if_better(mesh, a, b) {
                    n_flipped += 1;
                }
            }
        }
        if n_flipped == 0 {
            return;
        }
    }
}

fn flip_if_better(mesh: &mut DynamicMesh, a: u32, b: u32) -> bool {
    let EdgeStar::Interior { left, right } = mesh.edge_star(a, b) else {
        return false;
    };
    let better = valence_gain(mesh, [a, b], [left.apex, right.apex]) > 0
        && left.apex != right.apex
        && keeps_shape(mesh, a, b, left, right)
        && !mesh.are_joined(left.apex, right.apex);
    if better {
        mesh.flip_edge(a, b, left, right);
    }
    better
}

/// By how much the sum of squared deviations from the wanted numbers of faces falls if `ends` lose a face and `apexes`
/// gain one.
fn valence_gain(mesh: &DynamicMesh, ends: [u32; 2], apexes: [u32; 2]) -> i64 {
    let excess = |vertex: u32| {
        let wanted = if mesh.kind(vertex) == VertexKind::Border {
            3
        } else {
            6
        };
        mesh.faces_of(vertex).len() as i64 - wanted
    };
    let square = |x: i64| x * x;
    let losing = |vertex: u32| square(excess(vertex)) - square(excess(vertex) - 1);
    let gaining = |vertex: u32| square(excess(vertex)) - square(excess(vertex) + 1);
    ends.map(losing).iter().sum::<i64>() + apexes.map(gaining).iter().sum::<i64>()
}

/// Whether the two new faces point the way of the old ones and have area.
fn keeps_shape(mesh: &DynamicMesh, a: u32, b: u32, left: Side, right: Side) -> bool {
    let (c, d) = (left.apex, right.apex);
    let old = mesh.normal([a, b, c]) + mesh.normal([b, a, d]);
    let least = MIN_HEIGHT * mesh.length_squared(c, d);
    [[a, d, c], [d, b, c]].into_iter().all(|face| {
        let new = mesh.normal(face);
        let length = new.norm();
        length > least && new.dot(&old) > MIN_NORMAL_COSINE * length * old.norm()
    })
}
