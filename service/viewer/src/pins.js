/** The brush and its pins as numbers: what the pointer does, with the keyboard. */

import { css } from "./colours.js";
import { h, labelled } from "./dom.js";

export class Pins {
  /** @param {import("./session.js").Viewer} viewer @param {HTMLElement} parent */
  constructor(viewer, parent) {
    this.viewer = viewer;
    const { brush } = viewer;
    this.vertex = h("input", { type: "number", min: 0, step: 1, "aria-label": "Source vertex of the brush", oninput: () => this.#move() });
    const pin = h("button", { type: "button", title: "Keep this point's distribution, in a colour of its own", onclick: () => brush.vertex >= 0 && brush.pin(brush.vertex) }, "pin");
    this.clear = h("button", { type: "button", onclick: () => brush.clearPins() }, "clear pins");
    this.list = h("ul", { class: "plain", "aria-label": "Pins" });
    parent.append(
      labelled("vertex", h("span", { class: "pair" }, this.vertex, pin, this.clear), "As the uploaded file counts, from 0"),
      this.list,
      h("p", { class: "note" }, "Move over the source to paint, click to pin. Drag turns, right drag or shift moves, the wheel zooms."),
    );
    viewer.on("brush", () => this.#refresh());
    viewer.on("softmap", () => this.#refresh());
    this.#refresh();
  }

  #move() {
    const { softmap, brush } = this.viewer;
    const vertex = this.vertex.valueAsNumber;
    if (softmap && Number.isInteger(vertex) && vertex >= 0 && vertex < softmap.source.surface.nVertices) brush.moveTo(vertex);
  }

  #refresh() {
    const { brush } = this.viewer;
    if (document.activeElement !== this.vertex) this.vertex.value = brush.vertex >= 0 ? String(brush.vertex) : "";
    this.clear.disabled = brush.pins.length === 0;
    if (this.drawn === brush.pins.map((pin) => pin.vertex).join()) return;
    this.drawn = brush.pins.map((pin) => pin.vertex).join();
    this.list.replaceChildren(
      ...brush.pins.map(({ vertex, colour }) => {
        const dot = h("span", { class: "dot" });
        dot.style.background = css(colour);
        const go = h("button", { type: "button", class: "quiet grow", title: "Show this one", onclick: () => brush.moveTo(vertex) }, `vertex ${vertex}`);
        const remove = h("button", { type: "button", class: "quiet", "aria-label": `Remove the pin at vertex ${vertex}`, onclick: () => brush.pin(vertex) }, "✕");
        return h("li", { "data-pin": vertex }, dot, go, remove);
      }),
    );
  }
}
