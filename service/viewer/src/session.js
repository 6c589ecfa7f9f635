/** What is looked at: a soft map in two views, its brush and layers, and the link that shows it again. */

import { Brush } from "./brush.js";
import { h } from "./dom.js";
import { Layer } from "./layers.js";
import { readLink, writeLink } from "./link.js";
import { Rig } from "./rig.js";
import { loadSoftMap, surfaceOf } from "./softmap.js";
import { Stage } from "./stage.js";
import { extentOf, percentiles, short } from "./statistics.js";

/** Milliseconds of stillness after which the address follows. */
const LINK_DELAY = 250;

export class Viewer {
  /** @param {{canvases: {source: HTMLCanvasElement, target: HTMLCanvasElement}, overlays: {source: HTMLElement, target: HTMLElement},
   *          status: HTMLElement}} parts @param {import("./jobs.js").Jobs} jobs */
  constructor({ canvases, overlays, status }, jobs) {
    this.jobs = jobs;
    this.status = status;
    this.overlays = overlays;
    this.events = new EventTarget();
    /** Draws instead of turning, if it wants to; see tools. @type {?import("./stage.js").Listener} */
    this.tool = null;
    this.stage = new Stage(canvases, {
      click: (pane, hit) => (this.tool ? this.tool.click(pane, hit) : this.#pin(pane, hit)),
      begin: (pane, hit) => this.tool?.begin(pane, hit) ?? false,
      move: (pane, x, y) => this.tool?.move(pane, x, y),
      end: () => this.tool?.end(),
    });
    this.brush = new Brush(this.stage, () => this.#brushed());
    this.layers = {
      source: new Layer(this.stage.source, overlays.source, () => this.stage.draw(this.stage.source)),
      target: new Layer(this.stage.target, overlays.target, () => this.stage.draw(this.stage.target)),
    };
    this.headings = {
      source: h("h2", {}, h("span", { class: "empty" }, "Drop the source mesh here, or take the built-in pair")),
      target: h("h2", {}, h("span", { class: "empty" }, "Drop the target mesh here")),
    };
    /** Where the brush is; an element, so that moving it draws no surface anew. */
    this.cursor = h("div", { class: "cursor", hidden: true });
    overlays.source.append(this.cursor);
    for (const side of /** @type {const} */ (["source", "target"])) overlays[side].prepend(this.headings[side]);
    /** @type {?import("./softmap.js").SoftMap} */
    this.softmap = null;
    /** Further parts of the link, by name. @type {Map<string, () => string | number | null>} */
    this.linked = new Map();
    this.stage.beforeFrame = () => this.#hover();
    this.linkTimer = 0;
  }

  /** @param {string} text in the line below the views */
  say(text) {
    this.status.textContent = text;
  }

  /** @param {string} name @param {any} [detail] */
  emit(name, detail) {
    this.events.dispatchEvent(new CustomEvent(name, { detail }));
    this.keepLink();
  }

  /** @param {string} name @param {(detail: any) => void} listener */
  on(name, listener) {
    this.events.addEventListener(name, (event) => listener(/** @type {CustomEvent} */ (event).detail));
  }

  /** Show what the address says. */
  async open() {
    const link = readLink();
    const [rig, other] = [Rig.of(link.camera ?? ""), Rig.of(link.camera2 ?? "")];
    if (link.softmap) await this.showSoftMap(link.softmap);
    else if (link.source || link.target) await this.showMeshes(link.source ?? null, link.target ?? null);
    if (rig) this.stage.source.rig.become(rig);
    if (other) {
      this.stage.link(false);
      this.stage.target.rig.become(other);
    }
    for (const vertex of numbers(link.pins)) if (this.#isSourceVertex(vertex)) this.brush.pin(vertex);
    for (const vertex of numbers(link.vertex)) if (this.#isSourceVertex(vertex)) this.brush.moveTo(vertex);
    this.emit("opened", link);
  }

  /** @param {?string} source @param {?string} target ids of meshes */
  async showMeshes(source, target) {
    this.softmap = null;
    this.brush.setSoftMap(null);
    const [first, second] = await Promise.all([source ? surfaceOf(source) : null, target ? surfaceOf(target) : null]);
    this.#setSurfaces(first, second);
    this.emit("meshes");
  }

  /** @param {string} id */
  async showSoftMap(id) {
    this.say("loading the soft map …");
    const began = performance.now();
    const softmap = await loadSoftMap(id);
    this.softmap = softmap;
    const again = this.stage.source.surface === softmap.source.surface && this.stage.target.surface === softmap.target.surface;
    if (!again) this.#setSurfaces(softmap.source.surface, softmap.target.surface);
    this.brush.setSoftMap(softmap);
    this.brush.mark();
    this.brush.evaluate();
    this.say(`loaded in ${((performance.now() - began) / 1000).toFixed(2)} s; move over the source`);
    this.emit("softmap");
  }

  /** Let the brush paint with a soft map that has no name yet. @param {import("./softmap.js").SoftMap} softmap */
  preview(softmap) {
    if (softmap.source.surface !== this.stage.source.surface || softmap.target.surface !== this.stage.target.surface) return;
    this.brush.setSoftMap(softmap);
    if (this.brush.shown || !this.softmap) this.showBrush();
  }

  /** Let the target show μ_x. @param {Partial<import("./layers.js").Scale>} [scale] */
  showBrush(scale = {}) {
    const paint = this.stage.target.paint;
    if (!paint) return;
    this.brush.shown = true;
    if (this.brush.vertex < 0) paint.numbers.fill(0);
    this.layers.target.show({ domain: "vertex", values: paint.numbers, title: "μₓ", unit: "per area", fading: true }, scale);
    this.brush.evaluate();
    this.layers.target.refreshRange();
    this.brush.tint();
  }

  /** @param {?import("./surface.js").Surface} source @param {?import("./surface.js").Surface} target */
  #setSurfaces(source, target) {
    const { stage } = this;
    stage.source.setSurface(source);
    stage.target.setSurface(target);
    const shown = source ?? target;
    if (shown) {
      const up = upOf(shown);
      stage.changeRigs((rig) => void (rig.up = up));
    }
    for (const [side, surface] of /** @type {const} */ ([["source", source], ["target", target]])) {
      this.headings[side].replaceChildren(
        side,
        ...(surface ? [h("small", {}, ` ${surface.name} · ${surface.nVertices.toLocaleString("en")} vertices`)] : []),
      );
    }
    stage.fit();
    stage.dress();
  }

  /** Before a frame: the brush follows the pointer. */
  #hover() {
    const { pointer } = this.stage;
    this.keepLink();
    if (this.stage.source.stale) this.#placeCursor();
    if (!pointer || !this.brush.softmap || pointer.pane !== this.stage.source) return;
    this.stage.pointer = null;
    const hit = pointer.pane.pick(pointer.x, pointer.y);
    if (hit) this.brush.moveTo(pointer.pane.surface.vertexOf(hit));
  }

  /** @param {import("./pane.js").Pane} pane @param {import("./bvh.js").Hit} hit */
  #pin(pane, hit) {
    if (pane !== this.stage.source || !this.brush.softmap) return;
    this.brush.moveTo(pane.surface.vertexOf(hit));
    this.brush.pin(this.brush.vertex);
  }

  #brushed() {
    const { vertex, peak, peakDensity, shown } = this.brush;
    if (shown) this.layers.target.refreshRange();
    this.#placeCursor();
    if (vertex >= 0) this.say(`source vertex ${vertex} → peak at target vertex ${peak}, density ${short(peakDensity)} (uniform is 1)`);
    this.emit("brush");
  }

