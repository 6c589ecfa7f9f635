/** Optimal maps: landmarks as clicked pairs, and the search that is watched as it nears the optimum. */

import { array, artifact, snapshot } from "./api.js";
import { PIN_COLOURS, css } from "./colours.js";
import { h, labelled } from "./dom.js";
import { JobDismissed, inWords } from "./jobs.js";
import { SoftMap, loadBasis } from "./softmap.js";
import { short } from "./statistics.js";

const SVG = "http://www.w3.org/2000/svg";

export class Landmarks {
  /** @param {import("./session.js").Viewer} viewer @param {HTMLElement} parent @param {import("./tools.js").Tools} tools
   *  @param {import("./question.js").Question} question */
  constructor(viewer, parent, tools, question) {
    this.viewer = viewer;
    this.question = question;
    /** @type {Array<[number, number]>} source and target vertex */
    this.pairs = [];
    /** Energy and gap of the iterations that were seen. @type {Array<{energy: number, gap: number}>} */
    this.course = [];
    /** Source vertex that waits for its target. */
    this.waiting = -1;
    this.weight = h("input", { type: "number", min: 0, step: 0.1, value: 1, "aria-label": "Weight of the bijectivity energy" });
    this.size = h("input", { type: "number", min: 1, step: 1, value: 60, "aria-label": "Functions of an optimal map" });
    this.list = h("ul", { class: "plain", "aria-label": "Landmarks" });
    this.go = h("button", { type: "button", class: "main", disabled: true, onclick: () => this.optimise() }, "Optimise");
    const clear = h("button", { type: "button", onclick: () => this.set([]) }, "clear landmarks");
    this.note = h("p", { class: "note", role: "status" }, "Landmarks (L): click a point of the source, then where it goes on the target.");
    this.complaint = h("p", { class: "bad", role: "alert", hidden: true });
    this.chart = document.createElementNS(SVG, "svg");
    this.chart.setAttribute("class", "chart");
    this.chart.setAttribute("role", "img");
    this.chart.setAttribute("hidden", "");
    parent.append(
      this.list,
      labelled("functions", this.size, "How many each basis has; the search takes much longer with more"),
      labelled("λ", h("span", { class: "pair" }, this.weight, clear), "Weight of the bijectivity energy"),
      this.go,
      this.note,
      this.chart,
      this.complaint,
    );
    tools.add(this.#tool(), "landmarks", "l", "Click pairs of points that shall correspond (L)");
    viewer.on("meshes", () => this.#anew());
    viewer.on("softmap", () => this.#anew());
    viewer.linked.set("landmarks", () => this.pairs.map((pair) => pair.join(":")).join(",") || null);
    viewer.on("opened", (link) => this.#read(link.landmarks));
  }

  /** @param {Array<[number, number]>} pairs */
  set(pairs) {
    this.pairs = pairs;
    this.waiting = -1;
    this.#show();
    this.viewer.keepLink();
  }

  /** Search the optimal map, and show what is known of it meanwhile. */
  async optimise() {
    const { viewer, question, pairs } = this;
    this.complaint.hidden = true;
    this.go.disabled = true;
    this.course = [];
    try {
      const [source, target] = await Promise.all(
        /** @type {const} */ (["source", "target"]).map((side, k) => {
          const first = [...new Set(pairs.map((pair) => pair[k]))];
          return viewer.jobs.run({ ...question.basis(side, first), size: this.size.valueAsNumber }, `basis of the ${side}`);
        }),
      );
      const bases = await Promise.all([loadBasis(source), loadBasis(target)]);
      const map = { type: "optimal", landmarks: pairs, bijectivity_weight: this.weight.valueAsNumber };
      const spec = { kind: "softmap", source, target, map };
      const id = await viewer.jobs.run(spec, "optimal map", (job) => this.#follow(job, bases));
      const { values } = await artifact(id);
      this.course = await history(id);
      this.#draw();
      await viewer.showSoftMap(id);
      const gap = `${short((100 * values.gap) / values.energy)} %`;
      this.note.textContent = `Energy ${short(values.energy)}, Dirichlet ${short(values.dirichlet)}; no map is more than ${gap} better. ${values.iterations} iterations.`;
      await question.refresh();
    } catch (error) {
      this.note.textContent = error instanceof JobDismissed ? error.message : "";
      this.complaint.textContent = error instanceof JobDismissed ? "" : inWords(error);
      this.complaint.hidden = this.complaint.textContent === "";
    }
    this.#show();
  }

  /**
   * A search went on: draw its course, and its best map so far.
   *
   * @param {import("./api.js").Job} job @param {import("./softmap.js").Basis[]} bases
   */
  async #follow(job, [source, target]) {
    this.note.textContent = job.phase;
    const { energy, gap, iteration } = job.values ?? {};
    if (job.status !== "running" || !(energy > 0) || iteration === this.iteration) return;
    this.iteration = iteration;
    this.course.push({ energy, gap });
    this.#draw();
    const coefficients = await snapshot(job.id);
    if (!coefficients) return;
    this.viewer.preview(new SoftMap(null, source, target, coefficients));
    if (this.viewer.brush.vertex < 0 && this.pairs.length) this.viewer.brush.moveTo(this.pairs[0][0]);
  }

  /** @returns {import("./tools.js").Tool} */
  #tool() {
    const { stage, brush } = this.viewer;
    return {
      name: "landmarks", text: "landmarks", key: "l", title: "", hint: "Click a point of the source, then where it goes on the target.",
      begin: () => false,
      move: () => {},
      end: () => {},
      click: (pane, hit) => {
        const vertex = pane.surface.vertexOf(hit);
        if (pane === stage.source) {
          this.waiting = vertex;
          brush.moveTo(vertex);
          this.#show();
          this.viewer.say(`Source vertex ${vertex}: now click where it goes on the target.`);
        } else if (this.waiting >= 0) {
          this.set([...this.pairs.filter(([v0]) => v0 !== this.waiting), [this.waiting, vertex]]);
        }
      },
    };
  }

  /** Markers, list and button say which pairs there are. */
  #show() {
    const { brush, stage } = this.viewer;
    const both = stage.source.surface && stage.target.surface;
    this.go.disabled = this.pairs.length === 0 || !both;
    for (const side of /** @type {const} */ (["source", "target"])) {
      const mine = this.pairs.map((pair, k) => ({ vertex: pair[side === "source" ? 0 : 1], colour: PIN_COLOURS[k % PIN_COLOURS.length], owner: this }));
      brush.others[side] = [...brush.others[side].filter((one) => one.owner !== this), ...(both ? mine : [])];
    }
    if (this.waiting >= 0) brush.others.source.push({ vertex: this.waiting, colour: [0.2, 0.2, 0.2], owner: this });
    this.list.replaceChildren(
      ...this.pairs.map(([v0, v], k) => {
        const dot = h("span", { class: "dot" });
        dot.style.background = css(PIN_COLOURS[k % PIN_COLOURS.length]);
        const remove = h("button", { type: "button", class: "quiet", "aria-label": `Remove the landmark ${v0} to ${v}`, onclick: () => this.set(this.pairs.filter((pair) => pair[0] !== v0)) }, "✕");
        return h("li", { "data-landmark": `${v0}:${v}` }, dot, h("span", { class: "grow" }, `${v0} → ${v}`), remove);
      }),
    );
    brush.mark();
  }

  /** Landmarks belong to their meshes. */
  #anew() {
    const { source, target } = this.viewer.stage;
    const same = this.surfaces?.[0] === source.surface && this.surfaces?.[1] === target.surface;
    this.surfaces = [source.surface, target.surface];
    if (!same) this.set([]);
    else this.#show();
  }

  /** @param {string | undefined} text */
  #read(text) {
    const { source, target } = this.viewer.stage;
    if (!text || !source.surface || !target.surface) return;
    const pairs = text.split(",").map((pair) => /** @type {[number, number]} */ (pair.split(":").map(Number)));
    const fits = (/** @type {number} */ v, /** @type {any} */ surface) => Number.isInteger(v) && v >= 0 && v < surface.nVertices;
    if (pairs.every(([v0, v]) => fits(v0, source.surface) && fits(v, target.surface))) this.set(pairs);
  }

