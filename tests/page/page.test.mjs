// The live page in a real browser. By default against the stand-in; against a daemon with RELIEF_PAGE_URL=http://127.0.0.1:8047,
// which has to replay a recording that loses track once (with `--repeat` the jump back to its start does).

import { strict as assert } from 'node:assert';
import { after, before, test } from 'node:test';
import { DESKTOP, PHONE, assertClean, changes, comesTo, count, differing, holdBack, launch, look, openPage, rises, save, shows, state } from './browser.mjs';
import { standIn } from './stand_in.mjs';

const DAEMON = process.env.RELIEF_PAGE_URL;
/** As long as one may be. */
const LABEL = 'a name of a scan '.repeat(12).slice(0, 200).trim();
const NEEDS_STAND_IN = DAEMON ? 'needs the stand-in' : false;
const SCANNING = ['tracking', 'degraded'];
const STAGE = '[data-testid=stage]';

const isLit = ([red, green, blue]) => red + green + blue > 280;
const isPaint = ([red, green, blue]) => Math.max(red, green, blue) - Math.min(red, green, blue) > 50;
const isGhost = ([red, green, blue]) => red > 190 && green < 150 && blue < 140 && red - green > 80;
const isBlue = ([red, , blue]) => blue - red > 30;
const isRed = ([red, , blue]) => red - blue > 50;

let browser;
let server;
let base;

before(async () => {
  server = DAEMON ? null : await standIn();
  base = DAEMON ?? server.base;
  browser = await launch();
});

after(async () => {
  await browser?.close();
  await server?.close();
});

