// The growing mesh: the decimated one while it grows or the view moves, the full one when both are still.

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
  #revision = null;
  #wanted = null;
  #preview = null;
  #full = null;
  #isBusy = false;
  #isMoving = false;
  #isThere = false;
  #restUntil = 0;
  #settledTimer = 0;

  /** `onShown({revision, nFaces, lod, coverage})` after each mesh that is shown; `coverage` is a share. */
  constructor(view, onShown) {
    this.#view = view;
    this.#surface = view.surfaces.live;
    this.onShown = onShown;
  }

  /** `mesh` of the status: fetches what is newer than what is shown. */
  follow(mesh) {
    this.#isThere = Boolean(mesh);
    if (!mesh) return;
    if (this.#wanted !== null && mesh.revision < this.#wanted) this.clear();
    this.#wanted = mesh.revision;
    if (this.#isBusy || this.#isCurrent() || performance.now() < this.#restUntil || document.hidden) return;
    this.#fetch('preview');
  }

  /** Forgets the mesh: another scan, a reset, or a daemon that started anew. */
  clear() {
    clearTimeout(this.#settledTimer);
    this.#preview?.dispose();
    this.#full?.dispose();
    this.#preview = null;
    this.#full = null;
    this.#revision = null;
    this.#wanted = null;
    this.#surface.clear();
    this.#view.request();
  }

  set moving(isMoving) {
    this.#isMoving = isMoving;
    this.#showBest();
  }

  #isCurrent() {
    return this.#revision !== null && this.#revision >= this.#wanted;
  }

  async #fetch(lod) {
    this.#isBusy = true;
    const started = performance.now();
    try {
      const buffer = await api.meshBytes(api.liveMesh(lod));
      // Cleared meanwhile: what came belongs to a model that is gone.
      if (buffer && this.#wanted !== null) this.#take(lod, decodeMesh(buffer));
    } catch (error) {
      console.warn('live mesh:', error.message);
    } finally {
      const took = performance.now() - started;
      this.#restUntil = performance.now() + Math.max(SHORTEST_INTERVAL_MS - took, REST * took);
      this.#isBusy = false;
    }
  }

  #take(lod, decoded) {
    const geometry = geometryOf(decoded);
    if (lod === 'full') {
      this.#full?.dispose();
      this.#full = geometry;
    } else {
      this.#preview?.dispose();
      this.#full?.dispose();
      this.#preview = geometry;
      this.#full = null;
      clearTimeout(this.#settledTimer);
      this.#settledTimer = setTimeout(() => this.#fetchFull(), SETTLED_MS);
      this.#view.place('live', extentOf(decoded));
    }
    this.#revision = decoded.revision;
    this.#showBest();
    this.onShown({ revision: decoded.revision, nFaces: decoded.faces.length / 3, lod, coverage: meanAmount(decoded) });
  }

  #fetchFull() {
    if (!this.#isThere || this.#isBusy || this.#isMoving || !this.#isCurrent() || document.hidden) return;
    this.#fetch('full');
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
