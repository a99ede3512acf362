// One scan of the stand-in: a state machine that time and commands drive.

const FRAMES_PER_SEC = 30;
const SCAN_SECS = 25;
/** When track is lost and comes back, seconds of scanning; seconds while the daemon keeps track do not count from when it gets weak. */
const LOSS = { weak: 7, lost: 8.5, relocalising: 11.5, found: 12.5 };
/** From when on fitness falls. */
const WEAKENING = LOSS.weak - 1.5;
const REJECTIONS = ['moving', 'saturated', 'nothing_new'];
const SCANNED_FILES = ['base.ply', 'trajectory.txt', 'report.html', 'report.json', 'events.jsonl'].map(file);
const REFINED_FILES = ['refined.ply', 'refined.glb'].map(file);
const ADVICE = {
  idle: 'Start a scan when the camera sees the object.',
  warming: 'Point the camera at the object and hold it still for a moment.',
  tracking: 'All is well: move slowly round the object.',
  degraded: 'Move and turn the camera more slowly.',
  lost: 'Go back to the last good pose and move more slowly.',
  relocalising: 'A place was recognised: hold still for a moment.',
  paused: 'The scan is paused: resume when the camera sees the object again.',
  snapshotting: 'Hold still until the picture is taken.',
  fault: 'Free room on the disk or end the scan.',
  draining: 'The scan has ended: its meshes are being written.',
};

function file(name) {
  return { name, bytes: name.endsWith('ply') ? 11_400_000 : 24_000 };
}

/** What a command was refused for. */
export class Refused extends Error {
  constructor(code, detail) {
    super(detail);
    this.code = code;
  }
}

export class StandInDaemon {
  sessions = [];
  /** Refinements, newest first. */
  jobs = [];
  /** Whether something of the scan cannot be written. */
  hasStorageFailed = false;
  /** Whether refinements begin; without room for their outputs they wait. */
  hasRoomToRefine = true;
  /** How long each refinement takes. */
  refineSecs = 6;
  /** Why refinements end without a mesh; `null` where they do not. */
  refusal = null;
  /** Whether what is refined again has other settings by then. */
  hasOtherSettings = true;
  /** Whether track is not lost yet, however long the scan goes on. */
  keepsTrack = false;
  #scan = null;
  /** How often each scan was refined, by its id; every time its mesh shows more. */
  refinements = new Map();
  #refinement = { state: 'none', started: 0, session: null, job: null };
  /** Scans that are refined next. */
  #waiting = [];
  version = '0.1.0';
  started = Date.now();
  #sensor;

  constructor(sensor = 'kinect2') {
    this.#sensor = sensor;
  }

  get scan() {
    return this.#scan;
  }

  start(label) {
    if (this.#scan) throw new Refused('already_scanning', 'a scan is going on');
    const id = this.#newId();
    this.#scan = { id, label, started: Date.now(), secs: 0, keptSecs: 0, isPaused: false, pausedFrames: 0, lostFrames: 0, snapshots: [], snapshotUntil: 0, drainUntil: 0 };
    return id;
  }

  command(name) {
    const scan = this.#scan;
    if (!scan) throw new Refused('not_scanning', 'no scan is going on');
    if (name === 'pause') {
      if (scan.isPaused) throw new Refused('already_paused', 'the scan is paused already');
      scan.isPaused = true;
    } else if (name === 'resume') scan.isPaused = false;
    else if (name === 'snapshot') this.#snapshot(true);
    else if (name === 'undo') scan.secs = Math.max(0, scan.secs - 1.5);
    else if (name === 'refine') this.#writeInterim();
    else if (name === 'reset') Object.assign(scan, { secs: 0, snapshots: [], mesh: null, revisionsBefore: this.mesh?.revision ?? 0 });
    else if (name === 'finish') scan.drainUntil = Date.now() + 1500;
    else if (name === 'abandon') this.#scan = null;
    else throw new Refused('unknown_command', `there is no command ${name}`);
  }

  /** The refinement that is to be; one that ended well or was refused, where that would end alike. */
  refine(session) {
    if (!session.files.some(({ name }) => name === 'base.ply')) throw new Refused('not_refinable', 'there is no base.ply');
    const before = this.jobs.find(({ scan }) => scan === session.id);
    if (!this.hasOtherSettings && ['done', 'refused'].includes(before?.state)) return before;
    const job = { id: `job-${session.id}`, scan: session.id, submitted_unix_ms: Date.now(), state: 'waiting', message: null };
    this.jobs.unshift(job);
    this.#waiting.push({ session, job });
    this.#refineNext();
    return job;
  }

  /** Begins the refinement that waits longest, if one can begin. */
  #refineNext() {
    if (this.#isRefining || !this.hasRoomToRefine || this.#waiting.length === 0) return;
    const { session, job } = this.#waiting.shift();
    job.state = 'running';
    this.#refinement = { state: 'running', started: Date.now(), session, job };
  }

  get #isRefining() {
    return this.#refinement.state === 'running';
  }

