// The binary forms of the API: preview messages of the socket, and meshes.

const PREVIEW_KINDS = [null, 'depth', 'ir', 'pose'];
const PREVIEW_HEADER = 24;
const MESH_HEADER = 16;
const MESH_MAGIC = 0x314d4c52; // "RLM1", little endian

/**
 * One message of the socket, or `null` if it is not one that this page knows.
 *
 * Images: `low`, `high` are what the values 1 and 254 stand for (metres or counts), 0 is no value.
 * Poses: row-major 4 × 4, world from camera, metres; whether track is lost is in the status, which also comes without frames.
 */
export function decodePreview(buffer) {
  if (buffer.byteLength < PREVIEW_HEADER) return null;
  const view = new DataView(buffer);
  const kind = PREVIEW_KINDS[view.getUint8(0)];
  const frameId = view.getUint32(4, true);
  if (kind === 'pose') {
    if (buffer.byteLength < PREVIEW_HEADER + 129) return null;
    const matrix = (offset) => Array.from({ length: 16 }, (_, i) => view.getFloat32(PREVIEW_HEADER + offset + 4 * i, true));
    return { kind, frameId, pose: matrix(0), lastGood: matrix(64) };
  }
  const width = view.getUint16(16, true);
  const height = view.getUint16(18, true);
  if (!kind || width * height === 0 || buffer.byteLength < PREVIEW_HEADER + width * height) return null;
  const values = new Uint8Array(buffer, PREVIEW_HEADER, width * height);
  return { kind, frameId, low: view.getFloat32(8, true), high: view.getFloat32(12, true), width, height, values };
}

/**
 * A mesh in metres, frame `world`, as views into the buffer; `normals` have four components of which the last is
 * nothing, `amount` is a byte for each vertex: coverage, or the difference of two meshes.
 *
 * Throws a `RangeError` if the bytes are not a whole mesh.
 */
export function decodeMesh(buffer) {
  const header = new DataView(buffer);
  if (buffer.byteLength < MESH_HEADER || header.getUint32(0, true) !== MESH_MAGIC) throw new RangeError('not a mesh');
  const revision = header.getUint32(4, true);
  const nVertices = header.getUint32(8, true);
  const nFaces = header.getUint32(12, true);
  const normalsAt = MESH_HEADER + 12 * nVertices;
  const amountAt = normalsAt + 4 * nVertices;
  const facesAt = amountAt + 4 * Math.ceil(nVertices / 4);
  if (buffer.byteLength < facesAt + 12 * nFaces) throw new RangeError('the mesh is cut off');
  return {
    revision,
    positions: new Float32Array(buffer, MESH_HEADER, 3 * nVertices),
    normals: new Int8Array(buffer, normalsAt, 4 * nVertices),
    amount: new Uint8Array(buffer, amountAt, nVertices),
    faces: new Uint32Array(buffer, facesAt, 3 * nFaces),
  };
}
