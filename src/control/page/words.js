// The daemon's states in the operator's words; what to do about them comes from the daemon as `advice`.

/** Title and tone. */
const STATES = {
  idle: ['Ready', 'quiet'],
  warming: ['Warming up', 'quiet'],
  tracking: ['Tracking', 'good'],
  degraded: ['Not at its best', 'weak'],
  lost: ['Lost', 'bad'],
  relocalising: ['Finding the place', 'weak'],
  paused: ['Paused', 'quiet'],
  snapshotting: ['Taking a shading image', 'good'],
  draining: ['Finishing', 'quiet'],
  fault: ['Fault', 'bad'],
};
const LOST = ['lost', 'relocalising'];
const REASONS = {
  too_fast: 'too fast',
  too_close: 'too close',
  too_far: 'too far',
  flat_scene: 'flat scene',
  few_inliers: 'little fits the model',
  saturated_infrared: 'infrared too bright',
  disk_low: 'disk nearly full',
  covered_lens: 'lens covered',
  elsewhere: 'looking elsewhere',
  device_stalled: 'camera is silent',
  device_gone: 'camera is gone',
  storage_failed: 'cannot write',
  program: 'fault of the program',
};

/** What the operator asked for and is not done. */
const REFUSED = {
  snapshot: 'No shading image',
  undo: 'Nothing is taken back',
  refine: 'Not refined',
};

/** What is done to a scan at its end, or when frames are taken back. */
const WORKS = {
  correct_depth: 'Correcting depth, frame',
  fuse_fragments: 'Closing loops, fragment',
  find_loops: 'Looking for loops, fragment',
  align_fragments: 'Closing loops, pair',
  close_loops: 'Closing loops, frame',
  fuse_whole: 'Completing the model, frame',
  separate_thin_parts: 'Separating thin parts, frame',
  take_back: 'Taking frames back, frame',
};

/** `{title, advice, tone}`, tone one of good, weak, bad, quiet. */
export function describeState({ state, reason, advice, improvement, refinement }) {
  const [title, tone] = STATES[state] ?? [spelled(state), 'quiet'];
  if (state === 'idle' && refinement.state === 'running') {
    return { title, advice: 'The last scan is being refined; the camera is free for another.', tone };
  }
  if (improvement) {
    const { work, done, of } = improvement;
    return { title, advice: `${WORKS[work] ?? spelled(work)} ${done} of ${of}`, tone };
  }
  const because = reason ? `: ${REASONS[reason] ?? spelled(reason)}` : '';
  return { title: title + because, advice: advice ?? '', tone };
}

/** Whether the camera is not where it was last. */
export function isLost(state) {
  return LOST.includes(state);
}

/** How a scan ended that did not end well. */
export function describeEnding({ id, label, state, failures }) {
  const scan = `The scan ${label ? `“${label}”` : id}`;
  if (state === 'interrupted') return `${scan} was interrupted: the daemon ended before it.`;
  return `${scan} failed: ${failures.join('; ')}`;
}

/** What the daemon took on and then could not do. */
export function describeRefusal({ command, reason }) {
  return `${REFUSED[command] ?? spelled(command)}: ${reason}`;
}

/** A stable code as words, where there are none of its own. */
export function spelled(code) {
  return code.replaceAll('_', ' ');
}

/** Bytes as 3 significant digits with a unit. */
export function bytes(count) {
  const units = ['B', 'kB', 'MB', 'GB', 'TB'];
  let value = count;
  let unit = 0;
  while (value >= 999.5 && unit < units.length - 1) {
    value /= 1000;
    unit += 1;
  }
  return `${unit === 0 ? value : Number(value.toPrecision(3))} ${units[unit]}`;
}

/** Thousands apart by thin spaces. */
export function grouped(count) {
  return String(count).replace(/\B(?=(\d{3})+$)/g, '\u2009');
}

/** A length of time in two units at most. */
export function duration(secs) {
  const whole = Math.round(secs);
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  return `${Math.floor(whole / 3600)} h ${Math.floor((whole % 3600) / 60)} min`;
}
