// The ring that falls before track is lost, with the last half minute beside it.

/** Below this the operator has to act; tracking is lost soon after. Arbitrary. */
const WEAK = 0.3;
/** Below this there is less to hold on to than usual. Arbitrary. */
const FAIR = 0.55;
const HISTORY_MS = 30_000;
/** One point of the history for this long. */
const POINT_MS = 250;

export class Fitness {
  #card = document.querySelector('[data-testid=fitness]');
  #ring = document.getElementById('fitness-ring');
  #fill = document.getElementById('fitness-fill');
  #value = document.getElementById('fitness-value');
  #words = document.getElementById('fitness-words');
  #line = document.getElementById('fitness-history');
  #points = [];

  /** `newest`: 0 to 1, `null` while not tracking; it is that of the last frame that had depth. */
  show(newest, isLost, now = performance.now()) {
    const fitness = isLost ? 0 : newest;
    const [level, words] = isLost ? ['bad', 'lost'] : judge(fitness);
    this.#card.dataset.level = level;
    this.#words.textContent = words;
    const percent = fitness === null ? 0 : Math.round(100 * Math.min(Math.max(fitness, 0), 1));
    this.#value.textContent = fitness === null ? '–' : percent;
    this.#fill.setAttribute('stroke-dasharray', `${percent} 100`);
    this.#ring.setAttribute('aria-valuenow', percent);
    this.#ring.setAttribute('aria-valuetext', words);
    this.#remember(fitness === null ? null : percent, now);
  }

  #remember(percent, now) {
    const newest = this.#points.at(-1);
    if (newest && now - newest.now < POINT_MS) return;
    this.#points.push({ now, percent });
    while (now - this.#points[0].now > HISTORY_MS) this.#points.shift();
    let isDrawing = false;
    const steps = this.#points.map((point) => {
      if (point.percent === null) isDrawing = false;
      if (point.percent === null) return '';
      const step = `${isDrawing ? 'L' : 'M'}${(200 * (1 - (now - point.now) / HISTORY_MS)).toFixed(1)} ${(39 - 0.38 * point.percent).toFixed(1)}`;
      isDrawing = true;
      return step;
    });
    this.#line.setAttribute('d', steps.join(''));
  }
}

function judge(fitness) {
  if (fitness === null) return ['none', 'not tracking'];
  if (fitness < WEAK) return ['bad', 'about to be lost'];
  if (fitness < FAIR) return ['weak', 'weak, move slowly'];
  return ['good', 'holds firmly'];
}
