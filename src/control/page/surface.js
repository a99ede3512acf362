// A mesh on the graphics card: Phong shading with a light that the operator moves, and a paint of one byte a vertex.

import {
  BufferAttribute, BufferGeometry, DataTexture, DoubleSide, LinearFilter, Mesh, RGBAFormat, ShaderMaterial, Vector3,
} from './three.module.min.js';
import { COVERAGE, DIVERGING, ramp } from './colour.js';

/** The byte of a difference is 128 + 127 · mm / 2, held within a byte. */
const DIFFERENCE_BYTES_PER_MM = 127 / 2;
const NO_DIFFERENCE = 128;
/** Vertices looked at to find where a mesh is; enough for a box that holds nearly all. */
const EXTENT_SAMPLES = 4000;

const VERTEX = `
  attribute float amount;
  uniform float scale;
  uniform float offset;
  varying vec3 place;
  varying vec3 facing;
  varying float share;
  void main() {
    vec4 at = modelViewMatrix * vec4(position, 1.0);
    place = at.xyz;
    facing = normalMatrix * normal;
    share = amount * scale + offset;
    gl_Position = projectionMatrix * at;
  }`;
const FRAGMENT = `
  uniform sampler2D ramp;
  uniform vec3 plaster;
  uniform float painted;
  uniform vec3 light;
  varying vec3 place;
  varying vec3 facing;
  varying float share;
  void main() {
    vec3 eye = normalize(-place);
    vec3 normal = dot(facing, facing) > 0.01 ? normalize(facing) : normalize(cross(dFdx(place), dFdy(place)));
    float inside = dot(normal, eye) < 0.0 ? 1.0 : 0.0;
    normal = inside > 0.5 ? -normal : normal;
    vec3 albedo = mix(plaster, texture2D(ramp, vec2(clamp(share, 0.002, 0.998), 0.5)).rgb, painted);
    float diffuse = max(dot(normal, light), 0.0);
    float fill = max(dot(normal, eye), 0.0);
    float gloss = pow(max(dot(reflect(-light, normal), eye), 0.0), 24.0);
    vec3 colour = albedo * (0.16 + 0.66 * diffuse + 0.22 * fill) + 0.10 * gloss;
    gl_FragColor = vec4(mix(colour, 0.35 * colour, inside), 1.0);
  }`;

function texture(stops) {
  const map = new DataTexture(ramp(stops), 256, 1, RGBAFormat);
  map.minFilter = LinearFilter;
  map.magFilter = LinearFilter;
  map.needsUpdate = true;
  return map;
}

/** Where the light of all surfaces comes from, frame of the viewer. */
export const light = new Vector3();

/** Turns the light about the vertical; 0 is from the front, which hides relief, near ±90° it grazes. */
export function turnLight(degrees) {
  const angle = (degrees * Math.PI) / 180;
  light.set(Math.sin(angle), 0.45, Math.cos(angle)).normalize();
}

export class Surface {
  #material;

  /** `paint`: `'coverage'` or `'difference'`. */
  constructor(paint) {
    this.#material = new ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: DoubleSide,
      uniforms: {
        ramp: { value: texture(paint === 'difference' ? DIVERGING : COVERAGE) },
        plaster: { value: new Vector3(0.87, 0.83, 0.77) },
        painted: { value: 0 },
        scale: { value: 1 },
        offset: { value: 0 },
        light: { value: light },
      },
    });
    this.mesh = new Mesh(new BufferGeometry(), this.#material);
    this.mesh.visible = false;
    this.mesh.frustumCulled = false;
  }

  set painted(isPainted) {
    this.#material.uniforms.painted.value = isPainted ? 1 : 0;
  }

  /** The millimetres that the full colours stand for. */
  set limitMm(limit) {
    const scale = 255 / DIFFERENCE_BYTES_PER_MM / (2 * limit);
    this.#material.uniforms.scale.value = scale;
    this.#material.uniforms.offset.value = 0.5 - (NO_DIFFERENCE / 255) * scale;
  }

  /** Shows a geometry; the one shown before stays its owner's, to keep or to dispose of. */
  show(geometry) {
    this.mesh.geometry = geometry;
  }

  clear() {
    this.mesh.geometry = new BufferGeometry();
  }
}

/** A decoded mesh for the graphics card; `fine` computes normals anew, since a byte each shows as steps on smooth relief. */
export function geometryOf(decoded, { fine = false } = {}) {
  const geometry = new BufferGeometry();
  geometry.setAttribute('position', new BufferAttribute(decoded.positions, 3));
  geometry.setAttribute('amount', new BufferAttribute(decoded.amount, 1, true));
  geometry.setIndex(new BufferAttribute(decoded.faces, 1));
  if (fine) geometry.computeVertexNormals();
  else geometry.setAttribute('normal', new BufferAttribute(decoded.normals, 4, true));
  return geometry;
}

/** The same vertices with other faces; the buffers of the vertices are shared. */
export function withFaces(geometry, faces) {
  const coarse = new BufferGeometry();
  for (const name of ['position', 'amount', 'normal']) coarse.setAttribute(name, geometry.getAttribute(name));
  coarse.setIndex(new BufferAttribute(faces, 1));
  return coarse;
}

/** `{centre, radius}` of a sphere that holds nine tenths of the vertices, or `null` of a mesh without any. */
export function extentOf({ positions }) {
  const nVertices = positions.length / 3;
  if (nVertices === 0) return null;
  const every = Math.max(1, Math.floor(nVertices / EXTENT_SAMPLES));
  const samples = [];
  for (let vertex = 0; vertex < nVertices; vertex += every) samples.push(new Vector3().fromArray(positions, 3 * vertex));
  const middle = (axis) => samples.map((point) => point[axis]).sort((a, b) => a - b)[Math.floor(samples.length / 2)];
  const centre = new Vector3(middle('x'), middle('y'), middle('z'));
  const radii = samples.map((point) => point.distanceTo(centre)).sort((a, b) => a - b);
  return { centre, radius: Math.max(radii[Math.floor(0.9 * (radii.length - 1))], 0.02) };
}

/** A round limit for the colours of a difference: it holds 98 in 100 vertices, from 0.1 to 2 mm. */
export function differenceLimitMm({ amount }) {
  const counts = new Uint32Array(129);
  for (const value of amount) counts[Math.abs(value - NO_DIFFERENCE)] += 1;
  let left = 0.02 * amount.length;
  let byte = 128;
  while (byte > 0 && left >= counts[byte]) {
    left -= counts[byte];
    byte -= 1;
  }
  const mm = byte / DIFFERENCE_BYTES_PER_MM;
  return [0.1, 0.2, 0.5, 1].find((limit) => mm <= limit) ?? 2;
}
