//! Splitting of long edges.

use super::dynamic_mesh::DynamicMesh;

/// Splits edges longer than `max_length_m` at their middle until there are none, the longest of each sweep first.
///
/// Every sweep halves the longest edge, and no edge to an apex is longer than the sides that it divides. Irregular edges
/// are split too: triangles on a long edge could not be made small without.
pub(super) fn split_long_edges(mesh: &mut DynamicMesh, max_length_m: f64) {
    let limit = max_length_m * max_length_m;
    loop {
        let mut edges = mesh.edges_by_length(|length_squared| length_squared > limit);
        if edges.is_empty() {
            return;
        }
        edges.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        edges.dedup();
        for (_, [a, b]) in edges {
            // The edge is still there: splits move nothing, and those of other edges leave this one whole.
            mesh.split_edge(a, b);
        }
    }
}
