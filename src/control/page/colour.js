// Numbers as colours. All scales are told apart by readers who do not see red and green alike.

/** From dark violet through green to yellow; the report's scale. */
export const SEQUENTIAL = [
  [68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37],
];
/** From blue (less) through white to red (more); the report's scale. */
export const DIVERGING = [
  [33, 102, 172], [103, 169, 207], [209, 229, 240], [247, 247, 247], [253, 219, 199], [239, 138, 98], [178, 24, 43],
];
/** From violet (no view yet) to the colour of plaster (enough views): lightness only grows. */
export const COVERAGE = [
  [88, 70, 150], [141, 84, 158], [192, 108, 140], [224, 146, 116], [231, 188, 140], [222, 213, 198],
];

/** The colour at a share of the way through stops at equal distances, as three bytes. */
export function blend(stops, share) {
  const place = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const before = Math.min(Math.floor(place), stops.length - 2);
  const weight = place - before;
  return stops[before].map((value, channel) => Math.round(value * (1 - weight) + stops[before + 1][channel] * weight));
}

/** 256 colours through stops as RGBA bytes. */
export function ramp(stops) {
  const bytes = new Uint8Array(4 * 256);
  for (let i = 0; i < 256; i += 1) bytes.set([...blend(stops, i / 255), 255], 4 * i);
  return bytes;
}

/** 256 colours as the 32-bit words of an image on a little-endian machine. */
export function palette(colourOf) {
  const words = new Uint32Array(256);
  for (let value = 0; value < 256; value += 1) {
    const [red, green, blue, alpha] = colourOf(value);
    words[value] = ((alpha << 24) | (blue << 16) | (green << 8) | red) >>> 0;
  }
  return words;
}

/** Draws a scale into a canvas one pixel high. */
export function drawBar(canvas, stops) {
  const image = new ImageData(canvas.width, 1);
  for (let column = 0; column < canvas.width; column += 1) {
    image.data.set([...blend(stops, column / (canvas.width - 1)), 255], 4 * column);
  }
  canvas.getContext('2d').putImageData(image, 0, 0);
}
