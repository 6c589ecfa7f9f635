/** Two views side by side, each drawn when something in it changed, and what the pointer does to them. */

import { Pane } from "./pane.js";
import { Rig } from "./rig.js";

/** Pixels that a click may move. */
const CLICK_PIXELS = 4;
const TURN_PER_PIXEL = 0.008;
/** Milliseconds without a frame after which nothing moves. */
const STILL = 300;
const ZOOM_PER_NOTCH = 1.0015;

/** @type {Record<string, import("./pane.js").Theme>} */
export const THEMES = {
  light: { light: true, background: 0xf6f6f4, clay: 0xd5d2cb, wire: 0x3c3c40 },
  dark: { light: false, background: 0x17181b, clay: 0x8d8f95, wire: 0x0c0c0e },
};

/**
 * @typedef {object} Listener what happens on the surfaces
 * @property {(pane: Pane, hit: import("./bvh.js").Hit) => void} click
 * @property {(pane: Pane, hit: import("./bvh.js").Hit) => boolean} begin whether a drag from here draws
 * @property {(pane: Pane, x: number, y: number) => void} move while drawing
 * @property {() => void} end of drawing
 */

export class Stage {
  /** @param {{source: HTMLCanvasElement, target: HTMLCanvasElement}} canvases @param {Listener} listener */
  constructor(canvases, listener) {
    this.listener = listener;
    const rig = new Rig();
    this.source = new Pane("source", canvases.source, rig);
    this.target = new Pane("target", canvases.target, rig);
    this.panes = [this.source, this.target];
    this.look = { wires: false, smooth: true };
    this.theme = THEMES.light;
    this.asked = false;
    /** Called at the start of each frame: what must be drawn is worked out once a frame, not once an event. */
    this.beforeFrame = () => {};
    /** Milliseconds of the last frames: from its start to the end of its drawing commands. */
    this.frames = /** @type {number[]} */ ([]);
    /** When the last frame was drawn, and the timer of the one that follows when all is still. */
    this.drawn = -STILL;
    this.settling = 0;
    /** Where the pointer was since the last frame. @type {?{pane: Pane, x: number, y: number}} */
    this.pointer = null;
    for (const pane of this.panes) {
      new ResizeObserver(() => this.#resize(pane)).observe(pane.canvas);
      pane.resize();
      this.#listen(pane);
    }
  }

  get linked() {
    return this.source.rig === this.target.rig;
  }

  /** @param {boolean} linked */
  link(linked) {
    if (linked !== this.linked) this.target.rig = linked ? this.source.rig : this.source.rig.copy();
    this.draw();
  }

  /** @param {"light" | "dark"} name */
  setTheme(name) {
    this.theme = THEMES[name];
    this.dress();
  }

  dress() {
    for (const pane of this.panes) pane.dress(this.theme, this.look);
    this.draw();
  }

  fit() {
    if (this.linked) {
      const shown = this.panes.filter((pane) => pane.surface).map((pane) => pane.surface.positions);
      if (shown.length) this.source.rig.fit(shown, this.source.aspect);
    } else {
      for (const pane of this.panes) pane.fit();
    }
    this.draw();
  }

  /** @param {(rig: Rig) => void} change applied once to each rig */
  changeRigs(change) {
    for (const rig of new Set(this.panes.map((pane) => pane.rig))) change(rig);
    this.draw();
  }

  /** @param {Pane} pane */
  #resize(pane) {
    pane.resize();
    this.draw(pane);
  }

  /** Ask for a frame. @param {...Pane} panes that changed; both unless given */
  draw(...panes) {
    for (const pane of panes.length ? panes : this.panes) pane.stale = true;
    this.wake();
  }

