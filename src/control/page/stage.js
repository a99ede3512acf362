// The view with what stands around it: its modes, options, legend, and the hint where to go next.

import { COVERAGE, drawBar } from './colour.js';
import { Compare } from './compare.js';
import { LiveMesh } from './live_mesh.js';
import { View } from './scene.js';
import { turnLight } from './surface.js';
import { isLost } from './words.js';

const LIVE = { mode: 'live', sessionId: null };
const COVERAGE_LEGEND = { stops: COVERAGE, ticks: ['needs views', 'enough'] };

export class Stage {
  #section = document.querySelector('[data-testid=stage]');
  #modes = [...document.querySelectorAll('.segments button')];
  #coverage = document.getElementById('coverage');
  #hint = document.getElementById('hint');
  #why = '';
  #isLost = false;
  #hasScan = false;
  #offeredId = null;
  /** What is in the view, and what was asked for last: another while its meshes come. */
  #shown = LIVE;
  #wanted = LIVE;
  #view;
  #live;
  #compare;
  #report;

  /** Throws if the browser has no WebGL; `report(error)` is told of meshes that do not come. */
  constructor(report) {
    this.#report = report;
    const notice = document.getElementById('scene-notice');
    this.#view = new View(document.getElementById('scene'), (text) => {
      notice.textContent = text;
      notice.hidden = text === '';
    });
    this.#live = new LiveMesh(this.#view, ({ revision, nFaces, lod, coverage }) => {
      Object.assign(this.#section.dataset, { revision, faces: nFaces, lod, coverage: coverage.toFixed(3) });
      document.getElementById('coverage-share').textContent = `${Math.round(100 * coverage)} %`;
    });
    this.#compare = new Compare(this.#view);
    this.#view.onMoving = (isMoving) => {
      this.#live.moving = isMoving;
      this.#compare.moving = isMoving;
    };
    this.#listen();
    this.#paint();
  }

  #listen() {
    for (const button of this.#modes) button.addEventListener('click', () => this.#switch(button.dataset.mode));
    document.getElementById('fit').addEventListener('click', () => this.#view.fit());
    this.#coverage.addEventListener('change', () => this.#paint());
    document.getElementById('light').addEventListener('input', ({ target }) => {
      turnLight(Number(target.value));
      this.#view.request();
    });
  }

  /** The newest status of the daemon. */
  follow({ scan, state }) {
    this.#setLost(scan !== null && isLost(state));
    if (scan) this.#view.markers.sensor = scan.device.sensor;
    else if (this.#hasScan) this.#forgetCamera();
    this.#hasScan = Boolean(scan);
    if (scan && this.#view.mode === 'live') this.#live.follow();
  }

  /** Forgets the model: another scan began. */
  clear() {
    this.#live.clear();
    document.getElementById('coverage-share').textContent = '';
    this.#forgetCamera();
    if (this.#wanted !== LIVE) this.#switch('live');
  }

  /** The finished scan to compare unless another is chosen, or `null`. */
  offer(session) {
    this.#offeredId = session?.id ?? null;
    for (const button of this.#modes) button.disabled = button.dataset.mode !== 'live' && !session;
  }

  /** Shows the meshes of a scan that the operator chose. */
  compare(session) {
    return this.#switch('compare', session.id);
  }

  showPose(pose) {
    this.#view.markers.showPose(pose);
    this.#view.keepInView();
    this.#view.request();
  }

  showPath(path) {
    this.#view.markers.showPath(path);
    this.#why = path.next?.why ?? '';
    this.#showHint();
    this.#view.request();
  }

  #setLost(isLost) {
    if (isLost === this.#isLost) return;
    this.#isLost = isLost;
    this.#view.markers.isLost = isLost;
    this.#showHint();
    this.#view.request();
  }

  #forgetCamera() {
    this.#view.markers.clear();
    this.#setLost(false);
    this.#why = '';
    this.#showHint();
    this.#view.request();
  }

  /** What the coloured cameras in the view mean. */
  #showHint() {
    const text = this.#isLost ? 'Red: where the camera was tracked last. Bring it back there.' : this.#why;
    this.#hint.textContent = text;
    this.#hint.dataset.tone = this.#isLost ? 'bad' : 'good';
    this.#hint.hidden = text === '';
  }

  /** Modes share a scan until the view is live again, whatever else is offered meanwhile. */
  async #switch(mode, sessionId = this.#wanted.sessionId ?? this.#offeredId) {
    const wanted = mode === 'live' ? LIVE : { mode, sessionId };
    this.#wanted = wanted;
    if (wanted === LIVE || await this.#load(wanted)) this.#show(wanted);
  }

  /** Whether the meshes that are wanted came, and nothing else was asked for since. */
  async #load(wanted) {
    try {
      const meshes = await this.#compare.fetch(wanted.sessionId);
      if (meshes && wanted === this.#wanted) this.#compare.take(meshes);
    } catch (error) {
      if (wanted !== this.#wanted) return false;
      this.#wanted = this.#shown;
      this.#report(error);
    }
    return wanted === this.#wanted;
  }

  #show(wanted) {
    const { mode, sessionId } = wanted;
    this.#shown = wanted;
    if (sessionId) this.#section.dataset.compared = sessionId;
    this.#section.dataset.mode = mode;
    for (const button of this.#modes) button.setAttribute('aria-pressed', button.dataset.mode === mode);
    this.#compare.showDivider(mode === 'compare');
    this.#view.show(mode);
    this.#paint();
  }

  #paint() {
    const { mode } = this.#view;
    this.#view.surfaces.live.painted = this.#coverage.checked;
    document.getElementById('coverage-option').hidden = mode !== 'live';
    const isPainted = mode === 'difference' || (mode === 'live' && this.#coverage.checked);
    document.getElementById('legend').hidden = !isPainted;
    if (isPainted) showLegend(mode === 'difference' ? this.#compare.legend : COVERAGE_LEGEND);
    this.#view.request();
  }
}

function showLegend({ stops, ticks }) {
  drawBar(document.getElementById('legend-bar'), stops);
  document.getElementById('legend-ticks').replaceChildren(...ticks.map((text) => {
    const tick = document.createElement('span');
    tick.textContent = text;
    return tick;
  }));
}
