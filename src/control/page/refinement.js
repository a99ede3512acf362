// How far the refinement is, and which others wait.

import * as api from './api.js';
import { duration } from './words.js';

const WORDS = {
  none: 'Starts when a scan is stopped.',
  waiting: 'Waits for its turn.',
  running: 'The surface is moved until it explains the shading.',
  done: 'Done. Compare the meshes in the view.',
  // Why is told by the daemon; the mesh that stands may be a refined one of before.
  refused: 'Not refined; the mesh stands as it was.',
  failed: 'Failed; the mesh stands as it was.',
  cancelled: 'Cancelled; the mesh stands as it was.',
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
  #queue = document.getElementById('refinement-queue');
  #figures = Object.fromEntries(
    ['round', 'step', 'energy', 'rmse', 'left'].map((name) => [name, document.getElementById(`refinement-${name}`)]),
  );
  #job = null;
  /** Whether the scan that goes on, or was seen last, has no shading image. */
  #lacksImages = false;
  #report;

  /** `report(error)` is told of what the daemon refuses. */
  constructor(report) {
    this.#report = report;
    this.#cancel.addEventListener('click', () => this.#end(this.#job));
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
    this.#cancel.hidden = !['waiting', 'running'].includes(state) || !job;
    if (!this.#progress.hidden) this.#showFigures(refinement);
    this.#showQueue();
  }

  /** Refinements that wait, in the order in which they were asked for: `{job, name}`, the name that of the scan. */
  queue(waiting) {
    // Who is about to press a button finds it where it was.
    const isKept = ({ dataset }) => waiting.some(({ job }) => job === dataset.job);
    const items = [...this.#queue.children];
    for (const item of items) if (!isKept(item)) item.remove();
    const isNew = ({ job }) => !items.some(({ dataset }) => dataset.job === job);
    this.#queue.append(...waiting.filter(isNew).map((refinement) => this.#item(refinement)));
    this.#showQueue();
  }

  #item({ job, name }) {
    const item = document.createElement('li');
    item.dataset.job = job;
    const words = document.createElement('span');
    words.textContent = `Then ${name}`;
    words.title = name;
    const cancel = document.createElement('button');
    cancel.type = 'button';
    cancel.className = 'small';
    cancel.textContent = 'Cancel';
    cancel.ariaLabel = `Cancel the refinement of ${name}`;
    cancel.addEventListener('click', () => this.#end(job));
    item.append(words, cancel);
    return item;
  }

  /** One that waits and is told of above is not told of twice. */
  #showQueue() {
    for (const item of this.#queue.children) item.hidden = item.dataset.job === this.#job;
  }

  #end(job) {
    api.cancelJob(job).catch(this.#report);
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
