/** How the views are looked at: cameras, wireframe, shading, theme, and their keys. */

import { h, toggle } from "./dom.js";
import { Rig } from "./rig.js";

const TURN = 0.12;

export class Look {
  /** @param {import("./session.js").Viewer} viewer @param {HTMLElement} toolbar */
  constructor(viewer, toolbar) {
    const { stage } = viewer;
    this.viewer = viewer;
    const buttons = {
      link: toggle("linked", { title: "Both views share one camera (K)", pressed: true, onToggle: (on) => (stage.link(on), viewer.keepLink()) }),
      flat: toggle("orthographic", { title: "Parallel projection (O)", onToggle: (on) => this.#rigs((rig) => void (rig.orthographic = on)) }),
      wires: toggle("wireframe", { title: "Edges of the triangles (W)", onToggle: (on) => this.#dress({ wires: on }) }),
      smooth: toggle("smooth", { title: "Smooth shading, or each face flat (S)", pressed: true, onToggle: (on) => this.#dress({ smooth: on }) }),
      up: h("button", { type: "button", title: "Which axis points up (U)", onclick: () => this.#turnUp() }, "up: y"),
      fit: h("button", { type: "button", title: "See everything (F)", onclick: () => stage.fit() }, "fit"),
      theme: h("button", { type: "button", title: "Light or dark (T)", onclick: () => this.#setTheme(stage.theme.light ? "dark" : "light") }, "theme"),
    };
    this.buttons = buttons;
    toolbar.append(...Object.values(buttons));
    this.keys = { k: buttons.link, o: buttons.flat, w: buttons.wires, s: buttons.smooth, u: buttons.up, f: buttons.fit, t: buttons.theme };
    this.#setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    for (const pane of stage.panes) pane.canvas.addEventListener("keydown", (event) => this.#steer(pane, event));
    document.addEventListener("keydown", (event) => this.#press(event));
    viewer.linked.set("look", () => this.#written());
    for (const change of ["meshes", "softmap"]) viewer.on(change, () => this.#refresh());
    viewer.on("opened", (link) => this.#read(link.look ?? ""));
  }

  /** @param {(rig: Rig) => void} change */
  #rigs(change) {
    this.viewer.stage.changeRigs(change);
    this.viewer.keepLink();
    this.#refresh();
  }

  /** @param {{wires?: boolean, smooth?: boolean}} change */
  #dress(change) {
    Object.assign(this.viewer.stage.look, change);
    this.viewer.stage.dress();
    this.viewer.keepLink();
  }

  #turnUp() {
    const up = this.viewer.stage.source.rig.up === "y" ? "z" : "y";
    this.#rigs((rig) => void (rig.up = up));
  }

  /** @param {"light" | "dark"} name */
  #setTheme(name) {
    document.documentElement.dataset.theme = name;
    this.viewer.stage.setTheme(name);
    for (const layer of Object.values(this.viewer.layers)) layer.apply();
    this.viewer.keepLink();
  }

  /** Let the buttons say how things are. */
  #refresh() {
    const { stage } = this.viewer;
    const { link, flat, wires, smooth, up } = this.buttons;
    /** @type {Array<[HTMLElement, boolean]>} */
    const states = [
      [link, stage.linked],
      [flat, stage.source.rig.orthographic],
      [wires, stage.look.wires],
      [smooth, stage.look.smooth],
    ];
    for (const [button, on] of states) button.setAttribute("aria-pressed", String(on));
    up.textContent = `up: ${stage.source.rig.up}`;
  }

  /** What differs from the start, as words. */
  #written() {
    const { stage } = this.viewer;
    return [stage.look.wires && "wires", !stage.look.smooth && "flat", stage.theme.light ? "light" : "dark"].filter(Boolean).join(",");
  }

  /** @param {string} words */
  #read(words) {
    const said = new Set(words.split(","));
    this.#dress({ wires: said.has("wires"), smooth: !said.has("flat") });
    if (said.has("light")) this.#setTheme("light");
    if (said.has("dark")) this.#setTheme("dark");
    this.#refresh();
  }

  /** Arrow keys turn a view, with shift they move it; plus and minus zoom. @param {import("./pane.js").Pane} pane @param {KeyboardEvent} event */
  #steer(pane, event) {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const { rig } = pane;
    if (way && event.shiftKey) rig.pan(-0.1 * way[0], 0.1 * way[1]);
    else if (way) rig.turn(TURN * way[0], TURN * way[1]);
    else if (event.key === "+" || event.key === "=") rig.zoom(1.15);
    else if (event.key === "-") rig.zoom(1 / 1.15);
    else return;
    event.preventDefault();
    this.viewer.stage.draw();
    this.viewer.keepLink();
  }

  /** @param {KeyboardEvent} event */
  #press(event) {
    const typing = event.target instanceof Element && event.target.matches("input, textarea, select");
    if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
    const button = this.keys[/** @type {keyof typeof this.keys} */ (event.key.toLowerCase())];
    if (!button) return;
    button.click();
    event.preventDefault();
  }
}
