/**
 * Colour maps, computed: curves in OKLab (B. Ottosson, 2020) walked at constant speed, so that equal steps of a value
 * are equal steps to the eye. Lightness rises along the sequential ones.
 */

const SIZE = 256;
const DENSE = 2048;

/** Lightness, chroma and hue (degrees) of points that a curve passes. @type {Record<string, number[][]>} */
const CURVES = {
  "violet–yellow": [[0.26, 0.13, 300], [0.42, 0.12, 268], [0.56, 0.1, 215], [0.72, 0.14, 160], [0.93, 0.17, 106]],
  "black–red–yellow": [[0.13, 0.02, 290], [0.33, 0.14, 325], [0.52, 0.2, 10], [0.72, 0.17, 48], [0.97, 0.07, 100]],
  "blue–red": [[0.42, 0.15, 262], [0.66, 0.11, 245], [0.95, 0.01, 200], [0.66, 0.14, 45], [0.42, 0.15, 25]],
  grey: [[0.2, 0, 0], [0.96, 0, 0]],
};

export const COLOUR_MAPS = Object.keys(CURVES);

/** Colours of pins in the order they are set: as different as eight can be, also for the colour-blind. */
export const PIN_COLOURS = [
  [0.84, 0.37, 0.0], [0.0, 0.45, 0.7], [0.0, 0.62, 0.45], [0.8, 0.47, 0.65],
  [0.9, 0.62, 0.0], [0.34, 0.71, 0.91], [0.55, 0.27, 0.68], [0.45, 0.45, 0.2],
];

/** @type {Map<string, Uint8Array>} */
const tables = new Map();

/** @param {string} name @returns {Uint8Array} (256, 4) sRGB with alpha 255 */
export function colourTable(name) {
  let table = tables.get(name);
  if (!table) {
    table = tabulated(CURVES[name]);
    tables.set(name, table);
  }
  return table;
}

/** @param {number[]} rgb in 0…1 @returns {string} */
export const css = (rgb) => `rgb(${rgb.map((x) => Math.round(255 * x)).join(" ")})`;

/** @param {number[][]} curve */
function tabulated(curve) {
  const points = curve.map(([lightness, chroma, hue]) => {
    const angle = (hue * Math.PI) / 180;
    return [lightness, chroma * Math.cos(angle), chroma * Math.sin(angle)];
  });
  const dense = Array.from({ length: DENSE }, (_, k) => spline(points, (k / (DENSE - 1)) * (points.length - 1)));
  const lengths = new Float64Array(DENSE);
  for (let k = 1; k < DENSE; k++) {
    lengths[k] = lengths[k - 1] + Math.hypot(...dense[k].map((x, axis) => x - dense[k - 1][axis]));
  }
  const table = new Uint8Array(4 * SIZE);
  for (let k = 0, at = 0; k < SIZE; k++) {
    const wanted = (k / (SIZE - 1)) * lengths[DENSE - 1];
    while (at < DENSE - 1 && lengths[at] < wanted) at++;
    table.set([...shown(dense[at]), 255], 4 * k);
  }
  return table;
}

/** Catmull and Rom's spline through points, at parameter t. @param {number[][]} points @param {number} t */
function spline(points, t) {
  const last = points.length - 1;
  const k = Math.min(Math.floor(t), last - 1);
  const s = t - k;
  const [a, b, c, d] = [k - 1, k, k + 1, k + 2].map((j) => points[Math.min(Math.max(j, 0), last)]);
  return b.map(
    (_, axis) =>
      b[axis] +
      0.5 *
        s *
        (c[axis] - a[axis] +
          s *
            (2 * a[axis] - 5 * b[axis] + 4 * c[axis] - d[axis] + s * (3 * (b[axis] - c[axis]) + d[axis] - a[axis]))),
  );
}

/** Bytes of sRGB of an OKLab colour; chroma is lowered until a screen can show it. @param {number[]} lab */
function shown([lightness, a, b]) {
  for (let chroma = 1; ; chroma -= 0.02) {
    const rgb = linear(lightness, chroma * a, chroma * b);
    if (chroma <= 0 || rgb.every((x) => x >= -1e-3 && x <= 1.001)) {
      return rgb.map((x) => Math.round(255 * gamma(Math.min(Math.max(x, 0), 1))));
    }
  }
}

/** @param {number} lightness @param {number} a @param {number} b @returns {number[]} linear RGB */
function linear(lightness, a, b) {
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  return [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ];
}

/** @param {number} x */
const gamma = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);

/** A colour unlike those of the numbers beside it: hues a golden angle apart. @param {number} k @returns {number[]} bytes of sRGB */
export function distinct(k) {
  const angle = k * 2.399963;
  const lightness = 0.62 + 0.09 * ((k * 7) % 4);
  return shown([lightness, 0.12 * Math.cos(angle), 0.12 * Math.sin(angle)]);
}
