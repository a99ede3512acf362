// Figures of the page: first paint, what previews cost the browser and the daemon, how long a large mesh takes to be drawn.
// `node measure.mjs [URL [PID]]`: against the stand-in, or a daemon that is idle and replays a recording, with its process id.

import { readFile } from 'node:fs/promises';
import { launch, openPage, rises } from './browser.mjs';
import { standIn } from './stand_in.mjs';

const LOADS = 7;
const SECS = 20;
const [address, pid] = process.argv.slice(2);
const server = address ? null : await standIn();
const base = address ?? server.base;
const closing = [];
const asTest = { after: (close) => closing.push(close) };

await firstPaint();
await previews();
await drawing();
for (const close of closing) await close();
await server?.close();

async function firstPaint() {
  const browser = await launch();
  const times = [];
  for (let i = 0; i < LOADS; i += 1) {
    const { page } = await openPage(asTest, browser, base);
    await page.waitForFunction(() => performance.getEntriesByName('first-contentful-paint').length > 0);
    times.push(await page.evaluate(() => performance.getEntriesByName('first-contentful-paint')[0].startTime));
    await page.context().close();
  }
  times.sort((a, b) => a - b);
  console.log(`first paint: median ${times[LOADS >> 1].toFixed(0)} ms, slowest ${times.at(-1).toFixed(0)} ms of ${LOADS} empty caches`);
  await browser.close();
}

/** Without WebGL nothing but status and previews is left to do. */
async function previews() {
  const browser = await launch('--disable-3d-apis');
  const { page } = await openPage(asTest, browser, base);
  const client = await page.context().newCDPSession(page);
  // Processor time, not time that other programs take.
  await client.send('Performance.enable', { timeDomain: 'threadTicks' });
  await page.getByTestId('start').click();
  await rises(page, '#depth', 'frame', 10);
  await page.evaluate(() => {
    globalThis.nPreviews = 0;
    new MutationObserver((records) => { globalThis.nPreviews += records.length; })
      .observe(document.querySelector('[data-testid=previews]'), { subtree: true, attributeFilter: ['data-frame'] });
  });
  const busy = async () => {
    const { metrics } = await client.send('Performance.getMetrics');
    return metrics.find(({ name }) => name === 'TaskDuration').value;
  };
  const [before, daemonBefore] = [await busy(), await daemonSecs()];
  await page.waitForTimeout(1000 * SECS);
  const [share, daemon] = [(await busy()) - before, (await daemonSecs()) - daemonBefore];
  const n = await page.evaluate(() => globalThis.nPreviews);
  console.log(`previews: ${(n / SECS).toFixed(1)} images a second; the page's thread takes ${percent(share)} of a core`);
  if (pid) {
    await page.goto('about:blank');
    const alone = await daemonSecs();
    await new Promise((resolve) => { setTimeout(resolve, 1000 * SECS); });
    console.log(`daemon: ${percent(daemon)} of a core with the page, ${percent((await daemonSecs()) - alone)} without`);
  }
  await browser.close();
}

/** The finished scan's meshes, from an earlier session if there is one. */
async function drawing() {
  const browser = await launch();
  const { page } = await openPage(asTest, browser, base);
  if (await page.locator('#mode-compare').isDisabled()) {
    await page.getByTestId('start').click();
    await rises(page, '[data-testid=stage]', 'revision', 2);
    await page.getByTestId('stop').click();
  }
  await page.locator('#mode-compare:enabled').click({ timeout: 300_000 });
  const started = Date.now();
  await page.locator('[data-testid=stage][data-compared]').waitFor({ timeout: 120_000 });
  await page.waitForTimeout(2000);
  const turn = async () => {
    const drawn = Number(await page.getByTestId('scene').getAttribute('data-drawn'));
    const began = Date.now();
    await page.getByTestId('scene').press('ArrowRight');
    await rises(page, '#scene', 'drawn', drawn);
    await page.evaluate(() => new Promise((resolve) => { requestAnimationFrame(() => requestAnimationFrame(resolve)); }));
    return Date.now() - began;
  };
  const turns = [];
  for (let i = 0; i < 5; i += 1) turns.push(await turn());
  turns.sort((a, b) => a - b);
  console.log(`comparison: loaded and shown within ${Date.now() - started - 2000} ms; a turn of both meshes, drawn in software, takes ${turns[2]} ms (median of 5)`);
  await browser.close();
}

/** Processor time of the daemon so far, seconds; 0 without its process id. */
async function daemonSecs() {
  if (!pid) return 0;
  const fields = (await readFile(`/proc/${pid}/stat`, 'latin1')).split(') ')[1].split(' ');
  return (Number(fields[11]) + Number(fields[12])) / 100;
}

function percent(secs) {
  return `${((100 * secs) / SECS).toFixed(1)} %`;
}
