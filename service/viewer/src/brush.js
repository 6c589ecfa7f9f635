/** The brush: where the pointer is on the source, its distribution on the target, and pins that stay. */

import { PIN_COLOURS } from "./colours.js";
import { peakOf } from "./softmap.js";

export class Brush {
  /** @param {import("./stage.js").Stage} stage @param {() => void} onChange after the vertex or the pins changed */
  constructor(stage, onChange) {
    this.stage = stage;
    this.onChange = onChange;
    /** @type {?import("./softmap.js").SoftMap} */
    this.softmap = null;
    /** Source vertex that is shown, or −1. */
    this.vertex = -1;
    /** @type {Array<{vertex: number, colour: number[]}>} */
    this.pins = [];
    /** Target vertex where μ_x is largest, and how large. */
    this.peak = -1;
    this.peakDensity = 0;
    /** Milliseconds that the last evaluation took. */
    this.milliseconds = 0;
    this.scratch = new Float32Array(0);
    /** Whether the target shows μ_x; pins tint it only then. */
    this.shown = true;
    this.others = /** @type {{source: import("./pane.js").Marker[], target: import("./pane.js").Marker[]}} */ ({ source: [], target: [] });
  }

  /** @param {?import("./softmap.js").SoftMap} softmap */
  setSoftMap(softmap) {
    const { surface } = this.stage.source;
    const same = softmap && surface === softmap.source.surface && this.surface === surface;
    this.softmap = softmap;
    this.surface = surface;
    if (!same) {
      this.vertex = this.peak = -1;
      this.pins = [];
    }
    this.scratch = new Float32Array(softmap?.target.surface.nVertices ?? 0);
  }

  /** @param {number} vertex of the source */
  moveTo(vertex) {
    if (vertex === this.vertex || !this.softmap) return;
    this.vertex = vertex;
    this.evaluate();
    this.onChange();
  }

  /** Evaluate μ_x where the brush is, into the target's numbers if it shows them. */
  evaluate() {
    const { softmap, vertex, stage } = this;
    const paint = stage.target.paint;
    if (!softmap || !paint || vertex < 0) return;
    const began = performance.now();
    const out = this.shown ? paint.numbers : this.scratch;
    softmap.distribution(vertex, out);
    this.peak = peakOf(out, softmap.target.surface.nVertices);
    this.peakDensity = out[this.peak];
    if (this.shown) paint.refresh();
    this.milliseconds = performance.now() - began;
    stage.draw(stage.target);
  }

  /** @param {number} vertex pinned, or let go if it is pinned */
  pin(vertex) {
    const at = this.pins.findIndex((pin) => pin.vertex === vertex);
    if (at >= 0) this.pins.splice(at, 1);
    else {
      const free = PIN_COLOURS.find((colour) => !this.pins.some((pin) => pin.colour === colour));
      this.pins.push({ vertex, colour: free ?? PIN_COLOURS[this.pins.length % PIN_COLOURS.length] });
    }
    this.tint();
    this.mark();
    this.onChange();
  }

  clearPins() {
    this.pins = [];
    this.tint();
    this.mark();
    this.onChange();
  }

  /** Tint the target with the pins' distributions, each relative to its peak. */
  tint() {
    const { softmap, pins, stage } = this;
    const paint = stage.target.paint;
    if (!paint) return;
    if (!softmap || pins.length === 0 || !this.shown) {
      paint.tint(null);
      stage.draw();
      return;
    }
    const n = softmap.target.surface.nVertices;
    const [sum, most, total] = [new Float32Array(3 * n), new Float32Array(n), new Float32Array(n)];
    for (const { vertex, colour } of pins) {
      const mu = softmap.distribution(vertex, this.scratch);
      const peak = mu[peakOf(mu, n)] || 1;
      for (let v = 0; v < n; v++) {
        const part = mu[v] / peak;
        total[v] += part;
        most[v] = Math.max(most[v], part);
        for (let k = 0; k < 3; k++) sum[3 * v + k] += part * colour[k];
      }
    }
    const rgba = new Uint8Array(4 * n);
    for (let v = 0; v < n; v++) {
      for (let k = 0; k < 3; k++) rgba[4 * v + k] = total[v] > 0 ? (255 * sum[3 * v + k]) / total[v] : 0;
      rgba[4 * v + 3] = 255 * Math.min(1, 1.25 * most[v] ** 0.8);
    }
    paint.tint(rgba);
    stage.draw();
  }

  /** Draw the pins and whatever else is marked. */
  mark() {
    const { stage, pins, others } = this;
    if (stage.source.surface) stage.source.setMarkers([...pins, ...others.source]);
    if (stage.target.surface) stage.target.setMarkers(others.target);
    stage.draw();
  }
}
