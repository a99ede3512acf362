// A finished scan: the mesh fused from depth against the refined one, and how far apart they are.

import * as api from './api.js';
import { DIVERGING } from './colour.js';
import { coarseFaces, facesNear } from './decimate.js';
import { decodeMesh } from './wire.js';
import { differenceLimitMm, extentOf, geometryOf, withFaces } from './surface.js';

const KEY_STEP = 20;
/** The fused mesh is of all that was seen, the refined one of the object: this far around it both are shown. */
const OBJECT_MARGIN_M = 0.006;
/** The meshes that are compared, as the API names them: the difference is the refined one, coloured. */
const COMPARED = ['base', 'difference'];

export class Compare {
  #view;
  #divider = document.getElementById('divider');
  #slider = document.getElementById('wipe');
  /** Where the meshes that are held lie; one with other content has another address. */
  #addresses = [];
  #limitMm = 1;
  /** Of each surface the fine and the coarse geometry. */
  #geometries = {};

  constructor(view) {
    this.#view = view;
    this.#slider.addEventListener('input', () => this.#wipe());
    this.#slider.addEventListener('keydown', (event) => this.#press(event));
    this.#wipe();
  }

  /** What the colours stand for: `{stops, ticks}`. */
  get legend() {
    const limit = this.#limitMm;
    return { stops: DIVERGING, ticks: [`−${limit} mm`, 'unmoved', `+${limit} mm`] };
  }

  /** Both meshes of a refined scan for `take`, or `null` if they are those that are held: a scan can be refined anew. */
  async fetch(sessionId) {
    const addresses = await Promise.all(COMPARED.map((which) => api.destination(api.sessionMesh(sessionId, which))));
    if (addresses.every((address, i) => address === this.#addresses[i])) return null;
    const [base, difference] = await Promise.all(addresses.map(api.meshBytes));
    return { addresses, base, difference };
  }

  /** Shows fetched meshes instead of those that are held. */
  take({ addresses, base, difference }) {
    const refined = decodeMesh(difference);
    if (refined.faces.length === 0) throw new Error('the refined mesh is empty');
    const extent = extentOf(refined);
    const fused = decodeMesh(base);
    fused.faces = facesNear(fused, refined, OBJECT_MARGIN_M);
    for (const { fine, coarse } of Object.values(this.#geometries)) [fine, coarse].forEach((geometry) => geometry.dispose());
    this.#geometries = { base: twofold(fused, extent), refined: twofold(refined, extent) };
    this.#addresses = addresses;
    this.moving = false;
    this.#limitMm = differenceLimitMm(refined);
    this.#view.surfaces.refined.limitMm = this.#limitMm;
    this.#view.place('refined', extent);
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