  /** The energy and what no map is below, over iterations. */
  #draw() {
    const { course } = this;
    const [width, height] = [290, 90];
    const bounds = [];
    for (const { energy, gap } of course) bounds.push(Math.max(energy - gap, bounds.at(-1) ?? -Infinity));
    const energies = course.map(({ energy }) => energy);
    const last = energies.at(-1) ?? 1;
    // What the first steps were is of no interest once the end is near.
    const [low, high] = [Math.max(Math.min(...bounds), 0.4 * last), Math.min(Math.max(...energies), 1.6 * last)];
    const line = (/** @type {number[]} */ values, /** @type {string} */ colour) => {
      const curve = document.createElementNS(SVG, "polyline");
      const at = values.map((value, k) => {
        const y = height - 16 - ((Math.min(Math.max(value, low), high) - low) / (high - low || 1)) * (height - 24);
        return `${(6 + (k / Math.max(1, values.length - 1)) * (width - 12)).toFixed(1)},${y.toFixed(1)}`;
      });
      for (const [name, value] of Object.entries({ points: at.join(" "), fill: "none", stroke: colour, "stroke-width": "2" })) curve.setAttribute(name, value);
      return curve;
    };
    const label = document.createElementNS(SVG, "text");
    for (const [name, value] of Object.entries({ x: "6", y: String(height - 4), "font-size": "10", fill: "currentColor" })) label.setAttribute(name, value);
    label.textContent = `energy ${short(last)} and proven bound ${short(bounds.at(-1) ?? 0)} over ${course.length} iterations`;
    this.chart.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.chart.setAttribute("aria-label", label.textContent);
    this.chart.replaceChildren(line(bounds, css(PIN_COLOURS[1])), line(energies, css(PIN_COLOURS[0])), label);
    this.chart.removeAttribute("hidden");
  }
}

/** Energy and gap after each iteration of one search. @param {string} id */
async function history(id) {
  const [energy, gap] = await Promise.all(["history_energy", "history_gap"].map((name) => array(id, name)));
  return Array.from(energy.data, (value, k) => ({ energy: value, gap: gap.data[k] }));
}
