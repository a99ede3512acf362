//! The triangles of a cube for every pattern of inside and outside corners.
//!
//! They are not looked up but traced: crossings are joined along the cube's faces, always round the inside corners, into
//! loops, and loops cut into fans. Two cubes see their common face alike, so that the mesh has no cracks; no cut runs along a face,
//! where that of the neighbour might coincide with it.

use super::block::BLOCK_SIDE;
use std::sync::LazyLock;

/// Most triangles that a cube has: a ring of seven edges is cut into so many, and so are rings of six and three together.
const MAX_TRIANGLES: usize = 5;

/// The triangles of one cube, by their edges (0 to 11).
#[derive(Clone, Copy, Default)]
pub struct Case {
    n_triangles: u8,
    triangles: [[u8; 3]; MAX_TRIANGLES],
}

impl Case {
    /// The triangles.
    #[inline(always)]
    pub fn triangles(&self) -> &[[u8; 3]] {
        &self.triangles[..self.n_triangles()]
    }

    /// How many there are.
    #[inline(always)]
    pub fn n_triangles(&self) -> usize {
        self.n_triangles as usize
    }

    fn push(&mut self, triangle: [u8; 3]) {
        self.triangles[self.n_triangles()] = triangle;
        self.n_triangles += 1;
    }
}

/// The triangles of all 256 sign patterns; bit c of a pattern is set where corner c lies inside.
pub fn cases() -> &'static [Case; 256] {
    static CASES: LazyLock<[Case; 256]> = LazyLock::new(|| {
        let faces = face_loops();
        std::array::from_fn(|pattern| trace_case(pattern as u8, &faces))
    });
    &CASES
}

/// Corners of each edge of a cube.
pub const EDGE_CORNERS: [(u8, u8); 12] = {
    let mut corners = [(0, 0); 12];
    let mut edge = 0;
    while edge < 12 {
        corners[edge as usize] = edge_corners(edge);
        edge += 1;
    }
    corners
};

/// Slots along a side: of a block's voxels and of the layer above it.
const REACH: usize = BLOCK_SIDE as usize + 1;
/// Slots of all edges that a block's cubes have.
pub const N_SLOTS: usize = 3 * REACH * REACH * REACH;

/// A number for the edge that runs along `axis` from a voxel of a block or of the layer above it. It is the sum of the voxel's and of
/// the axis', so that those of a cube's edges lie [`EDGE_SLOTS`] beyond that of its lowest voxel.
#[inline(always)]
pub const fn slot(axis: usize, [x, y, z]: [usize; 3]) -> usize {
    x + REACH * (y + REACH * (z + REACH * axis))
}

/// How far beyond its lowest voxel's slot along the first axis those of a cube's edges lie.
pub const EDGE_SLOTS: [u16; 12] = {
    let mut slots = [0; 12];
    let mut edge = 0;
    while edge < 12 {
        let low = corner_place(EDGE_CORNERS[edge].0);
        slots[edge] = slot(edge / 4, low) as u16;
        edge += 1;
    }
    slots
};

/// Where a corner of a cube lies, in voxels from its lowest.
#[inline(always)]
pub const fn corner_place(corner: u8) -> [usize; 3] {
    let corner = corner as usize;
    [corner & 1, corner >> 1 & 1, corner >> 2]
}

/// Corners of edge `e` of a cube; corner `c` lies at (c & 1, c >> 1 & 1, c >> 2). Edge 4a + b runs along axis a.
const fn edge_corners(edge: u8) -> (u8, u8) {
    let axis = edge / 4;
    let (p, q) = ((axis + 1) % 3, (axis + 2) % 3);
    let first = ((edge & 1) << p) | (((edge >> 1) & 1) << q);
    (first, first | (1 << axis))
}

/// The edge between two neighbouring corners.
fn edge_between(a: u8, b: u8) -> u8 {
    (0..12)
        .find(|&edge| EDGE_CORNERS[edge as usize] == (a.min(b), a.max(b)))
        .expect("corners of one edge")
}

/// Corners of the cube's six faces, counter-clockwise seen from outside.
fn face_loops() -> [[u8; 4]; 6] {
    std::array::from_fn(|face| {
        let (axis, side) = (face as u8 / 2, face as u8 % 2);
        let (p, q) = ((axis + 1) % 3, (axis + 2) % 3);
        let base = side << axis;
        let loop_ = [base, base | 1 << p, base | 1 << p | 1 << q, base | 1 << q];
        if side == 1 {
            loop_
        } else {
            [loop_[0], loop_[3], loop_[2], loop_[1]]
        }
    })
}

/// Whether a side that two triangles of a ring's fan share lies in a face of the cube.
fn has_chord_in_a_face(ring: &[u8], faces: &[[u8; 4]; 6]) -> bool {
    let lies_in = |edge: u8, face: &[u8; 4]| {
        let (low, high) = EDGE_CORNERS[edge as usize];
        face.contains(&low) && face.contains(&high)
    };
    let mut ends = ring[2..ring.len() - 1].iter();
    ends.any(|&end| {
        let mut faces = faces.iter();
        faces.any(|face| lies_in(ring[0], face) && lies_in(end, face))
    })
}

fn trace_case(pattern: u8, faces: &[[u8; 4]; 6]) -> Case {
    let inside = |corner: u8| pattern >> corner & 1 == 1;
    // On each face, walk round it: the surface enters where outside turns to inside and leaves where inside turns to outside;
    // each run of inside corners is cut off by one segment from its leaving edge back to its entering edge.
    let mut next = [u8::MAX; 12];
    for corners in faces {
        for start in 0..4 {
            let (before, first) = (corners[(start + 3) % 4], corners[start]);
            if inside(before) || !inside(first) {
                continue;
            }
            let mut last = start;
            while inside(corners[(last + 1) % 4]) {
                last = (last + 1) % 4;
            }
            let leave = edge_between(corners[last], corners[(last + 1) % 4]);
            next[leave as usize] = edge_between(before, first);
        }
    }
    let mut case = Case::default();
    let mut used = [false; 12];
    for first in 0..12u8 {
        if next[first as usize] == u8::MAX || used[first as usize] {
            continue;
        }
        let mut ring = Vec::new();
        let mut edge = first;
        while !used[edge as usize] {
            used[edge as usize] = true;
            ring.push(edge);
            edge = next[edge as usize];
        }
        // From some of its edges every ring can be cut so.
        while has_chord_in_a_face(&ring, faces) {
            ring.rotate_left(1);
        }
        for i in 1..ring.len() - 1 {
            case.push([ring[0], ring[i + 1], ring[i]]);
        }
    }
    case
}
