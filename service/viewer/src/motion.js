/** Where mass moves: a direction dragged on the source and its arrows, a path drawn on it and the path traced. */

import { array, artifact } from "./api.js";
import { arrowsOn, lengthsOf, oneArrow } from "./arrows.js";
import { choice, h, labelled } from "./dom.js";
import { inWords } from "./jobs.js";
import { peakOf } from "./softmap.js";
import { short } from "./statistics.js";
import { dot, minus } from "./surface.js";

const DRAWN = [0.84, 0.37, 0];
const TRACED = [0.8, 0.1, 0.45];
/** Milliseconds for which a traced path grows. */
const GROWTH = 1600;
/** Least distance between two vertices of a drawn path, in √area. */
const STRIDE = 0.05;
/** Height of an arrow above its face, in √area. */
const LIFT = 0.015;
/** Shortest arrow that counts as a direction, in √area. */
const SHORTEST = 0.01;

export class Motion {
  /** @param {import("./session.js").Viewer} viewer @param {HTMLElement} parent @param {import("./tools.js").Tools} tools */
  constructor(viewer, parent, tools) {
    this.viewer = viewer;
    this.vector = /** @type {"momentum" | "velocity"} */ ("momentum");
    this.size = 1;
    /** @type {?{face: number, direction: number[], at: number[]}} */
    this.asked = null;
    /** @type {?{velocity: Float64Array, momentum: Float64Array}} */
    this.answer = null;
    /** Source vertices of the path, and the target vertex where it begins. */
    this.path = /** @type {number[]} */ ([]);
    this.start = -1;
    this.turn = 0;
    const which = choice([["momentum", "momentum"], ["velocity", "velocity"]], "momentum", (value) => this.#redraw({ vector: value }), "Arrows");
    const size = h("input", { type: "range", min: 0.3, max: 3, step: 0.1, value: 1, "aria-label": "Size of the arrows", oninput: () => this.#redraw({ size: size.valueAsNumber }) });
    this.note = h("p", { class: "note", role: "status" }, "Direction (D): drag an arrow on the source. Path (P): draw on the source, then click a start on the target.");
    this.complaint = h("p", { class: "bad", role: "alert", hidden: true });
    const clear = h("button", { type: "button", onclick: () => this.clear() }, "clear");
    parent.append(labelled("arrows", h("span", { class: "pair" }, which, size, clear)), this.note, this.complaint);
    tools.add(this.#direction(), "direction", "d", "Drag a direction on the source, see where mass moves on the target (D)");
    tools.add(this.#drawing(), "path", "p", "Draw a path on the source, choose its start on the target (P)");
    viewer.on("softmap", () => this.#anew());
    viewer.on("meshes", () => this.clear());
    viewer.linked.set("direction", () => this.asked && [this.asked.face, ...this.asked.direction.map((x) => Number(x.toPrecision(6)))].join(","));
    viewer.linked.set("path", () => (this.path.length ? this.path.join(",") : null));
    viewer.linked.set("start", () => (this.start >= 0 ? this.start : null));
    viewer.on("opened", (link) => this.#read(link));
  }

  clear() {
    this.turn++;
    this.asked = this.answer = null;
    this.path = [];
    this.start = -1;
    this.#draw();
    this.viewer.keepLink();
  }

  /** Ask how mass moves as the source point moves in a face. @param {number} face @param {number[]} direction in the file's units */
  async ask(face, direction) {
    const { viewer } = this;
    const { softmap, stage } = viewer;
    const turn = ++this.turn;
    this.asked = { face, direction, at: stage.source.surface.faceCentre(face) };
    this.answer = null;
    this.#draw();
    await this.#attempt(async () => {
      const spec = { kind: "momentum", softmap: softmap.id, face, direction };
      const id = await viewer.jobs.run(spec, "momentum");
      const [velocity, momentum] = await Promise.all(["velocity", "momentum"].map((name) => array(id, name)));
      if (turn !== this.turn) return;
      this.answer = { velocity: /** @type {Float64Array} */ (velocity.data), momentum: /** @type {Float64Array} */ (momentum.data) };
      const count = this.#draw();
      const longest = lengthsOf(this.answer[this.vector]).reduce((a, b) => Math.max(a, b), 0);
      this.note.textContent = `Face ${face}: ${count} arrows of ${this.vector}; the longest is ${short(longest)}.`;
    });
    viewer.keepLink();
  }

  /** Trace the path on the target that follows the drawn one. @param {number} start target vertex */
  async trace(start) {
    const { viewer } = this;
    const turn = ++this.turn;
    this.start = start;
    this.#draw();
    await this.#attempt(async () => {
      const spec = { kind: "path", softmap: viewer.softmap.id, source_path: this.path, start };
      const id = await viewer.jobs.run(spec, "path");
      const [{ values }, points] = await Promise.all([artifact(id), array(id, "points")]);
      if (turn !== this.turn) return;
      const stopped = values.stopped && values.stopped !== "end" ? `; it stopped: ${values.stopped}` : "";
      this.note.textContent = `Path of length ${short(values.length)}, ${points.shape[0]} points${stopped}.`;
      this.#grow(/** @type {Float64Array} */ (points.data), turn);
    });
    viewer.keepLink();
  }

  /** @param {Float64Array} points (k, 3) in the file's units @param {number} turn */
  #grow(points, turn) {
    const { stage } = this.viewer;
    const surface = stage.target.surface;
    const drawn = [];
    for (let k = 0; k < points.length; k += 3) drawn.push(...surface.drawn(points, k));
    const began = performance.now();
    const step = () => {
      if (turn !== this.turn || stage.target.surface !== surface) return;
      const part = Math.min(1, (performance.now() - began) / GROWTH);
      const n = Math.max(2, Math.round((part * drawn.length) / 3));
      stage.target.setCurves([{ points: drawn.slice(0, 3 * n), colour: TRACED, width: 5 }]);
      const at = this.path[Math.min(this.path.length - 1, Math.floor(part * this.path.length))];
      this.viewer.brush.moveTo(at);
      stage.draw();
      if (part < 1) requestAnimationFrame(step);
    };
    step();
  }

  /** @returns {import("./tools.js").Tool} */
  #direction() {
    /** @type {?{face: number, at: number[], normal: number[], along: number[]}} */
    let drag = null;
    const { stage, brush } = this.viewer;
    return {
      name: "direction", text: "direction", key: "d", title: "", hint: "Drag on the source: mass on the target moves as its point moves that way.",
      begin: (pane, hit) => {
        if (pane !== stage.source || !this.viewer.softmap) return false;
        brush.moveTo(pane.surface.vertexOf(hit));
        drag = { face: hit.face, at: pane.surface.faceCentre(hit.face), normal: pane.surface.faceNormal(hit.face), along: [0, 0, 0] };
        return true;
      },
      move: (pane, x, y) => {
        if (!drag) return;
        const { origin, direction } = pane.ray(x, y);
        const [o, d] = [origin.toArray(), direction.toArray()];
        const slope = dot(d, drag.normal);
        if (Math.abs(slope) < 1e-6) return;
        const t = dot(minus(drag.at, o), drag.normal) / slope;
        drag.along = minus([o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]], drag.at);
        this.#showArrow(drag.at, drag.along);
      },
      end: () => {
        if (drag && Math.hypot(...drag.along) > SHORTEST) {
          const unit = stage.source.surface.unit;
          this.ask(drag.face, drag.along.map((x) => x * unit));
        }
        drag = null;
      },
      click: () => {},
    };
  }

