// Whether all is well: every frame accounted for, the recorder, the disk, the daemon itself.

import { bytes, duration, grouped, spelled } from './words.js';

const FRAME_ROWS = {
  fused: 'fused',
  lost: 'track lost',
  without_depth: 'without depth',
  paused: 'while paused',
  damaged: 'damaged',
  dropped: 'dropped, fusion too slow',
  in_flight: 'on their way',
};
/** The disk gauge ends at this many times the floor at least. */
const GAUGE_FLOORS = 4;

export class Health {
  #at = (id) => document.getElementById(id);
  #rows = Object.entries(FRAME_ROWS).map(([key, words]) => row(key, words));

  constructor() {
    this.#at('frame-table').append(...this.#rows.map(({ element }) => element));
  }

  show({ fps, frames, mesh, recording, daemon }) {
    this.#say('health-fps', fps.toFixed(1));
    this.#say('health-memory', daemon.rss_bytes === null ? '–' : bytes(daemon.rss_bytes));
    this.#say('health-mesh', mesh ? `${grouped(Math.round(mesh.faces / 1000))} k faces` : '–');
    this.#at('health-mesh').dataset.faces = mesh?.faces ?? 0;
    this.#showFrames(frames);
    this.#showRecording(recording);
    const { version, uptime_secs: uptime, clients, config_error: configError } = daemon;
    this.#say('daemon', `relief ${version}, up ${duration(uptime)}, ${clients} ${clients === 1 ? 'connection' : 'connections'} open`);
    this.#say('config-error', configError ? `The configuration file is not in force: ${configError}` : '');
  }

  #say(id, text) {
    const element = this.#at(id);
    if (element.textContent !== text) element.textContent = text;
  }

  #showFrames(frames) {
    let accounted = 0;
    for (const { key, element, count, fill } of this.#rows) {
      const value = frames[key] ?? 0;
      accounted += value;
      element.hidden = value === 0 && key !== 'fused';
      count.textContent = grouped(value);
      fill.style.width = `${(100 * value) / Math.max(frames.produced, 1)}%`;
    }
    const missing = frames.produced - accounted;
    const account = this.#at('frame-account');
    account.dataset.missing = missing;
    if (frames.produced === 0) this.#say('frame-account', 'No frames yet');
    else if (missing === 0) this.#say('frame-account', `${grouped(frames.produced)} frames, every one accounted for`);
    else this.#say('frame-account', `${grouped(frames.produced)} frames, ${grouped(missing)} unaccounted for`);
  }

  #showRecording({ active, bytes: written, recorded, dropped, disk_free_bytes: free, disk_floor_bytes: floor, reason }) {
    const lost = [[dropped.ir, 'without infrared'], [dropped.frames, 'dropped']].filter(([count]) => count > 0)
      .map(([count, what]) => `, ${grouped(count)} ${what}`).join('');
    const line = active ? `Recording: ${grouped(recorded)} frames, ${bytes(written)}${lost}.`
      : reason ? `Not recording: ${spelled(reason)}.` : 'Not recording.';
    this.#say('recording', line);
    const element = this.#at('recording');
    element.dataset.active = active;
    element.dataset.level = !active && reason ? 'bad' : dropped.ir + dropped.frames > 0 ? 'weak' : 'good';
    this.#showDisk(free, floor);
  }

  #showDisk(free, floor) {
    const isKnown = free !== null;
    this.#at('disk-gauge').hidden = !isKnown;
    this.#say('disk-words', isKnown ? `${bytes(free)} free on the disk, recording stops at ${bytes(floor)}` : '');
    if (!isKnown) return;
    const end = Math.max(GAUGE_FLOORS * floor, free, 1);
    this.#at('disk-gauge').dataset.level = free < floor ? 'bad' : free < 2 * floor ? 'weak' : 'good';
    this.#at('disk-gauge').setAttribute('aria-valuemax', end);
    this.#at('disk-gauge').setAttribute('aria-valuenow', free);
    this.#at('disk-fill').style.width = `${(100 * free) / end}%`;
    this.#at('disk-limit').style.left = `${(100 * floor) / end}%`;
  }
}

function row(key, words) {
  const element = document.createElement('tr');
  element.dataset.key = key;
  const [head, bar, count] = ['th', 'td', 'td'].map((tag) => document.createElement(tag));
  head.scope = 'row';
  head.textContent = words;
  bar.className = 'bar-cell';
  const fill = document.createElement('div');
  bar.append(fill);
  element.append(head, bar, count);
  return { key, element, count, fill };
}
