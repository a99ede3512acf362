// The object of the stand-in: a plaque with a medallion, in closed form, scanned by a camera on an arc.

const HALF_SIDE_M = 0.2;
const DISTANCE_M = 0.8;

/** Height of the relief above the plaque, metres; `detail` is the share of what only shading shows. */
function height(x, y, detail) {
  const r = Math.hypot(x, y);
  const dome = r < 0.15 ? 0.035 * Math.cos((Math.PI * r) / 0.3) ** 0.7 : 0;
  const rim = 0.008 * Math.exp(-(((r - 0.165) / 0.006) ** 2));
  if (detail === 0) return dome + rim;
  const rings = 0.0007 * Math.cos(2 * Math.PI * r * 95) * Math.exp(-(((r - 0.1) / 0.035) ** 2));
  const petals = 0.0009 * Math.cos(12 * Math.atan2(y, x)) * Math.exp(-(((r - 0.05) / 0.02) ** 2));
  return dome + rim + detail * (rings + petals);
}

/** When the scan reaches a place, share of the whole. */
function arrival(x, y) {
  return 0.5 + 0.5 * Math.tanh((1.3 * x + 0.5 * y) / HALF_SIDE_M) + 0.03 * Math.sin(60 * x) * Math.cos(47 * y);
}

/**
 * The mesh as the API sends it. `progress` of the scan (0 to 1) cuts away what has not been seen and sets the coverage;
 * with `difference` the byte says how far the detail lies from the surface without it.
 */
export function meshBytes({ side, progress, detail = 0, difference = false, revision = 1 }) {
  const index = new Int32Array(side * side).fill(-1);
  const points = [];
  const at = (i) => (2 * i / (side - 1) - 1) * HALF_SIDE_M;
  for (let row = 0; row < side; row += 1) {
    for (let column = 0; column < side; column += 1) {
      const [x, y] = [at(column), at(row)];
      const seen = progress - 0.9 * arrival(x, y);
      if (seen < 0) continue;
      index[row * side + column] = points.length;
      points.push({ x, y, seen });
    }
  }
  const faces = [];
  for (let row = 0; row + 1 < side; row += 1) {
    for (let column = 0; column + 1 < side; column += 1) {
      const [a, b, c, d] = [0, 1, side, side + 1].map((step) => index[row * side + column + step]);
      if (a >= 0 && b >= 0 && c >= 0) faces.push(a, c, b);
      if (b >= 0 && d >= 0 && c >= 0) faces.push(b, c, d);
    }
  }
  return packed(points, faces, { detail, difference, revision });
}

function packed(points, faces, { detail, difference, revision }) {
  const n = points.length;
  const facesAt = 16 + 16 * n + 4 * Math.ceil(n / 4);
  const bytes = Buffer.alloc(facesAt + 4 * faces.length);
  bytes.write('RLM1', 'latin1');
  [revision, n, faces.length / 3].forEach((word, i) => bytes.writeUInt32LE(word, 4 + 4 * i));
  points.forEach(({ x, y, seen }, vertex) => {
    const z = DISTANCE_M - height(x, y, detail);
    [x, y, z].forEach((value, axis) => bytes.writeFloatLE(value, 16 + 12 * vertex + 4 * axis));
    const step = 1e-4;
    const slope = (dx, dy) => (height(x + dx, y + dy, detail) - height(x - dx, y - dy, detail)) / (2 * step);
    const normal = [-slope(step, 0), -slope(0, step), -1];
    const length = Math.hypot(...normal);
    normal.forEach((value, axis) => bytes.writeInt8(Math.round((127 * value) / length), 16 + 12 * n + 4 * vertex + axis));
    const mm = 1000 * (height(x, y, detail) - height(x, y, 0));
    const amount = difference ? 128 + Math.max(-127, Math.min(127, Math.round((mm / 2) * 127))) : Math.min(255, Math.round(420 * seen));
    bytes[16 + 16 * n + vertex] = amount;
  });
  faces.forEach((vertex, i) => bytes.writeUInt32LE(vertex, facesAt + 4 * i));
  return bytes;
}

/** World from camera at a share of the scan, row-major: on an arc before the plaque, looking at its middle. */
export function cameraPose(progress) {
  const yaw = 0.75 * Math.sin(2 * Math.PI * progress);
  const lift = 0.16 * Math.sin(5 * Math.PI * progress);
  const [sin, cos] = [Math.sin(yaw), Math.cos(yaw)];
  return [cos, 0, -sin, DISTANCE_M * sin, 0, 1, 0, lift, sin, 0, cos, DISTANCE_M * (1 - cos), 0, 0, 0, 1];
}

/** The same as translation and quaternion x, y, z, w. */
export function pathPose(progress) {
  const pose = cameraPose(progress);
  const yaw = -0.75 * Math.sin(2 * Math.PI * progress);
  return [pose[3], pose[7], pose[11], 0, Math.sin(yaw / 2), 0, Math.cos(yaw / 2)];
}

/** A depth or infrared image of the plaque as the socket sends it, seen from where the camera is. */
export function previewMessage(kind, frameId, progress) {
  const [width, height_] = [256, 212];
  const [low, high] = kind === 1 ? [0.55, 0.95] : [0, 65535];
  const bytes = Buffer.alloc(24 + width * height_);
  bytes[0] = kind;
  bytes.writeUInt32LE(frameId, 4);
  bytes.writeFloatLE(low, 8);
  bytes.writeFloatLE(high, 12);
  bytes.writeUInt16LE(width, 16);
  bytes.writeUInt16LE(height_, 18);
  const pose = cameraPose(progress);
  for (let v = 0; v < height_; v += 1) {
    for (let u = 0; u < width; u += 1) {
      const x = ((u - width / 2) / 183) * DISTANCE_M + 0.3 * pose[3];
      const y = ((v - height_ / 2) / 183) * DISTANCE_M + 0.3 * pose[7];
      const isOutside = Math.max(Math.abs(x), Math.abs(y)) > HALF_SIDE_M;
      const depth = isOutside ? 0.93 : DISTANCE_M - height(x, y, 0) + 0.25 * x * pose[3];
      bytes[24 + v * width + u] = kind === 1 ? depthByte(depth, low, high, x, y) : infraredByte(x, y, isOutside, pose);
    }
  }
  return bytes;
}

function depthByte(depth, low, high, x, y) {
  const isShadow = Math.abs(Math.max(Math.abs(x), Math.abs(y)) - HALF_SIDE_M) < 0.004;
  return isShadow ? 0 : 1 + Math.round((253 * (depth - low)) / (high - low));
}

function infraredByte(x, y, isOutside, pose) {
  const step = 1e-3;
  const slope = (height(x + step, y, 1) - height(x - step, y, 1)) / (2 * step);
  const lobe = Math.exp(-(x * x + y * y) / 0.11);
  const glint = Math.hypot(x - 0.12 * pose[3], y + 0.02) < 0.022;
  if (glint && !isOutside) return 255;
  return Math.max(3, Math.min(254, Math.round((isOutside ? 42 : 150) * lobe * (1 + 1.2 * slope))));
}

/** The newest pose as the socket sends it. */
export function poseMessage(frameId, progress, lastGood, isLost) {
  const bytes = Buffer.alloc(24 + 129);
  bytes[0] = 3;
  bytes.writeUInt32LE(frameId, 4);
  [...cameraPose(progress), ...cameraPose(lastGood)].forEach((value, i) => bytes.writeFloatLE(value, 24 + 4 * i));
  bytes[24 + 128] = isLost ? 1 : 0;
  return bytes;
}
