// A stand-in for the daemon: serves the page under the daemon's policy and answers the API with a moving, made-up scan.
// `node stand_in.mjs PORT [kinect1|kinect2]` to look at the page; the test starts it by itself.

import { createHash } from 'node:crypto';
import { readFile, readdir } from 'node:fs/promises';
import { createServer } from 'node:http';
import { fileURLToPath } from 'node:url';
import { WebSocketServer } from 'ws';
import { grey } from './png.mjs';
import { Refused, StandInDaemon } from './scan.mjs';
import { meshBytes, pathPose, poseMessage, previewMessage } from './scan_model.mjs';

const PAGE = new URL('../../src/control/page/', import.meta.url);
const TYPES = { html: 'text/html; charset=utf-8', js: 'text/javascript', css: 'text/css', svg: 'image/svg+xml', three: 'text/plain' };
const HEADERS = {
  'Content-Security-Policy': "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
  'X-Content-Type-Options': 'nosniff',
};
const SIDES = { preview: 170, full: 450 };
const EVENTS = '/api/v1/events';
const COMMAND = /^\/api\/v1\/scan\/(pause|resume|snapshot|undo|refine|reset|finish|abandon)$/;
const SESSION_MESH = /^\/api\/v1\/sessions\/([^/]+)\/mesh$/;
const MESH = /^\/api\/v1\/meshes\/(base|refined|difference)-(\d+)$/;
const SESSION_FILE = /^\/api\/v1\/sessions\/([^/]+)\/files\/([a-z.]+)$/;
const SESSION_REFINE = /^\/api\/v1\/sessions\/([^/]+)\/refine$/;
const JOB_CANCEL = /^\/api\/v1\/jobs\/([^/]+)\/cancel$/;

/** Starts it; `close()` also cuts the sockets, so that the page sees the daemon go. */
export async function standIn({ port = 0, sensor = 'kinect2' } = {}) {
  const daemon = new StandInDaemon(sensor);
  const assets = new Set(await readdir(PAGE));
  const server = createServer((request, response) => {
    if (request.url === EVENTS) follow(response);
    else answer(daemon, assets, request, response).catch((error) => refuse(response, error));
  });
  const sockets = new WebSocketServer({ server, path: '/api/v1/ws' });
  const wishes = new Map();
  sockets.on('connection', (socket) => {
    wishes.set(socket, true);
    socket.on('message', (text) => wishes.set(socket, JSON.parse(text).previews));
    socket.on('close', () => wishes.delete(socket));
  });
  const streams = new Set();
  const say = (topic, data) => {
    for (const stream of streams) stream.write(`event: ${topic}\ndata: ${JSON.stringify(data)}\n\n`);
  };
  const follow = (response) => {
    response.writeHead(200, { ...HEADERS, 'Content-Type': 'text/event-stream', 'Cache-Control': 'no-cache' });
    response.on('close', () => streams.delete(response));
    streams.add(response);
    say('status', daemon.status);
  };
  const events = setInterval(() => say('status', daemon.status), 1000);
  const ticks = setInterval(() => daemon.tick(0.05), 50);
  const statuses = setInterval(() => tell(sockets, JSON.stringify({ type: 'status', ...daemon.status })), 200);
  const previews = setInterval(() => sendPreviews(daemon, wishes), 100);
  await new Promise((resolve) => server.listen(port, '127.0.0.1', resolve));
  return {
    daemon,
    /** Tells an event to whoever follows them. */
    say,
    /** How many follow them. */
    get nStreams() {
      return streams.size;
    },
    port: server.address().port,
    base: `http://127.0.0.1:${server.address().port}`,
    async close() {
      for (const timer of [ticks, statuses, previews, events]) clearInterval(timer);
      for (const socket of sockets.clients) socket.terminate();
      server.closeAllConnections();
      await new Promise((resolve) => server.close(resolve));
    },
  };
}

function tell(sockets, text) {
  for (const socket of sockets.clients) socket.send(text);
}

function sendPreviews(daemon, wishes) {
  const { progress, frameId } = daemon;
  if (!daemon.scan || ![...wishes.values()].includes(true)) return;
  const isLost = daemon.isLost;
  const messages = [previewMessage(1, frameId, progress), previewMessage(2, frameId, progress), poseMessage(frameId, progress, progress, isLost)];
  for (const [socket, wantsPreviews] of wishes) {
    if (wantsPreviews && socket.bufferedAmount < 1e6) messages.forEach((message) => socket.send(message));
  }
}

