// The buttons. Which of them make sense follows from the state; the daemon has the last word, and its refusal is shown.

import * as api from './api.js';

const UNDO_SECS = 5;
const SCANNING = ['warming', 'tracking', 'degraded', 'lost', 'relocalising', 'paused', 'snapshotting'];
const RUNNING = SCANNING.filter((state) => state !== 'paused');
const HOLDING = ['tracking', 'degraded'];
/**
 * In which states, or for which reasons, a button can be pressed. In a fault a scan may go on, and can be ended; only without one
 * can another be started. What cannot be written keeps nothing else from being done.
 */
const ALLOWED = {
  start: ['idle', 'fault'],
  pause: [...RUNNING, 'storage_failed'],
  resume: ['paused'],
  snapshot: [...HOLDING, 'storage_failed'],
  undo: [...HOLDING, 'lost', 'relocalising', 'paused', 'storage_failed'],
  reset: [...SCANNING, 'fault'],
  stop: [...SCANNING, 'fault'],
};
/** What is said of a refinement that has ended when it is asked for. */
const ENDED = {
  done: () => 'It is refined with these settings already.',
  refused: (why) => `It was not refined with these settings: ${why}`,
};

export class Controls {
  #buttons = Object.fromEntries(
    ['start', 'pause', 'resume', 'snapshot', 'undo', 'refine', 'reset', 'stop', 'abandon', 'export']
      .map((name) => [name, document.getElementById(name)]),
  );
  #label = document.getElementById('label');
  #status = null;
  #lastSession = null;
  #hasFiles = false;
  #report;

  /** `on.report(error)` is told of refusals and of what need not be done, `on.export()` opens the list of files. */
  constructor(on) {
    this.#report = on.report;
    this.#bind('start', async () => {
      await api.start(this.#label.value.trim());
      this.#label.value = '';
    });
    for (const name of ['pause', 'resume', 'snapshot']) this.#bind(name, () => api.command(name));
    this.#bind('undo', () => api.undo(UNDO_SECS));
    this.#bind('refine', () => (this.#isScanning() ? api.command('refine') : this.#refineLast()));
    this.#bind('reset', async () => {
      const isMeant = await confirmed('Drop the model?', 'All that was scanned since the start is thrown away; the camera goes on.', 'Drop it');
      if (isMeant) await api.command('reset');
    });
    this.#bind('stop', () => api.command('finish'));
    this.#bind('abandon', async () => {
      const isMeant = await confirmed('Abandon the scan?', 'It stays as it is by now and is not refined. What finds no room on the disk is lost.', 'Abandon it');
      if (isMeant) await api.command('abandon');
    });
    this.#buttons.export.addEventListener('click', on.export);
    this.#update();
  }

  /**
   * `status`: `null` while the daemon does not answer. `lastSession`: the scan to refine when none goes on, `{id, …}` or `null`.
   * `hasFiles`: whether any can be had.
   */
  show(status, lastSession, hasFiles) {
    this.#status = status;
    this.#lastSession = lastSession;
    this.#hasFiles = hasFiles;
    this.#update();
  }

  /** What ended before with the same settings is not run again: the answer is all that tells of it. */
  async #refineLast() {
    const { state, message } = await api.refineSession(this.#lastSession.id);
    if (ENDED[state]) this.#report({ message: ENDED[state](message), code: `already_${state}` });
  }

  #isScanning() {
    const { state, scan, phase } = this.#status ?? {};
    return SCANNING.includes(state) || (state === 'fault' && Boolean(scan) && phase === 'capturing');
  }

  /** Whether the scan is being ended: its meshes are made and written, or wait for room. */
  #isEnding() {
    const { state, scan, phase } = this.#status ?? {};
    return Boolean(scan) && (state === 'draining' || phase !== 'capturing');
  }

  #isAllowed(name) {
    const { state, reason, scan } = this.#status ?? {};
    const fits = name === 'start' ? !scan : this.#isScanning();
    return [state, reason].some((told) => ALLOWED[name].includes(told)) && (state !== 'fault' || fits);
  }

  #update() {
    const state = this.#status?.state;
    // Before anything is disabled or hidden, which takes the focus away.
    const focused = document.activeElement;
    for (const name of Object.keys(ALLOWED)) this.#buttons[name].disabled = !this.#isAllowed(name);
    const canRefine = this.#isScanning() ? this.#status.snapshots.accepted > 0 : state === 'idle' && this.#lastSession !== null;
    this.#buttons.refine.disabled = !canRefine || ['waiting', 'running'].includes(this.#status.refinement.state);
    this.#buttons.export.disabled = !this.#status || !this.#hasFiles;
    const isEnding = this.#isEnding();
    this.#buttons.abandon.disabled = !isEnding;
    if (!state) return;
    document.getElementById('name').hidden = !this.#isAllowed('start');
    const shown = state === 'paused' ? 'resume' : this.#isScanning() || state === 'draining' ? 'pause' : 'start';
    for (const name of ['start', 'pause', 'resume']) this.#buttons[name].hidden = name !== shown;
    this.#buttons.stop.hidden = isEnding;
    this.#buttons.abandon.hidden = !isEnding;
    // Three buttons share a place, and two: the focus goes on to the one that takes it, or that there is to press.
    if (focused?.hidden && focused.closest('.toolbar')) this.#buttons[focused.id === 'stop' ? 'abandon' : shown].focus();
  }

  #bind(name, act) {
    const button = this.#buttons[name];
    button.addEventListener('click', async () => {
      if (button.ariaBusy === 'true') return;
      button.ariaBusy = 'true';
      try {
        await act();
      } catch (error) {
        this.#report(error);
      } finally {
        button.ariaBusy = 'false';
      }
    });
  }
}

/** Asks before something is lost; whether it was confirmed. */
function confirmed(title, text, yes) {
  const dialog = document.getElementById('confirm');
  document.getElementById('confirm-title').textContent = title;
  document.getElementById('confirm-text').textContent = text;
  document.getElementById('confirm-yes').textContent = yes;
  dialog.returnValue = 'cancel';
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener('close', () => resolve(dialog.returnValue === 'yes'), { once: true });
  });
}
