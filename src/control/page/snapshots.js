// The strip of shading images, accepted and rejected, each with its reason.

import * as api from './api.js';
import { spelled } from './words.js';

/** Images kept in the strip; older ones are still counted. */
const SHOWN = 60;
const INTERVAL_MS = 1000;

export class Snapshots {
  #list = document.getElementById('snapshot-list');
  #count = document.getElementById('snapshot-count');
  #dial = document.getElementById('snapshot-dial');
  #shown = {};
  #askAgainAt = 0;

  /** `{accepted, rejected, wanted}` of the status; the list is fetched when the counts change. */
  async follow(scanId, { accepted, rejected, wanted }) {
    // After a scan its strip stays, until the next one begins.
    if (!scanId) return;
    this.#dial.max = Math.max(wanted, 1);
    this.#dial.value = Math.min(accepted, wanted);
    this.#count.textContent = accepted + rejected === 0 ? 'none yet' : `${accepted} of ${wanted}` + (rejected ? `, ${rejected} rejected` : '');
    this.#count.dataset.seen = accepted + rejected;
    // The daemon makes the list only while somebody asks, so the first answer may be an old one.
    const isShown = this.#shown.scanId === scanId && this.#shown.accepted === accepted && this.#shown.rejected === rejected;
    if (isShown || performance.now() < this.#askAgainAt) return;
    this.#askAgainAt = performance.now() + INTERVAL_MS;
    try {
      this.#fill(scanId, await api.snapshots());
    } catch (error) {
      if (error.code !== 'not_scanning') console.warn('shading images:', error.message);
    }
  }

  #fill(scanId, snapshots) {
    const accepted = snapshots.filter((snapshot) => snapshot.accepted).length;
    this.#shown = { scanId, accepted, rejected: snapshots.length - accepted };
    const wasAtEnd = this.#list.scrollWidth - this.#list.scrollLeft - this.#list.clientWidth < 40;
    const known = new Map([...this.#list.children].map((item) => [item.dataset.key, item]));
    const items = snapshots.slice(-SHOWN).map((snapshot) => {
      const key = `${scanId}/${snapshot.index}/${snapshot.accepted}`;
      return known.get(key) ?? tile(key, scanId, snapshot);
    });
    this.#list.replaceChildren(...items);
    if (wasAtEnd) this.#list.scrollLeft = this.#list.scrollWidth;
  }
}

function tile(key, scanId, { index, frame_id: frameId, accepted, code, reason, advice, has_image: hasImage }) {
  const item = document.createElement('li');
  item.dataset.key = key;
  item.dataset.accepted = accepted;
  const why = accepted ? 'accepted' : spelled(code ?? reason ?? 'rejected');
  if (hasImage) {
    const image = document.createElement('img');
    image.src = api.snapshotImage(scanId, index);
    image.loading = 'lazy';
    // A picture that is not there yet is asked for again when the list is made anew.
    image.addEventListener('error', () => {
      image.remove();
      item.dataset.key = '';
    });
    image.alt = `Infrared image of frame ${frameId}, ${why}`;
    item.append(image);
  }
  const caption = document.createElement('span');
  caption.textContent = accepted ? `frame ${frameId}` : why;
  item.append(caption);
  item.title = [`frame ${frameId}`, why, reason, advice].filter((part, i, parts) => part && parts.indexOf(part) === i).join(': ');
  return item;
}
