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
export const jobs = () => ask('GET', '/jobs');

/** `label` is what the operator calls the scan; none if empty. */
export const start = (label) => ask('POST', '/scan', label ? { label } : {});
/** One of pause, resume, snapshot, refine, reset, finish, abandon. */
export const command = (name) => ask('POST', `/scan/${name}`);
export const undo = (secs) => ask('POST', '/scan/undo', { secs });
export const refineSession = (id) => ask('POST', `/sessions/${encodeURIComponent(id)}/refine`);
export const cancelJob = (job) => ask('POST', `/jobs/${encodeURIComponent(job)}/cancel`);

/** The daemon numbers the images of every scan alike; the scan in the address keeps a browser from showing another's. */
export const snapshotImage = (scanId, index) => `${ROOT}/scan/snapshots/${index}.png?scan=${encodeURIComponent(scanId)}`;
export const sessionFile = (id, name) => `${ROOT}/sessions/${encodeURIComponent(id)}/files/${name}`;
export const sessionMesh = (id, which) => `${ROOT}/sessions/${encodeURIComponent(id)}/mesh?which=${which}`;

/** Where an address leads: that of a finished scan's mesh leads elsewhere once the content is another. Tells nothing of refusals. */
export async function destination(address) {
  const { url } = await fetch(address, { method: 'HEAD' });
  return url;
}

/** A mesh of a finished scan, as bytes. */
export async function meshBytes(address) {
  const response = await fetch(address);
  if (!response.ok) throw await refusalOf(response);
  return response.arrayBuffer();
}

/** The growing mesh unless it is still the one with this tag: `{bytes, tag}`, or `null`. */
export async function newerMesh(lod, tag) {
  const headers = tag ? { 'If-None-Match': tag } : {};
  const response = await fetch(`${ROOT}/scan/mesh?lod=${lod}`, { headers, cache: 'no-store' });
  if (response.status === 304) return null;
  if (!response.ok) throw await refusalOf(response);
  return { bytes: await response.arrayBuffer(), tag: response.headers.get('ETag') };
}

async function refusalOf(response) {
  return new Refusal(response.status, parsed(await response.text()) ?? {});
}

/** Address of the stream of events. */
export const eventsAddress = `${ROOT}/events`;

/** Address of the newest-only socket. */
export function socketAddress() {
  const scheme = location.protocol === 'https:' ? 'wss:' : 'ws:';
  return `${scheme}//${location.host}${ROOT}/ws`;
}
