/** The controls of what each surface shows: quantity, index, colour map, range, isolines. */

import { COLOUR_MAPS } from "./colours.js";
import { choice, h, labelled, offer } from "./dom.js";
import { QUANTITIES, fitting, load } from "./fields.js";
import { inWords } from "./jobs.js";

export class Shown {
  /** @param {import("./session.js").Viewer} viewer @param {"source" | "target"} side @param {HTMLElement} parent */
  constructor(viewer, side, parent) {
    this.viewer = viewer;
    this.side = side;
    this.layer = viewer.layers[side];
    /** @type {string} */
    this.key = side === "target" ? "mu" : "none";
    this.index = 0;
    this.turn = 0;
    /** @type {Array<[string, string]>} */
    this.arrays = [];
    this.quantity = choice([], this.key, (key) => this.show(key, 0), `What the ${side} shows`);
    this.number = h("input", { type: "range", min: 0, max: 99, value: 0, "aria-label": "Index", oninput: () => this.show(this.key, this.number.valueAsNumber, true) });
    this.numberRow = labelled("index", this.number);
    this.map = choice(COLOUR_MAPS.map((name) => [name, name]), COLOUR_MAPS[0], (map) => this.#scale({ map }), "Colour map");
    this.logarithmic = h("input", { type: "checkbox", onchange: () => this.#scale({ logarithmic: this.logarithmic.checked }) });
    this.isolines = h("input", { type: "number", min: 0, max: 60, step: 1, value: 0, onchange: () => this.#scale({ isolines: this.isolines.valueAsNumber || 0 }) });
    const percent = (/** @type {string} */ label, /** @type {number} */ value) =>
      h("input", { type: "number", min: 0, max: 100, step: 1, value, "aria-label": label, onchange: () => this.#range() });
    this.low = percent("Lowest percentile", 0);
    this.high = percent("Highest percentile", 100);
    this.complaint = h("p", { class: "bad", role: "alert", hidden: true });
    this.scaleRows = h(
      "div",
      { class: "scale" },
      labelled("colours", h("span", { class: "pair" }, this.map, h("label", { class: "tick" }, this.logarithmic, "log"))),
      labelled("percentiles", h("span", { class: "pair" }, this.low, "to", this.high), "Values outside are shown as the ends of the colour bar"),
      labelled("isolines", this.isolines, "How many steps the isolines divide the colour bar into"),
    );
    parent.append(labelled(side, this.quantity), this.numberRow, this.scaleRows, this.complaint);
    viewer.linked.set(side === "source" ? "left" : "right", () => this.#written());
    viewer.on("meshes", () => this.#anew("none"));
    viewer.on("softmap", () => this.#anew(side === "target" && this.key === "none" ? "mu" : this.key));
    viewer.on("opened", (link) => this.#read(link[side === "source" ? "left" : "right"]));
    this.#offer();
  }

  /**
   * @param {string} key @param {number} index @param {boolean} [keep] the scale, because only the index changes
   * @param {Partial<import("./layers.js").Scale>} [scale]
   */
  async show(key, index, keep = false, scale = {}) {
    const { viewer, side, layer } = this;
    const turn = ++this.turn;
    this.complaint.hidden = true;
    [this.key, this.index] = [key, index];
    this.quantity.value = key;
    if (side === "target" && key === "mu" && viewer.softmap) {
      viewer.showBrush(scale);
      this.#refresh();
      return;
    }
    if (side === "target") viewer.brush.shown = false;
    try {
      const { field, tint, last } = await load(viewer, side, key, index);
      if (turn !== this.turn) return;
      this.number.max = String(last ?? 0);
      viewer.stage[side].paint?.tint(tint ?? null);
      layer.show(field ?? null, keep ? { ...layer.scale, ...scale } : scale);
    } catch (error) {
      if (turn !== this.turn) return;
      this.complaint.textContent = inWords(error);
      this.complaint.hidden = false;
      layer.show(null);
    }
    this.#refresh();
  }

  /** @param {Partial<import("./layers.js").Scale>} change */
  #scale(change) {
    this.layer.setScale(change);
    this.viewer.keepLink();
  }

  #range() {
    const [a, b] = [this.low.valueAsNumber, this.high.valueAsNumber];
    if (a >= 0 && b <= 100 && a < b) this.#scale({ percentiles: [a, b] });
  }

  /** Offer what the surfaces and the soft map allow. */
  #offer() {
    const known = QUANTITIES.filter(({ side, needsMap }) => (!side || side === this.side) && (!needsMap || this.viewer.softmap));
    offer(this.quantity, [...known.map(({ key, text }) => /** @type {[string, string]} */ ([key, text])), ...this.arrays], this.key);
  }

  /** Another soft map or other meshes are shown. @param {string} key */
  async #anew(key) {
    const { surface } = this.viewer.stage[this.side];
    this.key = key;
    this.#offer();
    if (surface) await this.show(this.quantity.value || "none", this.index);
    this.arrays = surface ? await fitting(surface).catch(() => []) : [];
    this.#offer();
  }

  /** Let the controls say what is shown. */
  #refresh() {
    const { scale, field } = this.layer;
    this.numberRow.hidden = Number(this.number.max) === 0 || !(QUANTITIES.find(({ key }) => key === this.key)?.indexed || this.key.startsWith("array-"));
    this.number.value = String(this.index);
    this.scaleRows.hidden = !field;
    this.map.value = scale.map;
    this.logarithmic.checked = scale.logarithmic;
    this.isolines.value = String(scale.isolines);
    [this.low.value, this.high.value] = scale.percentiles.map(String);
    this.viewer.keepLink();
  }

  /** Quantity and scale for the link. */
  #written() {
    const { scale, field } = this.layer;
    if (this.key === "none") return null;
    const words = [`${this.key}:${this.index}`];
    if (field) words.push(String(COLOUR_MAPS.indexOf(scale.map)), scale.logarithmic ? "log" : "lin", String(scale.isolines), scale.percentiles.join(":"));
    return words.join("~");
  }

  /** @param {string | undefined} text */
  #read(text) {
    if (!text) return;
    const [what, map, logarithmic, isolines, range] = text.split("~");
    const [key, index] = what.split(":");
    /** @type {Partial<import("./layers.js").Scale>} */
    const scale = {};
    if (COLOUR_MAPS[Number(map)]) scale.map = COLOUR_MAPS[Number(map)];
    if (logarithmic) scale.logarithmic = logarithmic === "log";
    if (isolines) scale.isolines = Math.max(0, Number(isolines) || 0);
    const ends = (range ?? "").split(":").map(Number);
    if (ends.length === 2 && ends[0] >= 0 && ends[1] <= 100 && ends[0] < ends[1]) scale.percentiles = [ends[0], ends[1]];
    this.show(key, Number(index) || 0, false, scale);
  }
}
