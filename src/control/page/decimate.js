// Fewer faces over the same vertices, for as long as the view moves.

/** Cells across the model: about 60 000 faces of a surface that is flat. */
const CELLS_ACROSS = 170;
/** No mesh spans more cells than this in one direction. */
const STRIDE = 1 << 17;

/**
 * The faces left when all vertices in a cell of a grid become the first of them; `radius` is that of the model, metres.
 * Holes may open where parts lie closer than a cell: good enough to turn by, not to judge by.
 */
export function coarseFaces({ positions, faces }, radius) {
  const cellsPerMetre = CELLS_ACROSS / (2 * radius);
  const firstOfCell = new Map();
  const kept = new Uint32Array(positions.length / 3);
  for (let vertex = 0; vertex < kept.length; vertex += 1) {
    const [x, y, z] = [0, 1, 2].map((axis) => Math.floor(positions[3 * vertex + axis] * cellsPerMetre));
    const cell = x + STRIDE * (y + STRIDE * z);
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
