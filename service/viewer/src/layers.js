/** What one view's surface shows: a quantity, its colour map and range, and the colour bar that explains them. */

import { ColourBar } from "./colourbar.js";
import { extentOf, percentiles } from "./statistics.js";

/**
 * @typedef {object} Field numbers on a surface
 * @property {"vertex" | "face"} domain
 * @property {ArrayLike<number>} values
 * @property {string} title
 * @property {string} unit
 * @property {boolean} [logarithmic] suggested
 * @property {boolean} [fading] low values leave the surface bare
 * @property {boolean} [signed] the range is symmetric about 0
 * @property {[number, number]} [range] percentiles suggested
 */

/** @typedef {{map: string, logarithmic: boolean, isolines: number, percentiles: [number, number]}} Scale */

export class Layer {
  /** @param {import("./pane.js").Pane} pane @param {HTMLElement} overlay @param {() => void} draw */
  constructor(pane, overlay, draw) {
    this.pane = pane;
    this.draw = draw;
    this.bar = new ColourBar(overlay);
    /** @type {?Field} */
    this.field = null;
    /** @type {Scale} */
    this.scale = { map: "violet–yellow", logarithmic: false, isolines: 0, percentiles: [0, 100] };
  }

  /** @param {?Field} field @param {Partial<Scale>} [scale] instead of what the field suggests */
  show(field, scale = {}) {
    this.field = field;
    if (field) {
      this.scale = {
        map: field.signed ? "blue–red" : this.scale.map === "blue–red" ? "violet–yellow" : this.scale.map,
        isolines: this.scale.isolines,
        logarithmic: field.logarithmic ?? false,
        percentiles: field.range ?? [0, 100],
        ...scale,
      };
    }
    this.apply();
  }

  /** @param {Partial<Scale>} change */
  setScale(change) {
    Object.assign(this.scale, change);
    this.apply();
  }

  /** Paint the field again; its values may have changed in place. */
  apply() {
    const { field, scale, pane } = this;
    if (!pane.paint) return;
    if (!field) {
      pane.paint.show(null);
      this.bar.hide();
      this.draw();
      return;
    }
    const { low, high } = this.range();
    const { map, logarithmic, isolines } = scale;
    pane.paint.show({ domain: field.domain, values: field.values, low, high, logarithmic, isolines, map, fading: field.fading });
    if (field.fading && !(high > 1e-9)) this.bar.hide();
    else this.bar.show(field, scale, low, high, field.domain === "vertex" ? pane.surface.nVertices : pane.surface.nFaces);
    this.draw();
  }

  /** Only the range and the bar: for values that are painted already. */
  refreshRange() {
    const { field, pane } = this;
    if (!field || !pane.paint) return;
    const { low, high } = this.range();
    pane.paint.setRange(low, high);
    this.bar.show(field, this.scale, low, high, pane.surface.nVertices);
  }

  /** Ends of the colour bar. */
  range() {
    const { field, scale, pane } = this;
    const count = field.domain === "vertex" ? pane.surface.nVertices : pane.surface.nFaces;
    const [from, to] = scale.percentiles;
    let [low, high] =
      from <= 0 && to >= 100
        ? extentOf(field.values, count, scale.logarithmic)
        : percentiles(field.values, count, [from, to], scale.logarithmic);
    if (field.signed && !scale.logarithmic) [low, high] = [-Math.max(-low, high), Math.max(-low, high)];
    if (field.fading && !scale.logarithmic) low = 0;
    if (!(high > low)) high = low + (Math.abs(low) * 1e-6 || 1e-12);
    return { low, high };
  }
}
