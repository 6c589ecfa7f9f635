/** The tool in hand: what a click and a drag on a surface do. */

import { h } from "./dom.js";

/**
 * @typedef {import("./stage.js").Listener & {name: string, text: string, key: string, title: string, hint: string,
 *           chosen?: () => void}} Tool
 */

export class Tools {
  /** @param {import("./session.js").Viewer} viewer @param {HTMLElement} toolbar @param {HTMLElement} stage */
  constructor(viewer, toolbar, stage) {
    this.viewer = viewer;
    this.stage = stage;
    /** @type {Array<{tool: ?Tool, button: HTMLButtonElement}>} */
    this.all = [];
    this.toolbar = toolbar;
    toolbar.setAttribute("role", "radiogroup");
    this.add(null, "brush", "b", "Paint with the pointer, click to pin (B)");
    this.choose(null);
    document.addEventListener("keydown", (event) => {
      const typing = event.target instanceof Element && event.target.matches("input, textarea, select");
      if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
      const found = this.all.find(({ button }) => button.dataset.key === event.key.toLowerCase());
      if (event.key === "Escape") this.choose(null);
      else if (found) this.choose(found.tool);
      else return;
      event.preventDefault();
    });
  }

  /** @param {?Tool} tool @param {string} text @param {string} key @param {string} title */
  add(tool, text, key, title) {
    const button = h("button", { type: "button", role: "radio", "data-key": key, title, onclick: () => this.choose(tool) }, text);
    this.all.push({ tool, button });
    this.toolbar.append(button);
  }

  /** @param {?Tool} tool null is the brush */
  choose(tool) {
    this.viewer.tool = tool;
    for (const one of this.all) one.button.setAttribute("aria-checked", String(one.tool === tool));
    this.stage.classList.toggle("draws", tool !== null);
    tool?.chosen?.();
    if (tool) this.viewer.say(tool.hint);
  }
}
