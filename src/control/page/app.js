// The page put together: what the daemon sends goes to the parts, what the operator presses goes to the daemon.
// The three-dimensional view is loaded after the first paint; without WebGL everything else still works.

import * as api from './api.js';
import { Connection, Refusals } from './connection.js';
import { Controls } from './controls.js';
import { Exports } from './exports.js';
import { Fitness } from './fitness.js';
import { Health } from './health.js';
import { Kinect1 } from './kinect1.js';
import { Previews } from './previews.js';
import { Refinement } from './refinement.js';
import { Snapshots } from './snapshots.js';
import { describeEnding, describeRefusal, describeState, isLost } from './words.js';

const PATH_INTERVAL_MS = 1000;
const TOAST_MS = 6000;
/** A sentence takes longer to read than a word. */
const TOAST_MS_PER_CHARACTER = 50;
const CONNECTION_WORDS = {
  lost: 'Connection lost. If the daemon runs, the scan goes on; trying again.',
  polling: 'The daemon answers but sends no pictures: too many pages are open. Trying again.',
};

const at = (id) => document.getElementById(id);
const previews = new Previews();
const fitness = new Fitness();
const snapshots = new Snapshots();
const kinect1 = new Kinect1();
const health = new Health();
const refinement = new Refinement(report);
const exported = new Exports((session) => stage?.compare(session));
const controls = new Controls({ report, export: () => exported.open() });
const connection = new Connection({ state: showConnection, status: showStatus, preview: showPreview });
const refusals = new Refusals((refused) => report({ message: describeRefusal(refused), code: `refused_${refused.command}` }));

let status = null;
let stage = null;
let sessionsKey = '';
let toastTimer = 0;

connection.open();
refusals.want(!document.hidden);
document.addEventListener('visibilitychange', () => {
  connection.want(!document.hidden);
  refusals.want(!document.hidden);
});
requestAnimationFrame(() => requestAnimationFrame(openStage));

async function openStage() {
  try {
    const { Stage } = await import('./stage.js');
    stage = new Stage(report);
    stage.offer(exported.newestRefined);
    at('scene-notice').hidden = true;
    if (status) stage.follow(status);
    setInterval(followPath, PATH_INTERVAL_MS);
  } catch (error) {
    at('scene-notice').textContent = 'This browser shows no three-dimensional view; everything else works.';
    console.warn('view:', error.message);
  }
}

function showStatus(next) {
  const before = status;
  status = next;
  if (before && next.daemon.version !== before.daemon.version) return location.reload();
  const hasRestarted = before && next.daemon.started_unix_ms !== before.daemon.started_unix_ms;
  const scanId = next.scan?.id ?? null;
  if (hasRestarted || (scanId && scanId !== (before?.scan?.id ?? null))) stage?.clear();

  const { title, advice, tone } = describeState(next);
  Object.assign(document.body.dataset, { state: next.state, reason: next.reason ?? '', phase: next.phase, tone });
  say('state-title', title);
  say('state-advice', advice);
  const name = next.scan ? scanName(next.scan) : '';
  say('device', name);
  at('device').title = name;
  fitness.show(next.fitness, isLost(next.state));
  previews.showSaturation(next.ir_saturated_share);
  snapshots.follow(scanId, next.snapshots);
  kinect1.show(next.kinect1_sequence);
  refinement.show(next);
  health.show(next);
  stage?.follow(next);
  followSessions(scanId);
  showControls();
}

function scanName({ label, device }) {
  const kinds = { kinect1: 'Kinect I', kinect2: 'Kinect II' };
  return [label, kinds[device.sensor] ?? device.sensor, device.serial].filter(Boolean).join(' · ');
}

function say(id, text) {
  if (at(id).textContent !== text) at(id).textContent = text;
}

function showPreview(preview) {
  if (preview.kind === 'pose') stage?.showPose(preview);
  else previews.show(preview);
}

function showConnection(state) {
  if (document.body.dataset.connection === state) return;
  document.body.dataset.connection = state;
  const banner = at('connection');
  banner.hidden = state === 'open';
  banner.textContent = CONNECTION_WORDS[state] ?? '';
  showControls();
  // Whatever ended meanwhile is looked for.
  if (state !== 'lost') sessionsKey = '';
}

function isReachable() {
  return ['open', 'polling'].includes(document.body.dataset.connection);
}

function showControls() {
  controls.show(isReachable() ? status : null, exported.newest, exported.sessions.length > 0);
}

async function followPath() {
  if (!stage || document.hidden || !status?.scan || !isReachable()) return;
  try {
    stage.showPath(await api.path());
  } catch {
    // The scan ended meanwhile, or the next second brings it.
  }
}

/**
 * Asks for the finished scans and the refinements when one may have been added or ended, and tells of a scan that did not end well.
 */
async function followSessions(scanId) {
  // A scan that is being started is on the list and not yet going on, as one that was interrupted.
  if (status.state === 'warming' && !scanId) return;
  const { state, job } = status.refinement;
  // The next job may run already when the end of one is told: the state is the same, and the job is not.
  const key = `${scanId}/${status.phase}/${job}/${state}/${status.refinements_waiting}`;
  if (key === sessionsKey) return;
  sessionsKey = key;
  try {
    const [ended] = await exported.refresh(scanId);
    showControls();
    stage?.offer(exported.newestRefined);
    refinement.queue(exported.waiting);
    if (ended) report({ message: describeEnding(ended), code: `scan_${ended.state}` });
  } catch {
    sessionsKey = '';
  }
}

/** Tells the operator of what was refused or went wrong. */
function report(error) {
  const toast = at('toast');
  toast.textContent = error.message;
  toast.dataset.code = error.code ?? '';
  toast.hidden = false;
  clearTimeout(toastTimer);
  toastTimer = setTimeout(forget, TOAST_MS + TOAST_MS_PER_CHARACTER * error.message.length);
}

/** Hides what was reported, once somebody could see it. */
function forget() {
  if (document.hidden) toastTimer = setTimeout(forget, TOAST_MS);
  else at('toast').hidden = true;
}
