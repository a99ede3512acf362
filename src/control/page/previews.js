// What the camera sees: depth in colours, infrared in grey with what is too bright marked.

import { SEQUENTIAL, blend, drawBar, palette } from './colour.js';

const SATURATED = 255;
/** Share of the image from which on its brightness is worth a warning; arbitrary. */
const MUCH = 0.02;
/** Stripes, so that the mark does not depend on colour. */
const MARK_COLOURS = palette((value) => (value === 0 ? [232, 93, 66, 255] : [92, 24, 14, 255]));
const NEAR_TO_FAR = [...SEQUENTIAL].reverse();

export class Previews {
  #depth = new Picture(document.getElementById('depth'));
  #infrared = new Picture(document.getElementById('ir'));
  #range = document.getElementById('depth-range');
  #saturated = document.getElementById('ir-saturated');
  #marks = document.getElementById('mark-saturated');
  #newest = {};
  #depthColours = palette((value) => (value === 0 ? [0, 0, 0, 0] : [...blend(NEAR_TO_FAR, (value - 1) / 253), 255]));
  #greys = palette((value) => [value, value, value, 255]);

  constructor() {
    drawBar(document.getElementById('depth-bar'), NEAR_TO_FAR);
  }

  /** Shows an image with the next frame of the screen; one that a newer one overtakes is never drawn. */
  show(preview) {
    if (!this.#newest.depth && !this.#newest.ir) requestAnimationFrame(() => this.#draw());
    this.#newest[preview.kind] = preview;
  }

  #draw() {
    const { depth, ir } = this.#newest;
    this.#newest = {};
    if (ir) this.#infrared.draw(ir, this.#greys, this.#marks.checked);
    if (!depth) return;
    this.#depth.draw(depth, this.#depthColours);
    const range = `${depth.low.toFixed(2)} to ${depth.high.toFixed(2)} m`;
    if (this.#range.textContent !== range) this.#range.textContent = range;
  }

  /** The share of pixels at full scale, from the status. */
  showSaturation(share) {
    const words = share === null ? '' : `${(100 * share).toFixed(1)} % too bright`;
    if (this.#saturated.textContent === words) return;
    this.#saturated.textContent = words;
    this.#saturated.dataset.level = share !== null && share > MUCH ? 'bad' : 'good';
  }
}

/** A canvas that takes the size of what it shows; `data-frame` says which frame that is. */
class Picture {
  #canvas;
  #context;
  #image = null;
  #words = null;

  constructor(canvas) {
    this.#canvas = canvas;
    this.#context = canvas.getContext('2d');
  }

  draw({ width, height, values, frameId }, colours, marksSaturated = false) {
    if (this.#image?.width !== width || this.#image.height !== height) {
      this.#canvas.width = width;
      this.#canvas.height = height;
      this.#image = new ImageData(width, height);
      this.#words = new Uint32Array(this.#image.data.buffer);
    }
    const words = this.#words;
    for (let i = 0; i < values.length; i += 1) words[i] = colours[values[i]];
    if (marksSaturated) {
      for (let i = values.indexOf(SATURATED); i >= 0; i = values.indexOf(SATURATED, i + 1)) {
        const stripe = ((i % width) + Math.floor(i / width)) & 3;
        words[i] = MARK_COLOURS[stripe < 2 ? 0 : 1];
      }
    }
    this.#context.putImageData(this.#image, 0, 0);
    this.#canvas.dataset.frame = frameId;
  }
}
