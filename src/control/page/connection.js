// The newest-only socket, kept open: reconnects with a growing wait, and polls the status where only previews are refused.

import * as api from './api.js';
import { decodePreview } from './wire.js';

const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 8000;
/** What says nothing for this long is taken for dead: the daemon sends its status several times a second, as an event once. */
const SILENCE_MS = 6000;

/**
 * Tells `on.status(status)`, `on.preview(message)`, and `on.state(state)`: `open`, `lost` (nothing answers) or
 * `polling` (the daemon answers, but gives this page no socket).
 */
export class Connection {
  #on;
  #socket = null;
  #wait = FIRST_WAIT_MS;
  #silence = 0;
  #retry = 0;
  #wantsPreviews = true;

  constructor(on) {
    this.#on = on;
    addEventListener('online', () => this.#retryNow());
  }

  open() {
    const socket = new WebSocket(api.socketAddress());
    socket.binaryType = 'arraybuffer';
    socket.onopen = () => this.#tellWish();
    socket.onmessage = ({ data }) => this.#take(socket, data);
    socket.onclose = () => this.#lose(socket);
    this.#socket = socket;
    this.#watchSilence(socket);
  }

  /** Whether previews are to be sent; a page that nobody looks at asks for none. */
  want(previews) {
    this.#wantsPreviews = previews;
    this.#tellWish();
  }

  #tellWish() {
    if (this.#socket?.readyState !== WebSocket.OPEN) return;
    this.#socket.send(JSON.stringify({ type: 'want', previews: this.#wantsPreviews }));
  }

  #take(socket, data) {
    if (socket !== this.#socket) return;
    this.#wait = FIRST_WAIT_MS;
    this.#watchSilence(socket);
    if (typeof data === 'string') {
      const message = JSON.parse(data);
      if (message.type !== 'status') return;
      this.#on.state('open');
      this.#on.status(message);
    } else {
      const preview = decodePreview(data);
      if (preview) this.#on.preview(preview);
    }
  }

  #watchSilence(socket) {
    clearTimeout(this.#silence);
    this.#silence = setTimeout(() => {
      socket.close();
      this.#lose(socket);
    }, SILENCE_MS);
  }

  #lose(socket) {
    if (socket !== this.#socket) return;
    this.#socket = null;
    clearTimeout(this.#silence);
    this.#pollOnce();
    // Half the wait is random, so that many pages do not come back in one moment.
    this.#retry = setTimeout(() => this.open(), this.#wait * (0.5 + 0.5 * Math.random()));
    this.#wait = Math.min(2 * this.#wait, LONGEST_WAIT_MS);
  }

  #retryNow() {
    if (this.#socket) return;
    clearTimeout(this.#retry);
    this.#wait = FIRST_WAIT_MS;
    this.open();
  }

  async #pollOnce() {
    try {
      const status = await api.status();
      this.#on.state('polling');
      this.#on.status(status);
    } catch {
      this.#on.state('lost');
    }
  }
}

/**
 * Tells `refused({command, reason})` of what the daemon took on and could not do, which is only told as an event. The stream is
 * open while the page is looked at: a browser has six connections for all its pages of one daemon, and each stream keeps one.
 */
export class Refusals {
  #refused;
  #stream = null;
  #silence = 0;

  constructor(refused) {
    this.#refused = refused;
  }

  /** Whether the stream is to be open. */
  want(isOpen) {
    if (isOpen === Boolean(this.#stream)) return;
    if (isOpen) this.#open();
    else this.#close();
  }

  #open() {
    this.#stream = new EventSource(api.eventsAddress);
    this.#stream.addEventListener('status', () => this.#watchSilence());
    this.#stream.addEventListener('loss', ({ data }) => this.#take(JSON.parse(data)));
    this.#watchSilence();
  }

  #close() {
    clearTimeout(this.#silence);
    this.#stream.close();
    this.#stream = null;
  }

  #take(event) {
    if (event.event === 'refused') this.#refused(event);
  }

  /** A browser opens a stream again that broke, but not one that was refused or fell silent. */
  #watchSilence() {
    clearTimeout(this.#silence);
    this.#silence = setTimeout(() => {
      this.#close();
      this.#open();
    }, SILENCE_MS);
  }
}
