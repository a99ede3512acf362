// A finished scan: the mesh fused from depth against the refined one, and how far apart they are.

import * as api from './api.js';
import { DIVERGING } from './colour.js';
import { coarseFaces, facesNear } from './decimate.js';
import { decodeMesh } from './wire.js';
import { differenceLimitMm, extentOf, geometryOf, withFaces } from './surface.js';

const KEY_STEP = 20;
/** The fused mesh is of all that was seen, the refined one of the object: this far around it both are shown. */
const OBJECT_MARGIN_M = 0.006;

export class Compare {
  #view;
  #stage = document.querySelector('[data-testid=stage]');
  #divider = document.getElementById('divider');
  #slider = document.getElementById('wipe');
  #sessionId = null;
  #loaded = null;
  #limitMm = 1;
  /** Of each surface the fine and the coarse geometry. */
  #geometries = {};

  constructor(view) {
    this.#view = view;
    this.#slider.addEventListener('input', () => this.#wipe());
    this.#slider.addEventListener('keydown', (event) => this.#press(event));
    this.#wipe();
  }

  /** The scan to compare, or `null` while there is none. */
  offer(sessionId) {
    if (sessionId === this.#sessionId) return;
    this.#sessionId = sessionId;
    this.#loaded = null;
  }

  get isOffered() {
    return this.#sessionId !== null;
  }

  /** What the colours stand for: `{stops, ticks}`. */
  get legend() {
    const limit = this.#limitMm;
    return { stops: DIVERGING, ticks: [`−${limit} mm`, 'unmoved', `+${limit} mm`] };
  }

  /** Loads both meshes, once for each scan. */
  async load() {
    this.#loaded ??= this.#fetch(this.#sessionId);
    try {
      await this.#loaded;
    } catch (error) {
      this.#loaded = null;
      throw error;
    }
  }

  showDivider(isShown) {
    this.#divider.hidden = !isShown;
  }

  set moving(isMoving) {
    for (const [name, { fine, coarse }] of Object.entries(this.#geometries)) {
      this.#view.surfaces[name].show(isMoving ? coarse : fine);
    }
    this.#view.request();
  }

  async #fetch(id) {
    const [base, difference] = await Promise.all(['base', 'difference'].map((which) => api.meshBytes(api.sessionMesh(id, which))));
    if (id !== this.#sessionId) return;
    const refined = decodeMesh(difference);
    if (refined.faces.length === 0) throw new Error('the refined mesh is empty');
    const extent = extentOf(refined);
    for (const { fine, coarse } of Object.values(this.#geometries)) [fine, coarse].forEach((geometry) => geometry.dispose());
    const fused = decodeMesh(base);
    fused.faces = facesNear(fused, refined, OBJECT_MARGIN_M);
    this.#geometries = { base: twofold(fused, extent), refined: twofold(refined, extent) };
    this.moving = false;
    this.#limitMm = differenceLimitMm(refined);
    this.#view.surfaces.refined.limitMm = this.#limitMm;
    this.#view.place('refined', extent);
    this.#stage.dataset.compared = id;
  }

  #press(event) {
    const steps = { ArrowLeft: -KEY_STEP, ArrowRight: KEY_STEP };
    if (!steps[event.key]) return;
    event.preventDefault();
    this.#slider.value = Number(this.#slider.value) + steps[event.key];
    this.#wipe();
  }

  #wipe() {
    const share = Number(this.#slider.value) / Number(this.#slider.max);
    this.#divider.style.setProperty('--wipe', `${100 * share}%`);
    this.#slider.setAttribute('aria-valuetext', `${Math.round(100 * share)} % fused, the rest refined`);
    this.#view.wipe = share;
  }
}

function twofold(decoded, extent) {
  const fine = geometryOf(decoded, { fine: true });
  return { fine, coarse: withFaces(fine, coarseFaces(decoded, extent.radius)) };
}
