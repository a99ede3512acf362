// How far the refinement is.

import * as api from './api.js';
import { duration } from './words.js';

const WORDS = {
  none: 'Starts when a scan is stopped.',
  waiting: 'Waits for its turn.',
  running: 'The surface is moved until it explains the shading.',
  done: 'Done. Compare the meshes in the view.',
  refused: 'The shading images do not confirm a better surface; the fused mesh stands.',
  failed: 'Failed; the fused mesh stands.',
  cancelled: 'Cancelled; the fused mesh stands.',
  superseded: 'Overtaken by a newer set of shading images.',
};
/** Of a scan that gives refinement nothing to go by. */
const WITHOUT_IMAGES = {
  scanning: 'The scan has no shading image yet, and is not refined without one.',
  ended: 'The last scan has no shading image and is not refined.',
};

export class Refinement {
  #card = document.getElementById('refinement');
  #words = document.getElementById('refinement-words');
  #progress = document.getElementById('refinement-progress');
  #bar = document.getElementById('refinement-bar');
  #cancel = document.getElementById('refinement-cancel');
  #figures = Object.fromEntries(
    ['round', 'step', 'energy', 'rmse', 'left'].map((name) => [name, document.getElementById(`refinement-${name}`)]),
  );
  #job = null;
  /** Whether the scan that goes on, or was seen last, has no shading image. */
  #lacksImages = false;

  /** `report(error)` is told of what the daemon refuses. */
  constructor(report) {
    this.#cancel.addEventListener('click', () => api.cancelJob(this.#job).catch(report));
  }

  /** `refinement`, `scan` and `snapshots` of the status. */
  show({ refinement, scan, snapshots }) {
    const { state, message, job } = refinement;
    this.#job = job;
    this.#card.dataset.state = state;
    if (scan) this.#lacksImages = snapshots.accepted === 0;
    const lacking = this.#lacksImages ? WITHOUT_IMAGES[scan ? 'scanning' : 'ended'] : null;
    const words = lacking && state === 'none' ? null : WORDS[state] ?? state;
    this.#words.textContent = [words, message, lacking].filter(Boolean).join(' ');
    this.#progress.hidden = state === 'none' || state === 'waiting';
    this.#cancel.hidden = state !== 'running' || !job;
    if (!this.#progress.hidden) this.#showFigures(refinement);
  }

  #showFigures({ state, round, step, energy_share: energy, rmse, secs_left: left }) {
    const [nth, of] = round;
    if (state === 'done') this.#bar.value = 1;
    else if (of > 0) this.#bar.value = Math.max(nth - 1, 0) / of;
    else this.#bar.removeAttribute('value');
    const say = (name, value) => { this.#figures[name].textContent = value ?? '–'; };
    say('round', of > 0 ? `${nth} of ${of}` : null);
    say('step', of > 0 ? step : null);
    say('energy', energy === null ? null : `${(100 * energy).toFixed(0)} %`);
    say('rmse', rmse === null ? null : rmse.toPrecision(3));
    say('left', left === null || state !== 'running' ? null : duration(left));
  }
}
