// What the camera sees: depth in colours, infrared in grey with what is too bright marked.

import { SEQUENTIAL, blend, drawBar, palette } from './colour.js';

const SATURATED = 255;
/** Stripes, so that the mark does not depend on colour. */
const MARK_COLOURS = palette((value) => (value === 0 ? [232, 93, 66, 255] : [92, 24, 14, 255]));
const NEAR_TO_FAR = [...SEQUENTIAL].reverse();

export class Previews {
  #depth = new Picture(document.getElementById('depth'));
  #infrared = new Picture(document.getElementById('ir'));
  #range = document.getElementById('depth-range');
  #saturated = document.getElementById('ir-saturated');
  #marks = document.getElementById('mark-saturated');
  #depthColours = palette((value) => (value === 0 ? [0, 0, 0, 0] : [...blend(NEAR_TO_FAR, (value - 1) / 253), 255]));
  #greys = palette((value) => [value, value, value, 255]);

  constructor() {
    drawBar(document.getElementById('depth-bar'), NEAR_TO_FAR);
  }

  show(preview) {
    if (preview.kind === 'depth') {
      this.#depth.draw(preview, this.#depthColours);
      this.#range.textContent = `${preview.low.toFixed(2)} to ${preview.high.toFixed(2)} m`;
    } else if (preview.kind === 'ir') {
      this.#infrared.draw(preview, this.#greys, this.#marks.checked);
    }
  }

  /** The share of pixels at full scale, from the status. */
  showSaturation(share) {
    this.#saturated.textContent = share === null ? '' : `${(100 * share).toFixed(1)} % too bright`;
    this.#saturated.dataset.level = share !== null && share > 0.02 ? 'bad' : 'good';
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
