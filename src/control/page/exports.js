// Finished scans, and the files that each offers for download.

import * as api from './api.js';
import { bytes } from './words.js';

const FILES = {
  'refined.glb': 'Refined mesh, GLB: browsers, phones, presentations',
  'refined.ply': 'Refined mesh, PLY',
  'base.ply': 'Mesh fused from depth, PLY',
  'report.html': 'Report',
  'report.json': 'Report, for programs',
  'trajectory.txt': 'Path of the camera',
  'events.jsonl': 'What happened, for programs',
};

export class Exports {
  #dialog = document.getElementById('export-dialog');
  #select = document.getElementById('export-session');
  #list = document.getElementById('export-files');
  #show = document.getElementById('export-show');
  /** Finished scans that have files, the one that ended last first. */
  sessions = [];
  /** Refinements, newest first. */
  #jobs = [];
  /** How every scan stood when the list was fetched last, by its id; `null` before the first time. */
  #states = null;
  #nFetched = 0;

  /** `show(session)` is asked for the meshes of a refined scan. */
  constructor(show) {
    this.#select.addEventListener('change', () => this.#fill());
    this.#show.addEventListener('click', () => {
      this.#dialog.close();
      show(this.#chosen);
    });
  }

  get #chosen() {
    return this.sessions.find(({ id }) => id === this.#select.value);
  }

  /** The newest whole scan that came to a mesh: what was written down on the way is none, and one that failed may have none. */
  get newest() {
    return this.sessions.find((session) => !session.interim_of && hasFile(session, 'base.ply')) ?? null;
  }

  /** The scan that was refined last, on the way or as a whole. */
  get newestRefined() {
    const refined = this.sessions.filter((session) => hasFile(session, 'refined.ply'));
    const ofJob = ({ scan }) => refined.find(({ id }) => id === scan);
    const job = this.#jobs.find((each) => each.state === 'done' && ofJob(each));
    return (job ? ofJob(job) : refined[0]) ?? null;
  }

  /** Refinements that wait, in the order in which they were asked for, as `{job, name}` with the name of the scan. */
  get waiting() {
    const nameOfScan = (scan) => {
      const session = this.sessions.find(({ id }) => id === scan);
      return session ? nameOf(session) : scan;
    };
    const waiting = this.#jobs.filter(({ state }) => state === 'waiting').reverse();
    return waiting.map(({ id, scan }) => ({ job: id, name: nameOfScan(scan) }));
  }

  /**
   * Fetches the list; the scan that is still going on is none of them. Returns the scans that failed or were interrupted
   * since it was fetched last, the newest first; the first time the last scan, if it was interrupted.
   */
  async refresh(scanId) {
    this.#nFetched += 1;
    const number = this.#nFetched;
    const [sessions, jobs] = await Promise.all([api.sessions(), api.jobs()]);
    // A newer list is on its way, or came first.
    if (number !== this.#nFetched) return [];
    this.#jobs = jobs;
    const ended = sessions.filter(({ id }) => id !== scanId).sort((a, b) => endOf(b) - endOf(a));
    this.sessions = ended.filter(({ files }) => files.length > 0);
    const before = this.#states;
    this.#states = new Map(sessions.map(({ id, state }) => [id, state]));
    if (before) return ended.filter(({ id, state }) => ['failed', 'interrupted'].includes(state) && before.get(id) !== state);
    const last = ended.find((session) => !session.interim_of);
    return last?.state === 'interrupted' ? [last] : [];
  }

  open() {
    this.#select.replaceChildren(...this.sessions.map((session) => new Option(nameOf(session), session.id)));
    this.#fill();
    this.#dialog.showModal();
  }

  #fill() {
    const session = this.#chosen;
    this.#show.disabled = !session || !hasFile(session, 'refined.ply');
    const names = Object.keys(FILES).filter((name) => session && hasFile(session, name));
    this.#list.replaceChildren(...names.map((name) => {
      const link = document.createElement('a');
      link.href = api.sessionFile(session.id, name);
      link.download = `${session.id}-${name}`;
      link.dataset.file = name;
      link.textContent = `${FILES[name]} (${bytes(session.files.find((file) => file.name === name).bytes)})`;
      const item = document.createElement('li');
      item.append(link);
      return item;
    }));
  }
}

/** When a scan ended; one that was interrupted tells only when it began. */
function endOf(session) {
  return session.ended_unix_ms ?? session.started_unix_ms;
}

function nameOf({ id, label, interim_of: whole }) {
  return (label ? `${label} (${id})` : id) + (whole ? ', on the way' : '');
}

function hasFile({ files }, name) {
  return files.some((file) => file.name === name);
}
