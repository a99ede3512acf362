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
  /** Finished scans, newest first. */
  sessions = [];

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

  get newest() {
    return this.sessions[0] ?? null;
  }

  /** The newest scan that has a refined mesh. */
  get newestRefined() {
    return this.sessions.find((session) => hasFile(session, 'refined.ply')) ?? null;
  }

  /** Fetches the list; the scan that is still going on is none of them. */
  async refresh(scanId) {
    const sessions = await api.sessions();
    this.sessions = sessions.filter(({ id, files }) => id !== scanId && files.length > 0)
      .sort((a, b) => b.id.localeCompare(a.id));
  }

  open() {
    this.#select.replaceChildren(...this.sessions.map(({ id, label }) => new Option(label ? `${label} (${id})` : id, id)));
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

function hasFile({ files }, name) {
  return files.some((file) => file.name === name);
}
