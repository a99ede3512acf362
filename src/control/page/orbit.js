// Turning, shifting and zooming the view: one pointer turns, two pinch and shift, the wheel zooms, keys do all of it.

import { Vector3 } from './three.module.min.js';

const TURN_RAD_PER_PX = 0.006;
const KEY_TURN_RAD = Math.PI / 24;
const KEY_ZOOM = 1.15;
const STEEPEST_RAD = 1.5;
/** The view counts as moving for this long after the last touch. */
const STILL_AFTER_MS = 350;

export class Orbit {
  #camera;
  #target = new Vector3();
  #distance = 1;
  #yaw = 0.45;
  #pitch = 0.3;
  #pointers = new Map();
  #stillTimer = 0;
  #on;

  /** `on.change()` after each change, `on.moving(isMoving)`, `on.fit()` when the operator asks to see all. */
  constructor(camera, element, on) {
    this.#camera = camera;
    this.#on = on;
    this.isTouched = false;
    element.addEventListener('pointerdown', (event) => {
      element.setPointerCapture(event.pointerId);
      this.#pointers.set(event.pointerId, event);
    });
    element.addEventListener('pointermove', (event) => this.#drag(event));
    for (const end of ['pointerup', 'pointercancel']) {
      element.addEventListener(end, (event) => this.#pointers.delete(event.pointerId));
    }
    element.addEventListener('wheel', (event) => {
      event.preventDefault();
      this.#distance *= Math.exp(0.001 * event.deltaY);
      this.#touch();
    }, { passive: false });
    element.addEventListener('keydown', (event) => this.#press(event));
    element.addEventListener('contextmenu', (event) => event.preventDefault());
  }

  /** Looks at a sphere so that it fills the view, from the side the operator last chose or from a given one. */
  frame({ centre, radius }, side) {
    if (side) [this.#yaw, this.#pitch] = [side.yaw, side.pitch];
    const half = (this.#camera.fov * Math.PI) / 360;
    const narrower = Math.atan(Math.tan(half) * Math.min(this.#camera.aspect, 1));
    this.#distance = radius / Math.sin(narrower);
    this.#target.copy(centre);
    this.#place();
  }

  #drag(event) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) return;
    const moved = { x: event.clientX - before.clientX, y: event.clientY - before.clientY };
    if (this.#pointers.size === 1 && !event.shiftKey && event.buttons !== 2) {
      this.#turn(-moved.x * TURN_RAD_PER_PX, moved.y * TURN_RAD_PER_PX);
    } else if (this.#pointers.size === 1) {
      this.#shift(moved);
    } else {
      const [first, second] = [...this.#pointers.values()];
      const other = first.pointerId === event.pointerId ? second : first;
      const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      this.#distance *= apart(before) / Math.max(apart(event), 1);
      this.#shift({ x: moved.x / 2, y: moved.y / 2 });
    }
    this.#pointers.set(event.pointerId, event);
    this.#touch();
  }

  #press(event) {
    const actions = {
      ArrowLeft: () => this.#turn(-KEY_TURN_RAD, 0),
      ArrowRight: () => this.#turn(KEY_TURN_RAD, 0),
      ArrowUp: () => this.#turn(0, KEY_TURN_RAD),
      ArrowDown: () => this.#turn(0, -KEY_TURN_RAD),
      '+': () => { this.#distance /= KEY_ZOOM; },
      '-': () => { this.#distance *= KEY_ZOOM; },
      f: () => this.#on.fit(),
    };
    const action = actions[event.key];
    if (!action || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    action();
    if (event.key !== 'f') this.#touch();
  }

  #turn(yaw, pitch) {
    this.#yaw += yaw;
    this.#pitch = Math.min(Math.max(this.#pitch + pitch, -STEEPEST_RAD), STEEPEST_RAD);
  }

  #shift({ x, y }) {
    const metresPerPx = (2 * this.#distance * Math.tan((this.#camera.fov * Math.PI) / 360)) / window.innerHeight;
    const right = new Vector3().setFromMatrixColumn(this.#camera.matrix, 0);
    const up = new Vector3().setFromMatrixColumn(this.#camera.matrix, 1);
    this.#target.addScaledVector(right, -x * metresPerPx).addScaledVector(up, y * metresPerPx);
  }

  #touch() {
    this.isTouched = true;
    this.#place();
    this.#on.moving(true);
    clearTimeout(this.#stillTimer);
    this.#stillTimer = setTimeout(() => this.#on.moving(false), STILL_AFTER_MS);
  }

  #place() {
    this.#distance = Math.min(Math.max(this.#distance, 0.02), 20);
    const flat = Math.cos(this.#pitch);
    this.#camera.position.set(Math.sin(this.#yaw) * flat, Math.sin(this.#pitch), Math.cos(this.#yaw) * flat);
    this.#camera.position.multiplyScalar(this.#distance).add(this.#target);
    this.#camera.near = this.#distance / 100;
    this.#camera.far = this.#distance + 20;
    this.#camera.lookAt(this.#target);
    this.#camera.updateProjectionMatrix();
    this.#camera.updateMatrix();
    this.#on.change();
  }
}