  /** Ends the refinement of this name, which waits or runs. */
  cancel(id) {
    const waiting = this.#waiting.find(({ job }) => job.id === id);
    if (waiting) {
      waiting.job.state = 'cancelled';
      this.#waiting = this.#waiting.filter((other) => other !== waiting);
      if (!this.#isRefining) this.#refinement = { state: 'cancelled', started: 0, ...waiting };
    } else if (this.#isRefining && this.#refinement.job.id === id) this.#endRefinement('cancelled');
    else throw new Refused('job_ended', 'the refinement is over');
  }

  /** Lets `secs` pass. */
  tick(secs) {
    const scan = this.#scan;
    if (scan && scan.drainUntil) {
      if (Date.now() > scan.drainUntil && !this.hasStorageFailed) this.#finish();
    } else if (scan) {
      const frames = secs * FRAMES_PER_SEC;
      if (scan.isPaused) scan.pausedFrames += frames;
      else {
        scan.secs += secs;
        if (this.keepsTrack) scan.keptSecs = Math.max(scan.keptSecs, scan.secs - WEAKENING);
        if (['lost', 'relocalising'].includes(this.state)) scan.lostFrames += frames;
        if (Math.floor(scan.secs / 1.2) > Math.floor((scan.secs - secs) / 1.2)) this.#snapshot(scan.snapshots.length % 4 !== 2);
      }
    }
    const { started, session, job } = this.#refinement;
    if (this.#isRefining && this.refusal) {
      job.message = this.refusal;
      this.#endRefinement('refused');
    } else if (this.#isRefining && Date.now() - started > 1000 * this.refineSecs) {
      this.refinements.set(session.id, 1 + (this.refinements.get(session.id) ?? 0));
      session.files = [...SCANNED_FILES, ...REFINED_FILES];
      this.#endRefinement('done');
    }
  }

  #endRefinement(state) {
    this.#refinement.state = state;
    this.#refinement.job.state = state;
    this.#refineNext();
  }

  #finish() {
    const { id, secs } = this.#scan;
    const hasMesh = secs > 0;
    const session = this.#session(id, {
      state: hasMesh ? 'complete' : 'failed', failures: hasMesh ? [] : ['no frame could be fused'],
      files: hasMesh ? [...SCANNED_FILES] : SCANNED_FILES.filter(({ name }) => name !== 'base.ply'),
    });
    this.sessions.push(session);
    this.#scan = null;
    if (hasMesh) this.refine(session);
  }

  /** What there is so far, as a session of its own, whose name is younger than the scan's. */
  #writeInterim() {
    const session = this.#session(this.#newId(), { interim_of: this.#scan.id });
    this.sessions.push(session);
    this.refine(session);
  }

  #session(id, more) {
    const { label, started } = this.#scan;
    return {
      id, label, interim_of: null, started_unix_ms: started, ended_unix_ms: Date.now(), state: 'complete', failures: [],
      files: [...SCANNED_FILES], ...more,
    };
  }

  #newId() {
    return `${new Date().toISOString().replace(/[-:]|\.\d+/g, '')}-${(this.sessions.length + 0x4f2a).toString(16)}`;
  }

  #snapshot(isAccepted) {
    const { snapshots } = this.#scan;
    const index = snapshots.length;
    const code = isAccepted ? null : REJECTIONS[index % REJECTIONS.length];
    const reason = isAccepted ? null : 'its figure stands here';
    const advice = isAccepted ? null : 'move more slowly past the relief';
    snapshots.push({ index, frame_id: this.frameId, accepted: isAccepted, code, reason, advice, has_image: true });
    this.#scan.snapshotUntil = Date.now() + 400;
  }

  /** Share of the object that was scanned; nothing is added while lost. */
  get progress() {
    const secs = this.#secsOfLoss;
    const held = Math.min(secs, LOSS.lost) + Math.max(0, secs - LOSS.found) + (this.#scan?.keptSecs ?? 0);
    return Math.min(1, 0.12 + held / SCAN_SECS);
  }

  get frameId() {
    return Math.floor((this.#scan?.secs ?? 0) * FRAMES_PER_SEC) + Math.floor(this.#scan?.pausedFrames ?? 0);
  }

  /** Seconds of scanning as of `LOSS`. */
  get #secsOfLoss() {
    return this.#scan ? this.#scan.secs - this.#scan.keptSecs : 0;
  }

  get isLost() {
    return ['lost', 'relocalising'].includes(this.state);
  }

  get state() {
    const scan = this.#scan;
    if (!scan) return 'idle';
    if (scan.drainUntil) return this.hasStorageFailed ? 'fault' : 'draining';
    if (scan.isPaused) return 'paused';
    if (scan.secs < 0.6) return 'warming';
    const secs = this.#secsOfLoss;
    if (secs > LOSS.relocalising && secs < LOSS.found) return 'relocalising';
    if (secs > LOSS.lost && secs < LOSS.found) return 'lost';
    if (this.hasStorageFailed) return 'fault';
    if (Date.now() < scan.snapshotUntil) return 'snapshotting';
    return secs > LOSS.weak && secs < LOSS.lost ? 'degraded' : 'tracking';
  }

  get #fitness() {
    const secs = this.#scan?.secs ?? 0;
    if (!this.#scan || this.#scan.isPaused || secs < 0.6) return null;
    const weak = this.#secsOfLoss - WEAKENING;
    const fall = weak > 0 && this.#secsOfLoss < LOSS.found ? Math.max(0, 1 - weak / 3) : 1;
    return Math.max(0.04, (0.86 + 0.05 * Math.sin(3 * secs)) * fall);
  }

  /** The mesh that was made last; like the daemon's it is made only while somebody asks for it. */
  get mesh() {
    return this.#scan?.mesh ?? null;
  }

  /** Makes a mesh for who asks, if one can be. */
  lookAtMesh() {
    const scan = this.#scan;
    if (!scan || scan.secs < 0.8) return null;
    const side = 170 * this.progress;
    const revision = 1 + (scan.revisionsBefore ?? 0) + Math.floor(scan.secs * 2);
    scan.mesh = { revision, vertices: Math.round(side * 170), faces: Math.round(2 * side * 170) };
    return scan.mesh;
  }

  get #sequence() {
    if (this.#sensor !== 'kinect1' || !this.#scan) return null;
    const step = ['track', 'hold_still', 'cover_projector', 'lamp_on', 'uncover'][Math.floor(this.#scan.secs / 2.5) % 5];
    return { step, speckle: ['lamp_on', 'uncover'].includes(step) ? 0.03 : 0.17, speckle_limit: 0.1 };
  }

  /** The refinement that runs, else the newest that waits, else the last one. */
  get #shownRefinement() {
    const waiting = this.#isRefining ? null : this.#waiting.at(-1);
    return waiting ? { state: 'waiting', started: 0, ...waiting } : this.#refinement;
  }

  get #refinementStatus() {
    const { state, started, session, job } = this.#shownRefinement;
    const share = Math.min(1, (Date.now() - started) / 1000 / this.refineSecs);
    const isKnown = state === 'running' || state === 'done';
    return {
      state, job: job?.id ?? null, scan: session?.id ?? null, round: isKnown ? [Math.min(4, 1 + Math.floor(4 * share)), 4] : [0, 0], step: isKnown ? Math.floor(28 * share) % 8 : 0,
      energy_share: isKnown ? 1 - 0.62 * share : null, rmse: state === 'done' ? 0.0182 : null, secs_left: state === 'running' ? this.refineSecs * (1 - share) : null, message: job?.message ?? null,
    };
  }

  get status() {
    const { state } = this;
    const scan = this.#scan;
    const paused = Math.floor(scan?.pausedFrames ?? 0);
    const lost = Math.floor(scan?.lostFrames ?? 0);
    const produced = this.frameId;
    const dropped = Math.floor((produced - paused) / 90);
    const inFlight = produced > 2 ? 2 : 0;
    const reasons = { degraded: 'too_fast', lost: 'too_fast', fault: 'storage_failed' };
    const accepted = scan?.snapshots.filter((snapshot) => snapshot.accepted).length ?? 0;
    return {
      state, reason: reasons[state] ?? null, advice: ADVICE[state],
      phase: scan ? (scan.drainUntil ? 'meshing' : 'capturing') : 'idle',
      improvement: scan?.drainUntil ? { work: 'correct_depth', done: 12, of: 120 } : null,
      scan: scan && { id: scan.id, label: scan.label, started_unix_ms: scan.started, device: { serial: 'stand-in-1', sensor: this.#sensor } },
      frames: { produced, fused: Math.max(0, produced - paused - lost - inFlight - dropped), lost, without_depth: 0, paused, damaged: 0, dropped, in_flight: inFlight },
      fps: scan ? 29.9 : 0, fitness: this.#fitness, ir_saturated_share: scan ? 0.011 : null,
      snapshots: { accepted, rejected: (scan?.snapshots.length ?? 0) - accepted, wanted: 36 },
      kinect1_sequence: this.#sequence, refinement: this.#refinementStatus, refinements_waiting: this.#waiting.length,
      recording: { active: Boolean(scan), bytes: produced * 260_000, recorded: produced, dropped: { ir: Math.floor(produced / 200), frames: 0 }, disk_free_bytes: 47e9, disk_floor_bytes: 2e9, reason: null },
      mesh: this.mesh, daemon: { version: this.version, started_unix_ms: this.started, uptime_secs: (Date.now() - this.started) / 1000, rss_bytes: 412e6, clients: 1, config_error: null },
    };
  }
}
