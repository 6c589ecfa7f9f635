/** The colour bar of a view: colours, histogram, isolines, ends and unit. */

import { colourTable } from "./colours.js";
import { h } from "./dom.js";
import { histogram, short } from "./statistics.js";

const [WIDTH, HEIGHT, BAR] = [258, 34, 12];
const BINS = 86;
/** Milliseconds between two histograms while the brush moves. */
const PATIENCE = 90;

export class ColourBar {
  /** @param {HTMLElement} parent */
  constructor(parent) {
    this.canvas = h("canvas", { width: 2 * WIDTH, height: 2 * HEIGHT, role: "presentation" });
    this.caption = h("figcaption");
    this.low = h("span");
    this.high = h("span");
    const ends = h("div", { class: "ends" }, this.low, this.high);
    this.figure = h("figure", { class: "bar", hidden: true }, this.caption, this.canvas, ends);
    parent.append(this.figure);
    this.waiting = 0;
  }

  hide() {
    this.figure.hidden = true;
  }

  /**
   * @param {import("./layers.js").Field} field @param {import("./layers.js").Scale} scale
   * @param {number} low @param {number} high @param {number} count how many of the values are shown
   */
  show(field, scale, low, high, count) {
    this.figure.hidden = false;
    const unit = [field.unit, scale.logarithmic ? "log" : ""].filter(Boolean).join(", ");
    this.caption.textContent = field.title + (unit ? ` (${unit})` : "");
    this.low.textContent = short(low);
    this.high.textContent = short(high);
    this.latest = () => this.#draw(field, scale, low, high, count);
    if (!this.waiting) {
      this.latest();
      this.waiting = window.setTimeout(() => {
        this.waiting = 0;
        this.latest();
      }, PATIENCE);
    }
  }

  /**
   * @param {import("./layers.js").Field} field @param {import("./layers.js").Scale} scale
   * @param {number} low @param {number} high @param {number} count
   */
  #draw(field, scale, low, high, count) {
    const brush = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d"));
    brush.setTransform(2, 0, 0, 2, 0, 0);
    brush.clearRect(0, 0, WIDTH, HEIGHT);
    const table = colourTable(scale.map);
    const top = HEIGHT - BAR;
    for (let x = 0; x < WIDTH; x++) {
      const k = 4 * Math.round((x / (WIDTH - 1)) * 255);
      brush.fillStyle = `rgb(${table[k]} ${table[k + 1]} ${table[k + 2]})`;
      brush.fillRect(x, top, 1, BAR);
    }
    const bins = histogram(field.values, count, low, high, BINS, scale.logarithmic);
    // The square root lets rare values be seen beside the many that are 0.
    const most = Math.sqrt(Math.max(...bins, 1));
    brush.fillStyle = getComputedStyle(this.figure).color;
    brush.globalAlpha = 0.45;
    bins.forEach((n, k) => {
      const height = (Math.sqrt(n) / most) * (top - 3);
      brush.fillRect((k * WIDTH) / BINS, top - 1 - height, WIDTH / BINS - 0.5, height);
    });
    brush.globalAlpha = 0.7;
    for (let k = 1; k < scale.isolines; k++) brush.fillRect((k * WIDTH) / scale.isolines, top, 1, BAR);
    brush.globalAlpha = 1;
  }
}
