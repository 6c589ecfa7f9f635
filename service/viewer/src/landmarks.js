/** Optimal maps: landmarks as clicked pairs, and the search that is watched as it nears the optimum. */

import { array, artifact } from "./api.js";
import { PIN_COLOURS, css } from "./colours.js";
import { h, labelled } from "./dom.js";
import { JobDismissed, inWords } from "./jobs.js";
import { short } from "./statistics.js";

/** Gaps over energies at which the search is looked at; each begins where the one before ended. */
const TOLERANCES = [0.3, 0.1, 0.03, 0.01, 0.003, 0.001];
const SVG = "http://www.w3.org/2000/svg";

export class Landmarks {
  /** @param {import("./session.js").Viewer} viewer @param {HTMLElement} parent @param {import("./tools.js").Tools} tools
   *  @param {import("./question.js").Question} question */
  constructor(viewer, parent, tools, question) {
    this.viewer = viewer;
    this.question = question;
    /** @type {Array<[number, number]>} source and target vertex */
    this.pairs = [];
    /** Source vertex that waits for its target. */
    this.waiting = -1;
    this.weight = h("input", { type: "number", min: 0, step: 0.1, value: 1 });
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

  /** Search the optimal map from tolerance to tolerance, showing each. */
  async optimise() {
    const { viewer, question } = this;
    const points = [0, 1].map((side) => [...new Set(this.pairs.map((pair) => pair[side]))]);
    const bases = { source: question.basis("source", points[0]), target: question.basis("target", points[1]) };
    const weight = this.weight.valueAsNumber;
    /** @type {Array<{energy: number, gap: number}>} */
    const course = [];
    this.complaint.hidden = true;
    this.go.disabled = true;
    try {
      let start = null;
      for (const tolerance of TOLERANCES) {
        const map = { type: "optimal", landmarks: this.pairs, bijectivity_weight: weight, tolerance, ...(start ? { start } : {}) };
        const title = `optimal map to ${short(100 * tolerance)} %`;
        const id = await viewer.jobs.run({ kind: "softmap", ...bases, map }, title, (job) => {
          this.note.textContent = `${title}: ${job.phase || job.status}`;
        });
        const { values } = await artifact(id);
        course.push(...(await history(id)));
        this.#draw(course);
        await viewer.showSoftMap(id);
        const gap = `${short((100 * values.gap) / values.energy)} %`;
        this.note.textContent = `Energy ${short(values.energy)} (Dirichlet ${short(values.dirichlet)}); no map is more than ${gap} better. ${course.length} iterations.`;
        start = id;
        if (!values.converged) break;
      }
      await question.refresh();
    } catch (error) {
      if (!(error instanceof JobDismissed)) {
        this.complaint.textContent = inWords(error);
        this.complaint.hidden = false;
      } else this.note.textContent = error.message;
    }
    this.#show();
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

  /** The energy and what no map is below, over iterations. @param {Array<{energy: number, gap: number}>} course */
  #draw(course) {
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