async function answer(daemon, assets, request, response) {
  const { pathname, searchParams } = new URL(request.url, 'http://stand-in');
  const asset = pathname === '/' ? 'index.html' : pathname.replace('/assets/', '');
  if (request.method === 'GET' && assets.has(asset)) return send(response, 200, TYPES[asset.split('.').pop()], await readFile(new URL(asset, PAGE)));
  const finished = (id) => daemon.sessions.find((session) => session.id === id);
  const reads = {
    '/api/v1/status': () => daemon.status,
    '/api/v1/sessions': () => daemon.sessions,
    '/api/v1/jobs': () => daemon.jobs,
    '/api/v1/scan/snapshots': () => daemon.scan?.snapshots ?? [],
    '/api/v1/scan/path': () => path(daemon),
  };
  if (request.method === 'GET' && reads[pathname]) return send(response, 200, 'application/json', JSON.stringify(reads[pathname]()));
  if (pathname === '/api/v1/scan/mesh') {
    if (!daemon.scan) throw new Refused('not_scanning', 'no scan is going on');
    const made = daemon.lookAtMesh();
    if (!made) throw new Refused('no_mesh', 'there is no mesh yet; one is made while somebody asks');
    const { revision } = made;
    return mesh(request, response, { side: SIDES[searchParams.get('lod')], progress: daemon.progress, revision });
  }
  const nRefined = daemon.refinements.get(pathname.match(SESSION_MESH)?.[1]);
  if (nRefined) {
    const which = searchParams.get('which');
    response.setHeader('Location', `/api/v1/meshes/${which}-${which === 'base' ? 0 : nRefined}`);
    response.setHeader('Cache-Control', 'no-cache');
    return send(response, 302, 'text/plain', '');
  }
  if (MESH.test(pathname)) {
    const [, which, detail] = pathname.match(MESH);
    response.setHeader('Cache-Control', 'private, max-age=31536000, immutable');
    if (request.method === 'HEAD') return send(response, 200, 'application/octet-stream', '');
    return mesh(request, response, { side: SIDES.full, progress: 2, detail: Number(detail), difference: which === 'difference' });
  }
  if (SESSION_FILE.test(pathname)) {
    const [, id, name] = pathname.match(SESSION_FILE);
    if (finished(id)?.files.some((file) => file.name === name)) return send(response, 200, 'application/octet-stream', `${name} of ${id}\n`);
  }
  if (/^\/api\/v1\/scan\/snapshots\/\d+\.png$/.test(pathname)) return send(response, 200, 'image/png', thumbnail(daemon));
  if (request.method === 'POST') return act(daemon, request, pathname, finished, response);
  throw new Refused('not_found', `there is nothing at ${pathname}`);
}

async function act(daemon, request, pathname, finished, response) {
  const done = (body = {}) => send(response, 202, 'application/json', JSON.stringify(body));
  if (pathname === '/api/v1/scan') {
    const { label = null } = JSON.parse(Buffer.concat(await request.toArray()).toString());
    return send(response, 201, 'application/json', JSON.stringify({ id: daemon.start(label) }));
  }
  if (COMMAND.test(pathname)) {
    daemon.command(pathname.match(COMMAND)[1]);
    return done();
  }
  const session = finished(pathname.match(SESSION_REFINE)?.[1]);
  if (session) return done(daemon.refine(session));
  if (JOB_CANCEL.test(pathname)) {
    daemon.cancel(pathname.match(JOB_CANCEL)[1]);
    return done();
  }
  throw new Refused('not_found', `there is nothing at ${pathname}`);
}

function path(daemon) {
  const { progress } = daemon;
  const poses = Array.from({ length: 200 }, (_, i) => pathPose((progress * i) / 199));
  const next = progress < 0.95 ? { pose: pathPose(progress + 0.2), why: 'The right side of the medallion lacks light from the left.' } : null;
  return { poses, last_good: pathPose(progress), next };
}

function thumbnail(daemon) {
  const message = previewMessage(2, 0, daemon.progress);
  return grey(256, 212, message.subarray(24));
}

function mesh(request, response, wish) {
  const tag = `"${createHash('sha256').update(JSON.stringify(wish)).digest('hex')}"`;
  if (request.headers['if-none-match'] === tag) return send(response, 304, 'application/octet-stream', '');
  response.setHeader('ETag', tag);
  response.setHeader('X-Mesh-Revision', wish.revision ?? 1);
  return send(response, 200, 'application/octet-stream', meshBytes(wish));
}

function send(response, status, type, body) {
  response.writeHead(status, { ...HEADERS, 'Content-Type': type });
  response.end(body);
}

function refuse(response, error) {
  const status = error instanceof Refused ? (['not_found', 'no_mesh'].includes(error.code) ? 404 : 409) : 500;
  const problem = { type: 'about:blank', title: error.message, status, detail: error.message, code: error.code ?? 'internal' };
  send(response, status, 'application/problem+json', JSON.stringify(problem));
}

if (process.argv[1] === fileURLToPath(import.meta.url)) {
  const { base } = await standIn({ port: Number(process.argv[2] ?? 8047), sensor: process.argv[3] });
  console.log(base);
}
