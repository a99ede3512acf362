// The newest-only socket, kept open: reconnects with a growing wait, and polls the status where only previews are refused.

import * as api from './api.js';
import { decodePreview } from './wire.js';

const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 8000;
/** A socket that says nothing for this long is taken for dead: the daemon sends its status several times a second. */
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
