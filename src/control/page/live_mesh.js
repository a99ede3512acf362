// The growing mesh: the decimated one while it grows or the view moves, the full one when both are still.
// The daemon makes a mesh only while somebody asks for one, so this asks as long as a scan is looked at.

import * as api from './api.js';
import { decodeMesh } from './wire.js';
import { extentOf, geometryOf } from './surface.js';

const SHORTEST_INTERVAL_MS = 500;
/** A fetch that took long is followed by a rest of this many times its length, so that slow machines keep up. */
const REST = 3;
/** The full mesh is asked for once no newer one came for this long. */
const SETTLED_MS = 1500;

export class LiveMesh {
  #view;
  #surface;
  #onShown;
  #preview = null;
  #full = null;
  #tag = null;
  #changedAt = 0;
  #isFullAsked = false;
  #isBusy = false;
  #isMoving = false;
  #restUntil = 0;
  /** Counts the scans and resets: what was asked for before the last one is not shown. */
  #generation = 0;

  /** `onShown({revision, nFaces, lod, coverage})` after each mesh that is shown; `coverage` is a share. */
  constructor(view, onShown) {
    this.#view = view;
    this.#surface = view.surfaces.live;
    this.#onShown = onShown;
  }

  /** Asks for a newer mesh, if it is time; to be called with every status of a scan. */
  async follow() {
    const now = performance.now();
    if (this.#isBusy || now < this.#restUntil || document.hidden) return;
    const isSettled = this.#tag !== null && !this.#isFullAsked && !this.#isMoving && now - this.#changedAt > SETTLED_MS;
    this.#isBusy = true;
    try {
      await this.#ask(isSettled ? 'full' : 'preview', this.#generation);
    } catch (error) {
      if (error.code === 'no_mesh') this.clear();
      else if (error.code !== 'not_scanning') console.warn('live mesh:', error.message);
    } finally {
      const took = performance.now() - now;
      this.#restUntil = performance.now() + Math.max(SHORTEST_INTERVAL_MS - took, REST * took);
      this.#isBusy = false;
    }
  }

  /** Forgets the mesh: another scan, a reset, or a daemon that started anew. */
  clear() {
    this.#generation += 1;
    this.#preview?.dispose();
    this.#full?.dispose();
    this.#preview = null;
    this.#full = null;
    this.#tag = null;
    this.#surface.clear();
    this.#view.request();
  }

  set moving(isMoving) {
    this.#isMoving = isMoving;
    this.#showBest();
  }

  async #ask(lod, generation) {
    if (lod === 'full') this.#isFullAsked = true;
    const mesh = await api.newerMesh(lod, lod === 'full' ? null : this.#tag);
    if (mesh && generation === this.#generation) this.#take(lod, decodeMesh(mesh.bytes), mesh.tag);
  }

  #take(lod, decoded, tag) {
    const geometry = geometryOf(decoded);
    this.#full?.dispose();
    if (lod === 'full') {
      this.#full = geometry;
    } else {
      this.#preview?.dispose();
      this.#preview = geometry;
      this.#full = null;
      this.#tag = tag;
      this.#changedAt = performance.now();
      this.#isFullAsked = false;
      this.#view.place('live', extentOf(decoded));
    }
    this.#showBest();
    this.#onShown({ revision: decoded.revision, nFaces: decoded.faces.length / 3, lod, coverage: meanAmount(decoded) });
  }

  #showBest() {
    const best = this.#isMoving ? this.#preview : this.#full ?? this.#preview;
    if (!best) return;
    this.#surface.show(best);
    this.#view.request();
  }
}

function meanAmount({ amount }) {
  return amount.length === 0 ? 0 : amount.reduce((sum, value) => sum + value, 0) / (255 * amount.length);
}
