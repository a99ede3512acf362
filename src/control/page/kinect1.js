// The guided sequence of a Kinect I, whose projector has to be covered for a shading image, with the speckle that is left.

export class Kinect1 {
  #card = document.getElementById('kinect1');
  #gauge = document.getElementById('speckle-gauge');
  #fill = document.getElementById('speckle-fill');
  #limit = document.getElementById('speckle-limit');
  #words = document.getElementById('speckle-words');

  /** `{step, speckle, speckle_limit}`, or `null` with another sensor. */
  show(sequence) {
    this.#card.hidden = !sequence;
    if (!sequence) return;
    const { step, speckle, speckle_limit: limit } = sequence;
    this.#card.dataset.step = step;
    const steps = [...this.#card.querySelectorAll('li')];
    const now = steps.findIndex((item) => item.dataset.step === step);
    steps.forEach((item, i) => {
      item.dataset.done = i < now;
      if (i === now) item.setAttribute('aria-current', 'step');
      else item.removeAttribute('aria-current');
    });
    this.#showSpeckle(speckle, limit);
  }

  /** The limit stands in the middle of the gauge. */
  #showSpeckle(speckle, limit) {
    const isKnown = speckle !== null && speckle !== undefined;
    const isClear = isKnown && speckle <= limit;
    const percent = isKnown ? Math.min((50 * speckle) / limit, 100) : 0;
    this.#gauge.dataset.level = isClear ? 'good' : 'bad';
    this.#fill.style.width = `${percent}%`;
    this.#limit.style.left = '50%';
    this.#gauge.setAttribute('aria-valuemax', 2 * limit);
    this.#gauge.setAttribute('aria-valuenow', isKnown ? speckle : 0);
    this.#words.textContent = !isKnown ? '–' : isClear ? 'clear: the projector is covered' : 'the projector still shows';
  }
}