  /** @returns {import("./tools.js").Tool} */
  #drawing() {
    const { stage, brush } = this.viewer;
    return {
      name: "path", text: "path", key: "p", title: "", hint: "Draw a path on the source; then click where it shall begin on the target.",
      begin: (pane, hit) => {
        if (pane !== stage.source || !this.viewer.softmap) return false;
        this.turn++;
        this.path = [pane.surface.vertexOf(hit)];
        this.start = -1;
        stage.target.setCurves([]);
        brush.moveTo(this.path[0]);
        return true;
      },
      move: (pane, x, y) => {
        const hit = pane.pick(x, y);
        const vertex = hit ? pane.surface.vertexOf(hit) : -1;
        // Neighbouring vertices would zigzag; the service joins distant ones by shortest paths.
        if (vertex < 0 || Math.hypot(...minus(pane.surface.point(vertex), pane.surface.point(this.path.at(-1)))) < STRIDE) return;
        this.path.push(vertex);
        brush.moveTo(vertex);
        this.#draw();
      },
      end: () => {
        if (this.path.length < 2) {
          this.path = [];
          return;
        }
        brush.moveTo(this.path[0]);
        this.viewer.say(`A path of ${this.path.length} vertices. Click a start on the target, or press Enter for the peak at vertex ${brush.peak}.`);
        document.addEventListener("keydown", (event) => event.key === "Enter" && this.start < 0 && this.trace(brush.peak), { once: true });
      },
      click: (pane, hit) => {
        if (pane === stage.target && this.path.length >= 2) this.trace(pane.surface.vertexOf(hit));
      },
    };
  }

  /** @param {number[]} at @param {number[]} along */
  #showArrow(at, along) {
    const { source } = this.viewer.stage;
    const normal = this.asked ? source.surface.faceNormal(this.asked.face) : [0, 0, 0];
    // A straight arrow that begins on a curved surface would dive into it.
    source.setArrows(oneArrow(at.map((x, axis) => x + LIFT * normal[axis]), along, DRAWN));
    this.viewer.stage.draw(source);
  }

  /** Draw what was asked and what is known. @returns {number} how many arrows */
  #draw() {
    const { stage, brush } = this.viewer;
    let count = 0;
    if (stage.source.surface) {
      const { asked, path } = this;
      stage.source.setArrows(null);
      if (asked) {
        const length = Math.hypot(...asked.direction);
        this.#showArrow(asked.at, asked.direction.map((x) => (0.12 * x) / length));
      }
      const lift = (/** @type {number} */ v) => stage.source.surface.point(v).map((x, k) => x + 0.004 * stage.source.surface.normals[3 * v + k]);
      stage.source.setCurves(path.length > 1 ? [{ points: path.flatMap(lift), colour: DRAWN, width: 5 }] : []);
    }
    if (stage.target.surface) {
      stage.target.setArrows(null);
      if (this.answer) {
        const arrows = arrowsOn(stage.target.surface, this.answer[this.vector], this.answer.momentum, this.size, "black–red–yellow");
        stage.target.setArrows(arrows.mesh);
        count = arrows.count;
      }
      if (!this.path.length) stage.target.setCurves([]);
    }
    brush.others.target = brush.others.target.filter((one) => one.owner !== this);
    if (this.start >= 0) brush.others.target.push({ vertex: this.start, colour: TRACED, owner: this });
    brush.mark();
    return count;
  }

  /** @param {{vector?: any, size?: number}} change */
  #redraw(change) {
    Object.assign(this, change);
    this.#draw();
  }

  /** Ask again of another soft map of the same meshes. */
  #anew() {
    this.answer = null;
    const { source, target } = this.viewer.stage;
    const same = this.surfaces?.[0] === source.surface && this.surfaces?.[1] === target.surface;
    this.surfaces = [source.surface, target.surface];
    if (!same) this.clear();
    else if (this.asked) this.ask(this.asked.face, this.asked.direction);
  }

  /** @param {Record<string, string>} link */
  async #read(link) {
    const { softmap, brush } = this.viewer;
    if (!softmap) return;
    const { surface } = softmap.source;
    const [face, ...direction] = (link.direction ?? "").split(",").map(Number);
    if (direction.length === 3 && direction.every(Number.isFinite) && face >= 0 && face < surface.nFaces) await this.ask(face, direction);
    const path = (link.path ?? "").split(",").filter(Boolean).map(Number);
    if (path.length < 2 || !path.every((v) => Number.isInteger(v) && v >= 0 && v < surface.nVertices)) return;
    this.path = path;
    const scratch = new Float32Array(softmap.target.surface.nVertices);
    const start = link.start ? Number(link.start) : peakOf(softmap.distribution(path[0], scratch));
    if (brush.softmap) await this.trace(start);
  }

  /** @param {() => Promise<void>} what */
  async #attempt(what) {
    this.complaint.hidden = true;
    try {
      await what();
    } catch (error) {
      this.complaint.textContent = inWords(error);
      this.complaint.hidden = false;
    }
  }
}
