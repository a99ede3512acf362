// What is drawn beside the mesh: the camera, its path, the ghost of the last good pose, and where to go next.

import {
  BufferAttribute, BufferGeometry, CylinderGeometry, DoubleSide, Group, Line, LineBasicMaterial, LineDashedMaterial, Matrix4, Mesh,
  MeshBasicMaterial, Quaternion, Vector3,
} from './three.module.min.js';

const COLOURS = { camera: 0xf2efe8, path: 0x6f8596, ghost: 0xff6f5b, next: 0x4ec5b3 };
/** Half the field of view at unit distance, and how far a frustum is drawn, metres. */
const HALF_FIELDS = { kinect1: [0.54, 0.41], kinect2: [0.7, 0.58] };
const FRUSTUM_DEPTH_M = 0.11;
const EDGE_RADIUS_M = 0.0014;
const UP = new Vector3(0, 1, 0);

/** All markers live in the frame `world`, like the mesh. */
export class Markers {
  group = new Group();
  #camera = frustum(COLOURS.camera, 0.1);
  #ghost = frustum(COLOURS.ghost, 0.28);
  #next = frustum(COLOURS.next, 0.16);
  #path = new Line(new BufferGeometry(), new LineBasicMaterial({ color: COLOURS.path }));
  #wayToNext = new Line(new BufferGeometry(), new LineDashedMaterial({ color: COLOURS.next, dashSize: 0.012, gapSize: 0.01 }));
  #sensor = '';
  #isKnown = false;
  #isLost = false;

  constructor() {
    this.group.add(this.#camera, this.#ghost, this.#next, this.#path, this.#wayToNext);
    this.clear();
  }

  clear() {
    this.#isKnown = false;
    for (const marker of this.group.children) marker.visible = false;
  }

  /** The field of view of the sensor that scans. */
  set sensor(name) {
    if (name === this.#sensor) return;
    this.#sensor = name;
    const [x, y] = HALF_FIELDS[name] ?? HALF_FIELDS.kinect2;
    for (const marker of [this.#camera, this.#ghost, this.#next]) marker.userData.widen(x, y);
  }

  /** Where the camera is in the frame `world`, or `null` while that is not known. */
  get cameraPlace() {
    return this.#camera.visible ? new Vector3().setFromMatrixPosition(this.#camera.matrix) : null;
  }

  /** Where the camera is, or was before track was lost; `null` if it never was anywhere. */
  get lastPlace() {
    return this.#ghost.visible ? new Vector3().setFromMatrixPosition(this.#ghost.matrix) : this.cameraPlace;
  }

  /** While track is lost the ghost shows the last pose that held, and the camera is nowhere. */
  set isLost(isLost) {
    this.#isLost = isLost;
    this.#showCamera();
  }

  /** The newest pose, and the last one that held. */
  showPose({ pose, lastGood }) {
    this.#isKnown = true;
    this.#camera.matrix.set(...pose);
    this.#ghost.matrix.set(...lastGood);
    this.#showCamera();
  }

  #showCamera() {
    this.#ghost.visible = this.#isKnown && this.#isLost;
    this.#camera.visible = this.#isKnown && !this.#isLost;
    this.#aimAtNext();
  }

  /** `poses` and `next` as the API gives them: translation, then the quaternion x, y, z, w. */
  showPath({ poses, next }) {
    const places = new Float32Array(poses.flatMap((pose) => pose.slice(0, 3)));
    replaceLine(this.#path, places);
    this.#path.visible = poses.length > 1;
    this.#next.visible = Boolean(next);
    if (next) this.#next.matrix.copy(matrixOf(next.pose));
    this.#aimAtNext();
  }

  #aimAtNext() {
    const from = this.cameraPlace;
    this.#wayToNext.visible = this.#next.visible && from !== null;
    if (!this.#wayToNext.visible) return;
    const to = new Vector3().setFromMatrixPosition(this.#next.matrix);
    replaceLine(this.#wayToNext, new Float32Array([...from, ...to]));
    this.#wayToNext.computeLineDistances();
  }
}

function replaceLine(line, places) {
  line.geometry.dispose();
  line.geometry = new BufferGeometry().setAttribute('position', new BufferAttribute(places, 3));
  line.frustumCulled = false;
}

function matrixOf([x, y, z, ...quaternion]) {
  return new Matrix4().compose(new Vector3(x, y, z), new Quaternion(...quaternion), new Vector3(1, 1, 1));
}

/** A pyramid with its tip in the camera's centre, edges thick enough to be seen on any screen. */
function frustum(color, opacity) {
  const group = new Group();
  group.matrixAutoUpdate = false;
  const edgeMaterial = new MeshBasicMaterial({ color });
  const sideMaterial = new MeshBasicMaterial({ color, opacity, transparent: true, depthWrite: false, side: DoubleSide });
  const edgeGeometry = new CylinderGeometry(EDGE_RADIUS_M, EDGE_RADIUS_M, 1, 6, 1);
  const edges = Array.from({ length: 8 }, () => new Mesh(edgeGeometry, edgeMaterial));
  const sides = new Mesh(new BufferGeometry(), sideMaterial);
  group.add(...edges, sides);
  group.userData.widen = (halfX, halfY) => {
    const corner = (x, y) => new Vector3(x * halfX, y * halfY, 1).multiplyScalar(FRUSTUM_DEPTH_M);
    const corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
    const tip = new Vector3();
    corners.forEach((place, i) => {
      lay(edges[2 * i], tip, place);
      lay(edges[2 * i + 1], place, corners[(i + 1) % 4]);
    });
    const triangles = corners.flatMap((place, i) => [...tip, ...place, ...corners[(i + 1) % 4]]);
    sides.geometry.setAttribute('position', new BufferAttribute(new Float32Array(triangles), 3));
  };
  group.userData.widen(...HALF_FIELDS.kinect2);
  return group;
}

/** Lays a cylinder of unit length between two points. */
function lay(cylinder, from, to) {
  const along = to.clone().sub(from);
  cylinder.scale.set(1, along.length(), 1);
  cylinder.position.copy(from).addScaledVector(along, 0.5);
  cylinder.quaternion.setFromUnitVectors(UP, along.normalize());
}
