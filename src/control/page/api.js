// The daemon's API: one function for each thing that the page does, refusals as `Refusal`.

const ROOT = '/api/v1';

/** What the daemon answered instead of doing it; `code` is stable, `message` is for the operator. */
export class Refusal extends Error {
  constructor(status, problem) {
    super(problem.detail || problem.title || `the daemon answered ${status}`);
    this.status = status;
    this.code = problem.code || 'unknown';
  }
}

async function ask(method, path, body) {
  const request = { method, headers: { Accept: 'application/json' } };
  if (body !== undefined) {
    request.headers['Content-Type'] = 'application/json';
    request.body = JSON.stringify(body);
  }
  const response = await fetch(ROOT + path, request);
  const text = await response.text();
  if (!response.ok) throw new Refusal(response.status, parsed(text) ?? {});
  return parsed(text);
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

export const status = () => ask('GET', '/status');
export const path = () => ask('GET', '/scan/path');
export const snapshots = () => ask('GET', '/scan/snapshots');
export const sessions = () => ask('GET', '/sessions');
export const session = (id) => ask('GET', `/sessions/${encodeURIComponent(id)}`);

export const start = () => ask('POST', '/scan', {});
/** One of pause, resume, snapshot, refine, reset, finish, abandon. */
export const command = (name) => ask('POST', `/scan/${name}`);
export const undo = (secs) => ask('POST', '/scan/undo', { secs });
export const refineSession = (id) => ask('POST', `/sessions/${encodeURIComponent(id)}/refine`);
export const cancelJob = (job) => ask('POST', `/jobs/${encodeURIComponent(job)}/cancel`);

export const snapshotImage = (index) => `${ROOT}/scan/snapshots/${index}.png`;
export const sessionFile = (id, name) => `${ROOT}/sessions/${encodeURIComponent(id)}/files/${name}`;
export const liveMesh = (lod) => `${ROOT}/scan/mesh?lod=${lod}`;
export const sessionMesh = (id, which) => `${ROOT}/sessions/${encodeURIComponent(id)}/mesh?which=${which}`;

/** The bytes of a mesh, or `null` where there is none yet. */
export async function meshBytes(address) {
  const response = await fetch(address, { cache: 'no-cache' });
  if (response.status === 404 || response.status === 204 || response.status === 409) return null;
  if (!response.ok) throw new Refusal(response.status, parsed(await response.text()) ?? {});
  return response.arrayBuffer();
}

/** Address of the newest-only socket. */
export function socketAddress() {
  const scheme = location.protocol === 'https:' ? 'wss:' : 'ws:';
  return `${scheme}//${location.host}${ROOT}/ws`;
}