test('a whole session', { timeout: 600_000 }, async (t) => {
  const opened = await openPage(t, browser, base);
  const { page } = opened;
  const button = (name) => page.getByTestId(name);

  await t.test('is idle and offers to start', async () => {
    assert.equal(await page.getByTestId('state-title').innerText(), 'Ready');
    assert.ok(await button('start').isEnabled());
    for (const name of ['snapshot', 'undo', 'reset', 'stop']) assert.ok(await button(name).isDisabled(), name);
  });

  await t.test('tracks, and the mesh and its coverage grow', async () => {
    // Until it is looked whether the page says so, which a busy machine comes to late.
    if (!DAEMON) server.daemon.keepsTrack = true;
    await page.getByTestId('label').fill('Medallion');
    await button('start').click();
    await state(page, ...SCANNING);
    assert.match(await page.getByTestId('device').innerText(), /^Medallion · Kinect/);
    await rises(page, STAGE, 'faces', 0);
    const faces = await rises(page, '#health-mesh', 'faces', 0);
    await rises(page, '#health-mesh', 'faces', faces);
    // Of a daemon's first mesh some is covered already, and what comes into view later is not.
    await rises(page, STAGE, 'coverage', DAEMON ? 0 : Number(await page.locator(STAGE).getAttribute('data-coverage')));
    assert.ok(await page.locator('#fitness-ring').getAttribute('aria-valuenow') > 0);
    await rises(page, '#depth', 'frame', 0);
    await rises(page, '#ir', 'frame', 0);
  });

  await t.test('paints coverage, and plaster without it', async () => {
    const painted = await look(page);
    assert.ok(count(painted, isLit) > 500, 'the mesh is in view');
    await page.getByTestId('coverage').uncheck();
    await page.waitForTimeout(300);
    const plain = await look(page);
    await page.getByTestId('coverage').check();
    assert.ok(count(painted, isPaint) > 2 * count(plain, isPaint), 'colours come from the paint');
    await save(page, 'tracking');
  });

  await t.test('takes a shading image', async () => {
    const seen = Number(await page.getByTestId('snapshot-count').getAttribute('data-seen'));
    await button('snapshot').click();
    await rises(page, '#snapshot-count', 'seen', seen);
    assert.ok(await page.getByTestId('toast').isHidden(), 'it was not refused');
    await page.locator('#snapshot-list li[data-accepted=true] img').first().waitFor();
  });

  await t.test('pauses without fusing, and resumes', async () => {
    const fused = () => page.locator('#frame-table tr[data-key=fused] td').last().innerText();
    await button('pause').click();
    await state(page, 'paused');
    await page.waitForTimeout(1000);
    const before = await fused();
    await page.waitForTimeout(1000);
    assert.equal(await fused(), before);
    await button('resume').click();
    await state(page, ...SCANNING, 'lost', 'relocalising');
  });

  await t.test('says that track is lost, shows the ghost, and finds back', async () => {
    // Of a daemon's recording the place may be found at once.
    const isFinding = DAEMON ? null : await comesTo(page, 'body', 'relocalising', { '#fitness-words': 'lost' });
    if (!DAEMON) server.daemon.keepsTrack = false;
    await state(page, 'lost');
    assert.match(await page.getByTestId('state-title').innerText(), /^Lost/);
    assert.notEqual(await page.getByTestId('state-advice').innerText(), '');
    await page.getByTestId('hint').getByText('Red:').waitFor();
    await shows(page, isGhost, 20, 'the ghost is drawn');
    await save(page, 'lost');
    await isFinding?.();
    await state(page, ...SCANNING);
  });

  await t.test('takes back the last seconds', async () => {
    await button('undo').click();
    await page.waitForTimeout(500);
    assert.ok(await page.getByTestId('toast').isHidden());
  });

  await t.test('accounts for every frame', async () => {
    assert.equal(await page.getByTestId('frame-account').getAttribute('data-missing'), '0');
  });

  await t.test('stops, and refines', async () => {
    await button('stop').click();
    if (!DAEMON) await page.getByTestId('state-advice').getByText('Correcting depth, frame 12 of 120').waitFor();
    await state(page, 'idle');
    await page.waitForFunction(() => document.getElementById('refinement').dataset.state === 'running', null, { timeout: 120_000 });
    await page.locator('#refinement-round').getByText(/^\d of \d$/).waitFor({ timeout: 120_000 });
    await save(page, 'refining');
    await page.waitForFunction(() => document.getElementById('refinement').dataset.state === 'done', null, { timeout: 300_000 });
  });

  await t.test('wipes between the meshes', async () => {
    await page.locator('#mode-compare:enabled').click();
    await page.locator(`${STAGE}[data-compared][data-mode=compare]`).waitFor({ timeout: 60_000 });
    const wiped = async (share) => {
      await page.getByTestId('wipe').fill(String(1000 * share));
      await page.waitForTimeout(1500);
      return look(page);
    };
    const mostlyBase = await wiped(0.9);
    const mostlyRefined = await wiped(0.1);
    const column = (share) => Math.round(share * mostlyBase.width);
    assert.ok(differing(mostlyBase, mostlyRefined, column(0.15), column(0.85)) > 0.01, 'the refined mesh shows more');
    assert.equal(differing(mostlyBase, mostlyRefined, 0, column(0.08)), 0, 'left of the border both are the fused mesh');
    await page.getByTestId('wipe').press('ArrowRight');
    assert.equal(await page.getByTestId('wipe').inputValue(), '120');
    await wiped(0.5);
    await save(page, 'compare');
  });

  await t.test('shows the difference in millimetres', async () => {
    await page.locator('#mode-difference').click();
    await page.locator(`${STAGE}[data-mode=difference]`).waitFor();
    await page.waitForTimeout(1500);
    assert.match(await page.getByTestId('legend').innerText(), /−[\d.]+ mm[^]*\+[\d.]+ mm/);
    const view = await look(page);
    assert.ok(count(view, isBlue) > 50 && count(view, isRed) > 50, 'both directions are coloured');
    await save(page, 'difference');
  });

  await t.test('exports', async () => {
    await button('export').click();
    const links = page.getByTestId('export-files').locator('a');
    const names = await links.evaluateAll((all) => all.map((link) => link.dataset.file));
    for (const name of ['base.ply', 'refined.ply', 'report.html']) assert.ok(names.includes(name), name);
    const [download] = await Promise.all([page.waitForEvent('download'), links.and(page.locator('[data-file="trajectory.txt"]')).click()]);
    assert.match(download.suggestedFilename(), /trajectory\.txt$/);
    assert.equal(await download.failure(), null);
    assert.match(await page.getByTestId('export-session').locator('option').first().innerText(), /^Medallion \(/);
    await page.getByTestId('export-show').click();
    await page.locator(`${STAGE}[data-mode=compare]`).waitFor();
  });

  assertClean(opened);
});

test('keeps scans apart, and refinements of one', { timeout: 300_000, skip: NEEDS_STAND_IN }, async (t) => {
  const server = await standIn();
  t.after(() => server.close());
  const opened = await openPage(t, browser, server.base);
  const { page } = opened;
  const press = (name) => page.getByTestId(name).click();
  const refinement = (told) => page.locator(`#refinement[data-state=${told}]`).waitFor({ timeout: 60_000 });
  const compared = (mode, { id }) => page.locator(`${STAGE}[data-mode=${mode}][data-compared="${id}"]`).waitFor({ timeout: 60_000 });
  const { sessions } = server.daemon;

  await t.test('shows the shading images of each', async () => {
    for (const name of ['first', 'second']) {
      await page.getByTestId('label').fill(name);
      await press('start');
      await state(page, ...SCANNING);
      await page.locator(`#snapshot-list img[src$="/0.png?scan=${server.daemon.scan.id}"]`).waitFor();
      await press('stop');
      await state(page, 'idle');
    }
  });

  await t.test('offers the first while the second is refined', async () => {
    await page.locator('#mode-compare:enabled').waitFor();
    assert.equal(await page.locator('#refinement').getAttribute('data-state'), 'running');
    await refinement('done');
  });

  await t.test('keeps to the scan that was chosen until the view is live again', async () => {
    const [first, second] = sessions;
    const release = await holdBack(page, /mesh\?which=difference$/);
    await press('export');
    await page.getByTestId('export-session').selectOption(first.id);
    await press('export-show');
    // The newest scan is offered anew, while the meshes of the chosen one come and after that.
    await Promise.all([page.waitForResponse(/\/sessions$/), press('refine')]);
    await refinement('running');
    release();
    await compared('compare', first);
    await refinement('done');
    await page.locator('#mode-difference').click();
    await compared('difference', first);
    await page.locator('#mode-live').click();
    await page.locator('#mode-difference').click();
    await compared('difference', second);
  });

  await t.test('shows what was refined last', async () => {
    await page.waitForTimeout(1500);
    const before = await look(page);
    await press('refine');
    await refinement('running');
    await refinement('done');
    await Promise.all([page.waitForResponse(/meshes\/difference-3$/), page.locator('#mode-difference').click()]);
    await changes(page, before, 0.01, 'there is more of a difference');
  });

  await t.test('stays live if that was asked for while meshes came', async () => {
    const release = await holdBack(page, /mesh\?which=difference$/);
    await page.locator('#mode-live').click();
    await page.locator('#mode-compare').click();
    await page.locator('#mode-live').click();
    await Promise.all([page.waitForResponse(/meshes\/difference-3$/), release()]);
    await page.waitForTimeout(1000);
    assert.equal(await page.locator(STAGE).getAttribute('data-mode'), 'live');
  });

  assertClean(opened);
});

test('goes by the last good scan, and tells of one that failed', { timeout: 300_000, skip: NEEDS_STAND_IN }, async (t) => {
  const server = await standIn();
  t.after(() => server.close());
  const opened = await openPage(t, browser, server.base);
  const { page } = opened;
  const press = (name) => page.getByTestId(name).click();
  const compared = ({ id }) => page.locator(`${STAGE}[data-mode=compare][data-compared="${id}"]`).waitFor({ timeout: 60_000 });
  const asked = () => page.waitForRequest(/\/sessions\/[^/]+\/refine$/);
  const { sessions } = server.daemon;
  let whole;

  await t.test('compares what was refined on the way, and then the whole', async () => {
    await page.getByTestId('label').fill('bowl');
    await press('start');
    await page.locator('#snapshot-list img').first().waitFor();
    const { id } = server.daemon.scan;
    await press('refine');
    await page.locator('#refinement[data-state=done]').waitFor({ timeout: 60_000 });
    await page.locator('#mode-compare:enabled').click();
    await compared(sessions[0]);
    await page.locator('#mode-live').click();
    const refinesAgain = await comesTo(page, '#refinement', 'running');
    await press('stop');
    await state(page, 'idle');
    whole = sessions.find((session) => session.id === id);
    assert.equal(sessions[0].interim_of, id);
    assert.ok(sessions[0].id > id, 'its name is younger');
    await refinesAgain();
    await page.locator('#refinement[data-state=done]').waitFor({ timeout: 60_000 });
    await page.locator('#mode-compare:enabled').click();
    await compared(whole);
    await press('export');
    const options = page.getByTestId('export-session').locator('option');
    assert.deepEqual(await options.allInnerTexts(), [`bowl (${id})`, `bowl (${sessions[0].id}), on the way`]);
    await page.keyboard.press('Escape');
  });

  await t.test('refines the whole again', async () => {
    const refinesAgain = await comesTo(page, '#refinement', 'running');
    const [request] = await Promise.all([asked(), press('refine')]);
    assert.ok(request.url().includes(whole.id));
    await refinesAgain();
    await page.locator('#refinement[data-state=done]').waitFor({ timeout: 60_000 });
  });

  await t.test('says that it is refined already where the settings are the same', async () => {
    server.daemon.hasOtherSettings = false;
    await press('refine');
    const toast = page.locator('[data-testid=toast][data-code=already_done]');
    await toast.waitFor();
    assert.equal(await toast.innerText(), 'It is refined with these settings already.');
    server.daemon.hasOtherSettings = true;
  });

  await t.test('tells of a scan without a frame, and goes on with the good one', async () => {
    await page.getByTestId('label').fill('nothing');
    await press('start');
    await state(page, ...SCANNING);
    await press('pause');
    await state(page, 'paused');
    await press('reset');
    await press('confirm-yes');
    const words = page.getByTestId('refinement-words');
    await words.and(page.getByText('has no shading image yet')).waitFor();
    await press('stop');
    const toast = page.locator('[data-testid=toast][data-code=scan_failed]');
    await toast.waitFor({ timeout: 60_000 });
    assert.equal(await toast.innerText(), 'The scan “nothing” failed: no frame could be fused');
    await state(page, 'idle');
    const [request] = await Promise.all([asked(), press('refine')]);
    assert.ok(request.url().includes(whole.id));
  });

  await t.test('tells of what was taken on and refused later', async () => {
    const reason = 'the frames before are not kept';
    server.say('loss', { frame_id: 5, device_time_secs: 0.2, event: 'found' });
    server.say('loss', { frame_id: 7, device_time_secs: 0.3, event: 'refused', command: 'undo', reason });
    const toast = page.locator('[data-testid=toast][data-code=refused_undo]');
    await toast.waitFor();
    assert.equal(await toast.innerText(), `Nothing is taken back: ${reason}`);
  });

  await t.test('follows what happens only while it is looked at', async () => {
    const look = async (isHidden, n) => {
      await page.evaluate((hidden) => {
        Object.defineProperty(document, 'hidden', { value: hidden, configurable: true });
        document.dispatchEvent(new Event('visibilitychange'));
      }, isHidden);
      for (let i = 0; i < 50 && server.nStreams !== n; i += 1) await page.waitForTimeout(100);
      assert.equal(server.nStreams, n);
    };
    assert.equal(server.nStreams, 1);
    await look(true, 0);
    await look(false, 1);
  });

  assertClean(opened);
});

test('goes on where something cannot be written', { timeout: 60_000, skip: NEEDS_STAND_IN }, async (t) => {
  const server = await standIn();
  t.after(() => server.close());
  const { page } = await openPage(t, browser, server.base);
  await page.getByTestId('start').click();
  await state(page, ...SCANNING);
  server.daemon.hasStorageFailed = true;
  await state(page, 'fault');
  for (const name of ['pause', 'snapshot', 'undo', 'reset', 'stop']) assert.ok(await page.getByTestId(name).isEnabled(), name);
  await page.getByTestId('pause').click();
  await state(page, 'paused');
  await page.getByTestId('resume').click();
  await state(page, 'fault');
  // Its files wait for room.
  await page.getByTestId('stop').click();
  await page.getByTestId('abandon').click();
  await Promise.all([page.waitForRequest(/scan\/abandon$/), page.getByTestId('confirm-yes').click()]);
  await state(page, 'idle');
  assert.ok(await page.getByTestId('abandon').isHidden());
});

test('cancels refinements that run and those that wait', { timeout: 120_000, skip: NEEDS_STAND_IN }, async (t) => {
  const server = await standIn();
  t.after(() => server.close());
  const opened = await openPage(t, browser, server.base);
  const { page } = opened;
  const { daemon } = server;
  // Nothing of what follows hangs on how fast it is done.
  daemon.refineSecs = 1e6;
  const scan = async (name) => {
    await page.getByTestId('label').fill(name);
    await page.getByTestId('start').click();
    await state(page, ...SCANNING);
    const { id } = daemon.scan;
    await page.getByTestId('stop').click();
    await state(page, 'idle');
    return id;
  };
  const shown = (told) => page.locator(`#refinement[data-state=${told}]`).waitFor();
  const words = page.getByTestId('refinement-words');
  const progress = page.locator('#refinement-progress');
  const cancel = page.getByTestId('refinement-cancel');
  const queue = page.getByTestId('refinement-queue').locator('li:not([hidden])');
  const ends = async (button, id) => {
    const [request] = await Promise.all([page.waitForRequest(/\/jobs\/[^/]+\/cancel$/), button.click()]);
    assert.ok(request.url().endsWith(`/jobs/job-${id}/cancel`), request.url());
  };
  let first;

  await t.test('one that waits behind another', async () => {
    first = await scan('first');
    await shown('running');
    assert.equal(await queue.count(), 0, 'nothing waits');
    const second = await scan('second');
    const third = await scan('third');
    await queue.nth(1).waitFor();
    assert.deepEqual(await queue.locator('span').allInnerTexts(), [`Then second (${second})`, `Then third (${third})`]);
    await save(page, 'waiting');
    await ends(queue.first().getByRole('button'), second);
    await queue.nth(1).waitFor({ state: 'detached' });
    assert.equal(await queue.locator('span').innerText(), `Then third (${third})`);
    await ends(queue.getByRole('button'), third);
    await queue.waitFor({ state: 'detached' });
    assert.ok(await progress.isVisible(), 'the one that runs goes on');
    assert.deepEqual(daemon.jobs.map((job) => job.state), ['cancelled', 'cancelled', 'running']);
  });

  await t.test('the one that runs', async () => {
    await ends(cancel, first);
    await shown('cancelled');
    assert.match(await words.innerText(), /^Cancelled; the mesh stands as it was\./);
    assert.ok(await cancel.isHidden());
  });

  await t.test('one that is refused, which tells why', async () => {
    daemon.refusal = 'no surface lies in the box given by object.crop';
    await scan('refused');
    await shown('refused');
    assert.ok((await words.innerText()).startsWith(`Not refined; the mesh stands as it was. ${daemon.refusal}`));
    daemon.refusal = null;
  });

  await t.test('one that finds no room', async () => {
    daemon.hasRoomToRefine = false;
    const fourth = await scan('fourth');
    await shown('waiting');
    assert.ok(await progress.isHidden(), 'there is nothing to tell of it');
    assert.equal(await queue.count(), 0, 'it is told of once');
    await ends(cancel, fourth);
    await shown('cancelled');
    assert.ok(await cancel.isHidden());
    assert.equal(daemon.jobs[0].state, 'cancelled');
  });

  assertClean(opened);
});

test('has every button in reach at any width', { timeout: 120_000 }, async (t) => {
  const opened = await openPage(t, browser, base, { viewport: { width: 1024, height: 768 } });
  const { page } = opened;
  await page.getByTestId('label').fill(LABEL);
  await page.getByTestId('start').click();
  await state(page, ...SCANNING);
  assert.ok((await page.getByTestId('device').getAttribute('title')).startsWith(`${LABEL} · Kinect`));
  for (const width of [901, 920, 1024, 1100, 1240, 1241, 1280]) {
    await page.setViewportSize({ width, height: 768 });
    const covered = await page.locator('.toolbar button:not([hidden])').evaluateAll((buttons) => buttons.filter((button) => {
      const { left, right, top, bottom } = button.getBoundingClientRect();
      const isAt = (x, y) => button.contains(document.elementFromPoint(x, y));
      const y = (top + bottom) / 2;
      return !isAt(left + 3, y) || !isAt((left + right) / 2, y) || !isAt(right - 3, y) || button.scrollWidth > button.clientWidth;
    }).map(({ id }) => id));
    assert.deepEqual(covered, [], `at ${width}`);
    const advice = await page.locator('.state > div').boundingBox();
    assert.ok(advice.width > 200, `the advice has room at ${width}`);
    if (width === 1024) await save(page, 'tablet');
  }
  await page.getByTestId('stop').click();
  await state(page, 'idle');
  assertClean(opened);
});

test('a reset is asked about, and begins anew', { timeout: 120_000 }, async (t) => {
  const opened = await openPage(t, browser, base);
  const { page } = opened;
  await page.getByTestId('start').click();
  await rises(page, STAGE, 'revision', 3);
  const asked = [];
  page.on('request', (request) => asked.push(request.url()));
  await page.getByTestId('reset').click();
  await page.getByTestId('confirm-no').click();
  assert.ok(!asked.some((url) => url.endsWith('/scan/reset')), 'nothing is dropped that is kept');
  const faces = Number(await page.locator(STAGE).getAttribute('data-faces'));
  await page.getByTestId('reset').click();
  const [request] = await Promise.all([page.waitForRequest(/scan\/reset$/), page.getByTestId('confirm-yes').click()]);
  assert.equal(request.method(), 'POST');
  await page.waitForFunction(([where, least]) => Number(document.querySelector(where).dataset.faces) < least, [STAGE, faces]);
  assertClean(opened);
});

test('fits a phone', { timeout: 120_000 }, async (t) => {
  const opened = await openPage(t, browser, base, PHONE);
  const { page } = opened;
  await page.getByTestId('start').tap();
  await rises(page, STAGE, 'revision', 2);
  const { scrollWidth, innerWidth } = await page.evaluate(() => ({ scrollWidth: document.documentElement.scrollWidth, innerWidth }));
  assert.equal(scrollWidth, innerWidth, 'nothing sticks out');
  for (const name of ['pause', 'snapshot', 'undo', 'refine', 'reset', 'stop', 'export']) {
    const box = await page.getByTestId(name).boundingBox();
    assert.ok(box.x >= 0 && box.x + box.width <= innerWidth && box.y + box.height <= PHONE.viewport.height, `${name} is in view`);
    assert.ok(box.width >= 44 && box.height >= 44, `${name} is large enough for a finger`);
  }
  await save(page, 'phone');
  await page.getByTestId('stop').tap();
  await state(page, 'idle');
  assertClean(opened);
});

test('is steered by keys, and the view turns', { timeout: 120_000 }, async (t) => {
  const opened = await openPage(t, browser, base);
  const { page } = opened;
  await page.getByTestId('start').focus();
  await page.keyboard.press('Enter');
  await rises(page, STAGE, 'revision', 2);
  assert.equal(await page.evaluate(() => document.activeElement.id), 'pause', 'the focus goes on to what took the place');
  await page.keyboard.press('Enter');
  await state(page, 'paused');
  await page.getByTestId('scene').focus();
  await page.waitForTimeout(3000);
  const straight = await look(page);
  for (let i = 0; i < 4; i += 1) await page.keyboard.press('ArrowRight');
  await page.waitForTimeout(1000);
  assert.ok(differing(straight, await look(page), 0, straight.width) > 0.01);
  assertClean(opened);
});

test('tells why the daemon refuses', { timeout: 60_000 }, async (t) => {
  const { page } = await openPage(t, browser, base);
  const problem = { type: 'about:blank', title: 'refused', status: 409, detail: 'the camera is in use', code: 'device_busy' };
  await page.route('**/api/v1/scan', (route) => route.fulfill({ status: 409, contentType: 'application/problem+json', body: JSON.stringify(problem) }));
  await page.getByTestId('start').click();
  const toast = page.getByTestId('toast');
  await toast.waitFor();
  assert.equal(await toast.innerText(), 'the camera is in use');
  assert.equal(await toast.getAttribute('data-code'), 'device_busy');
});

test('draws again after the graphics were lost', { timeout: 60_000 }, async (t) => {
  const { page } = await openPage(t, browser, base);
  await page.getByTestId('scene-notice').waitFor({ state: 'hidden' });
  const lose = () => {
    globalThis.lost = document.getElementById('scene').getContext('webgl2').getExtension('WEBGL_lose_context');
    globalThis.lost.loseContext();
  };
  await page.evaluate(lose);
  await page.getByTestId('scene-notice').getByText('interrupted').waitFor();
  const drawn = Number(await page.getByTestId('scene').getAttribute('data-drawn'));
  await page.evaluate(() => globalThis.lost.restoreContext());
  await page.getByTestId('scene-notice').waitFor({ state: 'hidden' });
  await rises(page, '#scene', 'drawn', drawn);
});

test('says when the daemon is gone, and comes back with it', { timeout: 60_000, skip: NEEDS_STAND_IN }, async (t) => {
  const first = await standIn();
  const { page } = await openPage(t, browser, first.base);
  await page.getByTestId('start').click();
  await rises(page, STAGE, 'faces', 0);
  const { id, started } = first.daemon.scan;
  await first.close();
  const banner = page.getByTestId('connection-banner');
  await banner.getByText('Connection lost').waitFor();
  assert.ok(await page.getByTestId('start').isDisabled());
  const second = await standIn({ port: first.port });
  // Up for longer than the first was.
  second.daemon.started = first.daemon.started + 1;
  second.daemon.sessions.push({ id, label: null, interim_of: null, started_unix_ms: started, ended_unix_ms: null, state: 'interrupted', failures: [], files: [] });
  await banner.waitFor({ state: 'hidden', timeout: 30_000 });
  const interrupted = '[data-testid=toast][data-code=scan_interrupted]';
  await page.locator(interrupted).getByText(id).waitFor();
  assert.ok(await page.getByTestId('start').isEnabled());
  await page.locator('#coverage-share:empty').waitFor({ state: 'attached' });
  const { page: later } = await openPage(t, browser, second.base);
  await later.locator(interrupted).waitFor();
  await second.close();
});

test('loads itself anew after an update of the daemon', { timeout: 60_000, skip: NEEDS_STAND_IN }, async (t) => {
  const first = await standIn();
  const { page } = await openPage(t, browser, first.base);
  await first.close();
  await page.getByTestId('connection-banner').getByText('Connection lost').waitFor();
  const loaded = page.waitForEvent('load');
  const second = await standIn({ port: first.port });
  t.after(() => second.close());
  Object.assign(second.daemon, { version: '0.2.0', started: Date.now() - 3_600_000 });
  await loaded;
  await state(page, 'idle');
});

test('leads through the sequence of a Kinect I', { timeout: 60_000, skip: NEEDS_STAND_IN }, async (t) => {
  const kinect1 = await standIn({ sensor: 'kinect1' });
  const opened = await openPage(t, browser, kinect1.base, DESKTOP);
  const { page } = opened;
  assert.ok(await page.getByTestId('kinect1').isHidden());
  await page.getByTestId('start').click();
  const step = (name) => page.locator(`#kinect1[data-step=${name}] li[aria-current=step][data-step=${name}]`).waitFor();
  await step('cover_projector');
  assert.equal(await page.locator('#speckle-gauge').getAttribute('data-level'), 'bad');
  await step('lamp_on');
  assert.equal(await page.locator('#speckle-gauge').getAttribute('data-level'), 'good');
  await save(page, 'kinect1');
  assertClean(opened);
  await kinect1.close();
});