  /** Ask for a look at the pointer at the next frame. */
  wake() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      this.drawNow();
    });
  }

  drawNow() {
    const began = performance.now();
    this.beforeFrame();
    const moving = began - this.drawn < STILL;
    for (const pane of this.panes) {
      if (!pane.stale) continue;
      pane.setDetail(!moving);
      pane.render();
      this.drawn = performance.now();
    }
    clearTimeout(this.settling);
    if (!this.resting) this.settling = window.setTimeout(() => this.#settle(), STILL);
    this.frames.push(performance.now() - began);
    if (this.frames.length > 600) this.frames.shift();
  }

  /** Whether everything is drawn, with every pixel. */
  get resting() {
    return !this.asked && this.panes.every((pane) => pane.fine && !pane.stale);
  }

  /** Draw with every pixel what was drawn coarsely while it moved. */
  #settle() {
    const coarse = this.panes.filter((pane) => !pane.fine);
    if (coarse.length) this.draw(...coarse);
  }

  /** @returns {Promise<Blob>} both views as one PNG */
  picture() {
    for (const pane of this.panes) pane.setDetail(true);
    const ratio = this.source.renderer.getPixelRatio();
    const whole = document.createElement("canvas");
    whole.width = Math.round((this.source.width + this.target.width) * ratio);
    whole.height = Math.round(this.source.height * ratio);
    const brush = /** @type {CanvasRenderingContext2D} */ (whole.getContext("2d"));
    for (const pane of this.panes) {
      // A canvas can be read only in the task that drew it.
      pane.render();
      brush.drawImage(pane.canvas, pane === this.source ? 0 : whole.width - pane.canvas.width, 0);
    }
    return new Promise((resolve, reject) =>
      whole.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("no picture could be taken"))), "image/png"),
    );
  }

  /** @param {Pane} pane */
  #listen(pane) {
    const { listener } = this;
    const { canvas } = pane;
    /** @type {?{x: number, y: number, lastX: number, lastY: number, pans: boolean, draws: boolean, moved: boolean}} */
    let drag = null;

    canvas.addEventListener("pointerdown", (event) => {
      canvas.focus({ preventScroll: true });
      canvas.setPointerCapture(event.pointerId);
      const [x, y] = [event.offsetX, event.offsetY];
      const pans = event.button !== 0 || event.shiftKey || event.ctrlKey;
      const hit = pans ? null : pane.pick(x, y);
      const draws = hit !== null && listener.begin(pane, hit);
      drag = { x, y, lastX: x, lastY: y, pans, draws, moved: false };
      event.preventDefault();
    });
    canvas.addEventListener("pointermove", (event) => {
      const [x, y] = [event.offsetX, event.offsetY];
      if (!drag) {
        this.pointer = { pane, x, y };
        this.wake();
        return;
      }
      if (Math.hypot(x - drag.x, y - drag.y) > CLICK_PIXELS) drag.moved = true;
      if (!drag.moved) return;
      const { rig, height } = pane;
      if (drag.draws) listener.move(pane, x, y);
      else if (drag.pans) rig.pan((2 * (x - drag.lastX)) / height, (2 * (drag.lastY - y)) / height);
      else rig.turn((x - drag.lastX) * TURN_PER_PIXEL, (y - drag.lastY) * TURN_PER_PIXEL);
      [drag.lastX, drag.lastY] = [x, y];
      this.#changed(pane);
    });
    const release = (/** @type {PointerEvent} */ event) => {
      if (drag?.draws) listener.end();
      else if (drag && !drag.moved && !drag.pans && event.type === "pointerup") {
        const hit = pane.pick(drag.x, drag.y);
        if (hit) listener.click(pane, hit);
      }
      drag = null;
    };
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("pointerleave", () => {
      this.pointer = null;
    });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener(
      "wheel",
      (event) => {
        const { rig, width, height } = pane;
        const factor = ZOOM_PER_NOTCH ** -(event.deltaY * (event.deltaMode === 1 ? 30 : 1));
        // What is under the pointer stays there.
        const right = (2 * event.offsetX - width) / height;
        const up = (height - 2 * event.offsetY) / height;
        rig.pan(-right, -up);
        rig.zoom(factor);
        rig.pan(right, up);
        this.#changed(pane);
        event.preventDefault();
      },
      { passive: false },
    );
  }

  /** A camera moved. @param {Pane} pane */
  #changed(pane) {
    if (this.linked) this.draw();
    else this.draw(pane);
  }
}
