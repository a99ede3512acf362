// Debian's Chromium, headless, with WebGL in software, and what the tests ask of its pages.

import { strict as assert } from 'node:assert';
import { mkdir } from 'node:fs/promises';
import { fileURLToPath } from 'node:url';
import { chromium } from 'playwright-core';
import { pixels } from './png.mjs';

const SCREENSHOTS = fileURLToPath(new URL('screenshots/', import.meta.url));
const ARGUMENTS = [
  '--no-sandbox', '--disable-gpu', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--disable-quic', '--no-first-run',
  // A certificate may sign itself: what is tested is the page, not who answers. Playwright's own option cancels downloads.
  '--ignore-certificate-errors',
  '--disable-background-networking', '--disable-component-update', '--disable-sync',
];
/** Of a daemon that asks for its token; the name of the user may be any. */
const TOKEN = process.env.RELIEF_PAGE_TOKEN;
const ACCESS = TOKEN ? { httpCredentials: { username: 'relief', password: TOKEN } } : {};
/** Widths that the page is made for. */
export const DESKTOP = { viewport: { width: 1440, height: 900 } };
export const PHONE = { viewport: { width: 390, height: 844 }, deviceScaleFactor: 2, hasTouch: true, isMobile: true };

export function launch(...more) {
  return chromium.launch({ executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium', args: [...ARGUMENTS, ...more] });
}

/** A page on a daemon that is idle; it remembers what went wrong in it, for `assertClean`, and is closed with the test. */
export async function openPage(test, browser, base, device = DESKTOP) {
  const context = await browser.newContext({ ...device, ...ACCESS, reducedMotion: 'reduce', acceptDownloads: true });
  test.after(() => context.close());
  // Refused if no scan is going on.
  await context.request.post(`${base}/api/v1/scan/abandon`, { headers: { Origin: base } });
  const page = await context.newPage();
  const faults = [];
  page.on('pageerror', (error) => faults.push(error.stack));
  page.on('console', (message) => {
    if (/content security policy/i.test(message.text())) faults.push(message.text());
  });
  page.on('request', (request) => {
    if (new URL(request.url()).host !== new URL(base).host) faults.push(`asked ${request.url()}`);
  });
  await page.goto(base);
  await state(page, 'idle');
  return { page, faults };
}

/** No script failed, nothing broke the policy, nothing was asked of another host. */
export function assertClean({ faults }) {
  assert.deepEqual(faults, []);
}

/** Waits until the daemon tells one of these states. */
export async function state(page, ...names) {
  await page.waitForFunction((wanted) => wanted.includes(document.body.dataset.state), names, { timeout: 120_000 });
}

/**
 * Looks from now on whether an element comes into a state, however shortly, and another one has the words that are given by its selector;
 * what it returns waits for that.
 */
export async function comesTo(page, selector, wanted, words = {}) {
  const handle = await page.evaluateHandle(([where, name, words]) => {
    const element = document.querySelector(where);
    const hasWords = ([other, text]) => document.querySelector(other).textContent === text;
    const came = new Promise((resolve) => {
      const observer = new MutationObserver(() => {
        if (element.dataset.state !== name || !Object.entries(words).every(hasWords)) return;
        observer.disconnect();
        resolve();
      });
      observer.observe(element, { attributeFilter: ['data-state'] });
    });
    return { came };
  }, [selector, wanted, words]);
  return () => handle.evaluate(({ came }) => came);
}

/** Waits until a number in an element's data rises above a value, and returns it. */
export async function rises(page, selector, key, above) {
  const handle = await page.waitForFunction(
    ([where, name, bound]) => {
      const value = Number(document.querySelector(where).dataset[name]);
      return value > bound ? value : false;
    },
    [selector, key, above],
    { timeout: 120_000 },
  );
  return handle.jsonValue();
}

/** Keeps the next such request from going out until the function that it returns is called. */
export async function holdBack(page, url) {
  let release;
  const released = new Promise((resolve) => { release = resolve; });
  await page.route(url, async (route) => {
    await released;
    await route.continue();
  }, { times: 1 });
  return release;
}

/** The pixels of the view of the model, without what lies over it. */
export async function look(page) {
  await cover(page, 'hidden');
  const image = pixels(await page.getByTestId('scene').screenshot({ scale: 'css' }));
  await cover(page, '');
  return image;
}

/** Waits until at least so many pixels of the view have a property: what is told is drawn a moment later. */
export function shows(page, has, least, what) {
  return reaches(page, (image) => count(image, has), least, `${what}, pixels`);
}

/** Waits until at least such a share of the view's pixels differs from what they were. */
export function changes(page, before, least, what) {
  return reaches(page, (image) => differing(before, image, 0, image.width), least, `${what}, share of the pixels`);
}

async function reaches(page, figure, least, what) {
  const deadline = Date.now() + 30_000;
  for (;;) {
    const found = figure(await look(page));
    if (found >= least) return;
    assert.ok(Date.now() < deadline, `${what}: ${found} of ${least}`);
    await page.waitForTimeout(200);
  }
}

/** The policy forbids style sheets of the browser's driver, not styles set by a script. */
function cover(page, visibility) {
  return page.locator('.stage-top, .stage-bottom, .hint, .divider, .divider input')
    .evaluateAll((elements, value) => elements.forEach((element) => { element.style.visibility = value; }), visibility);
}

/** How many pixels of an image, from column to column, have a property. */
export function count(image, has, from = 0, to = image.width) {
  let n = 0;
  for (let y = 0; y < image.height; y += 1) {
    for (let x = from; x < to; x += 1) if (has(image.at(x, y))) n += 1;
  }
  return n;
}

/** The share of pixels between two columns that differ. */
export function differing(one, other, from, to) {
  let n = 0;
  for (let y = 0; y < one.height; y += 1) {
    for (let x = from; x < to; x += 1) {
      const [a, b] = [one.at(x, y), other.at(x, y)];
      if (a.some((value, channel) => Math.abs(value - b[channel]) > 6)) n += 1;
    }
  }
  return n / (one.height * (to - from));
}

export async function save(page, name) {
  await mkdir(SCREENSHOTS, { recursive: true });
  await page.screenshot({ path: `${SCREENSHOTS}${name}.png` });
}