  #placeCursor() {
    const { vertex } = this.brush;
    this.cursor.hidden = vertex < 0 || !this.brush.softmap;
    if (this.cursor.hidden) return;
    const { x, y } = this.stage.source.seen(vertex);
    this.cursor.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
  }

  /** @param {number} vertex */
  #isSourceVertex(vertex) {
    return Number.isInteger(vertex) && vertex >= 0 && vertex < (this.softmap?.source.surface.nVertices ?? 0);
  }

  /** Write the link soon. */
  keepLink() {
    clearTimeout(this.linkTimer);
    this.linkTimer = window.setTimeout(() => writeLink(this.parts()), LINK_DELAY);
  }

  /** @returns {Record<string, string | number | null>} what the link holds */
  parts() {
    const { stage, brush, softmap } = this;
    const meshes = softmap ? {} : { source: stage.source.surface?.id ?? null, target: stage.target.surface?.id ?? null };
    return {
      softmap: softmap?.id ?? null,
      ...meshes,
      vertex: brush.vertex >= 0 ? brush.vertex : null,
      pins: brush.pins.map((pin) => pin.vertex).join(","),
      camera: stage.source.surface || stage.target.surface ? String(stage.source.rig) : null,
      camera2: stage.linked ? null : String(stage.target.rig),
      ...Object.fromEntries([...this.linked].map(([name, value]) => [name, value()])),
    };
  }
}

/** @param {string | undefined} text @returns {number[]} */
const numbers = (text) => (text ? text.split(",").map(Number) : []);

/**
 * Which axis is up, which no file says: the one along which the surface stands on the broadest feet.
 *
 * @param {import("./surface.js").Surface} surface
 */
function upOf({ positions }) {
  const breadth = [1, 2].map((up) => {
    const lows = percentiles(positions.filter((_, k) => k % 3 === up), positions.length / 3, [0, 100]);
    const floor = lows[0] + 0.04 * (lows[1] - lows[0]);
    const sides = [0, 1, 2].filter((axis) => axis !== up);
    const spread = sides.map((axis) => {
      const all = positions.filter((_, k) => k % 3 === axis);
      const feet = all.filter((_, k) => positions[3 * k + up] <= floor);
      const [low, high] = extentOf(feet, feet.length);
      const [lowest, highest] = extentOf(all, all.length);
      return (high - low) / (highest - lowest || 1);
    });
    return spread[0] * spread[1];
  });
  return breadth[1] > breadth[0] ? "z" : "y";
}
