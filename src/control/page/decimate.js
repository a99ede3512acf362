// Fewer faces over the same vertices: coarse ones for as long as the view moves, or those near another mesh.

/** Cells across the model: about 60 000 faces of a surface that is flat. */
const CELLS_ACROSS = 170;
/** No mesh spans more cells than this in one direction. */
const STRIDE = 1 << 16;
/** A cell with those around it, as steps of its number. */
const AROUND = [-1, 0, 1].flatMap((x) => [-1, 0, 1].flatMap((y) => [-1, 0, 1].map((z) => x + STRIDE * (y + STRIDE * z))));

/**
 * The faces left when all vertices in a cell of a grid become the first of them; `radius` is that of the model, metres.
 * Holes may open where parts lie closer than a cell: good enough to turn by, not to judge by.
 */
export function coarseFaces({ positions, faces }, radius) {
  const cellsPerMetre = CELLS_ACROSS / (2 * radius);
  const firstOfCell = new Map();
  const kept = new Uint32Array(positions.length / 3);
  for (let vertex = 0; vertex < kept.length; vertex += 1) {
    const cell = cellAt(positions, vertex, cellsPerMetre);
    const first = firstOfCell.get(cell);
    if (first === undefined) firstOfCell.set(cell, vertex);
    kept[vertex] = first ?? vertex;
  }
  const coarse = new Uint32Array(faces.length);
  let n = 0;
  for (let corner = 0; corner < faces.length; corner += 3) {
    const [a, b, c] = [kept[faces[corner]], kept[faces[corner + 1]], kept[faces[corner + 2]]];
    if (a === b || b === c || c === a) continue;
    coarse[n] = a;
    coarse[n + 1] = b;
    coarse[n + 2] = c;
    n += 3;
  }
  return coarse.slice(0, n);
}

/** The faces of a mesh that lie within about `distance`, metres, of another: what a scan saw around an object falls away. */
export function facesNear({ positions, faces }, other, distance) {
  const near = new Set();
  for (let vertex = 0; vertex < other.positions.length / 3; vertex += 1) near.add(cellAt(other.positions, vertex, 1 / distance));
  for (const cell of [...near]) for (const step of AROUND) near.add(cell + step);
  const isNear = Uint8Array.from({ length: positions.length / 3 }, (_, vertex) => near.has(cellAt(positions, vertex, 1 / distance)));
  const kept = new Uint32Array(faces.length);
  let n = 0;
  for (let corner = 0; corner < faces.length; corner += 3) {
    if (!isNear[faces[corner]] || !isNear[faces[corner + 1]] || !isNear[faces[corner + 2]]) continue;
    kept.set(faces.subarray(corner, corner + 3), n);
    n += 3;
  }
  return kept.slice(0, n);
}

/** The number of the cell that a vertex lies in. */
function cellAt(positions, vertex, cellsPerMetre) {
  const at = (axis) => Math.floor(positions[3 * vertex + axis] * cellsPerMetre);
  return at(0) + STRIDE * (at(1) + STRIDE * at(2));
}
