// The view of the model. Nothing is drawn unless something changed.

import { Group, PerspectiveCamera, Scene, Vector3, WebGLRenderer } from './three.module.min.js';
import { Markers } from './markers.js';
import { Orbit } from './orbit.js';
import { Surface, turnLight } from './surface.js';

const SHARPEST_PIXEL_RATIO = 2;
/** What is to be seen may grow, shrink and shift by this much before the view follows; arbitrary. */
const REFIT_GROWTH = 1.15;
const REFIT_SHRINKAGE = 1.6;
const REFIT_SHIFT = 0.25;
/** Sides to look from: over the operator's shoulder while scanning, from the front to compare. */
const SIDES = { live: { yaw: 0.55, pitch: 0.42 }, compare: { yaw: 0.18, pitch: 0.12 } };
/** How much of the way from the model to the camera is shown; seen from behind the camera it is foreshortened. */
const SHOWN_WAY = 0.84;
/** From the sphere of nine tenths of an object's vertices to its corners; arbitrary. */
const CORNERS = 1.18;
/** Room around the camera, metres. */
const CAMERA_ROOM_M = 0.12;

export class View {
  surfaces = { live: new Surface('coverage'), base: new Surface('coverage'), refined: new Surface('difference') };
  markers = new Markers();
  mode = 'live';
  /** Called with whether the operator moves the view, so that less can be drawn meanwhile. */
  onMoving = () => {};
  #canvas;
  #renderer;
  #scene = new Scene();
  #camera = new PerspectiveCamera(38, 1, 0.01, 20);
  #orbit;
  #wipe = 0.5;
  #isRequested = false;
  #isLost = false;
  #extents = {};
  #framed = null;

  /** Throws if the browser has no WebGL. `notice(text)` tells the operator of the view itself, `''` for nothing. */
  constructor(canvas, notice) {
    this.#canvas = canvas;
    this.#renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, powerPreference: 'low-power' });
    this.#renderer.setClearAlpha(0);
    // The first camera looks along +z with y down; half a turn about x stands the world upright.
    const upright = new Group();
    upright.rotation.x = Math.PI;
    upright.add(...Object.values(this.surfaces).map((surface) => surface.mesh), this.markers.group);
    this.#scene.add(upright);
    this.#orbit = new Orbit(this.#camera, canvas, {
      change: () => this.request(),
      moving: (isMoving) => this.onMoving(isMoving),
      fit: () => this.fit(),
    });
    turnLight(-40);
    canvas.addEventListener('webglcontextlost', () => {
      this.#isLost = true;
      notice('The graphics were interrupted; they come back by themselves.');
    });
    canvas.addEventListener('webglcontextrestored', () => {
      this.#isLost = false;
      notice('');
      this.request();
    });
    new ResizeObserver(() => this.#resize()).observe(canvas);
    this.#resize();
    this.#frame({ centre: new Vector3(0, 0, 0.4), radius: 0.45 }, SIDES.live);
  }

  /** Draws once before the next frame of the screen. */
  request() {
    if (this.#isRequested) return;
    this.#isRequested = true;
    requestAnimationFrame(() => {
      this.#isRequested = false;
      this.#draw();
    });
  }

  /** `live`, `compare` (base left of the border, refined right of it) or `difference`. */
  show(mode) {
    this.mode = mode;
    this.surfaces.refined.painted = mode === 'difference';
    this.#orbit.isTouched = false;
    this.fit();
  }

  /** Where the border of the comparison is, share of the width. */
  set wipe(share) {
    this.#wipe = share;
    this.request();
  }

  /** Tells where a surface is; the view follows a growing model until the operator turns it. */
  place(name, extent) {
    this.#extents[name] = extent;
    this.keepInView();
  }

  /** Follows model and camera as far as they left the view, unless the operator turned it. */
  keepInView() {
    const wanted = this.#wantedSphere();
    if (!wanted || this.#orbit.isTouched) return;
    const framed = this.#framed;
    const isFramed = wanted.radius < framed.radius * REFIT_GROWTH && wanted.radius * REFIT_SHRINKAGE > framed.radius &&
      wanted.centre.distanceTo(framed.centre) < REFIT_SHIFT * framed.radius;
    if (!isFramed) this.fit();
  }

  /** Shows all of the model. */
  fit() {
    const sphere = this.#wantedSphere();
    if (sphere) this.#frame(sphere, this.#orbit.isTouched ? undefined : SIDES[this.mode] ?? SIDES.compare);
    this.request();
  }

  /** While scanning the sphere reaches some way towards the camera, so that both are in view. */
  #wantedSphere() {
    if (this.mode !== 'live') {
      const object = this.#extents.refined;
      return object ? { centre: object.centre, radius: object.radius * CORNERS } : null;
    }
    const extent = this.#extents.live;
    if (!extent) return null;
    const camera = this.markers.lastPlace ?? new Vector3();
    const way = camera.clone().sub(extent.centre).multiplyScalar(SHOWN_WAY);
    const radius = Math.max(extent.radius, (extent.radius + way.length() + CAMERA_ROOM_M) / 2);
    const centre = extent.centre.clone().add(way.setLength(radius - extent.radius));
    return { centre, radius };
  }

  #frame(sphere, side) {
    this.#framed = { centre: sphere.centre.clone(), radius: sphere.radius };
    const { x, y, z } = sphere.centre;
    this.#orbit.frame({ centre: new Vector3(x, -y, -z), radius: sphere.radius }, side);
  }

  #resize() {
    const { clientWidth, clientHeight } = this.#canvas;
    if (clientWidth === 0 || clientHeight === 0) return;
    this.#renderer.setPixelRatio(Math.min(devicePixelRatio, SHARPEST_PIXEL_RATIO));
    this.#renderer.setSize(clientWidth, clientHeight, false);
    this.#camera.aspect = clientWidth / clientHeight;
    this.#camera.updateProjectionMatrix();
    this.request();
  }

  #draw() {
    if (this.#isLost) return;
    const { live, base, refined } = this.surfaces;
    const { clientWidth: width, clientHeight: height } = this.#canvas;
    live.mesh.visible = this.mode === 'live';
    this.markers.group.visible = this.mode === 'live';
    base.mesh.visible = false;
    refined.mesh.visible = this.mode !== 'live';
    if (this.mode === 'compare') {
      const border = Math.round(this.#wipe * width);
      this.#renderer.setScissorTest(true);
      this.#renderer.setScissor(border, 0, width - border, height);
      this.#renderer.render(this.#scene, this.#camera);
      base.mesh.visible = true;
      refined.mesh.visible = false;
      this.#renderer.setScissor(0, 0, border, height);
    } else {
      this.#renderer.setScissorTest(false);
    }
    this.#renderer.render(this.#scene, this.#camera);
    this.#canvas.dataset.drawn = 1 + Number(this.#canvas.dataset.drawn ?? 0);
  }
}
