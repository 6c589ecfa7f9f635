/** What can be taken away: pictures, numbers, painted meshes, and the same questions for curl and Python. */

import { choice, h, labelled, offer, save } from "./dom.js";
import { colourTable } from "./colours.js";

export class Share {
  /** @param {import("./session.js").Viewer} viewer @param {HTMLElement} parent */
  constructor(viewer, parent) {
    this.viewer = viewer;
    const button = (/** @type {string} */ text, /** @type {string} */ title, /** @type {() => any} */ act) =>
      h("button", { type: "button", title, onclick: act }, text);
    this.what = choice([], "", () => this.#write(), "Question to copy");
    this.how = choice([["curl", "curl"], ["python", "Python"]], "curl", () => this.#write(), "Language to copy it in");
    this.code = h("textarea", { rows: 7, readonly: true, spellcheck: false, "aria-label": "Code that asks the same" });
    parent.append(
      h(
        "div",
        { class: "buttons" },
        button("screenshot", "Both views as PNG (X)", () => this.picture()),
        button("copy link", "An address that shows this view again", () => this.#copy(location.href)),
        button("source .ply", "The source with the colours it has now", () => this.ply("source")),
        button("target .ply", "The target with the colours it has now", () => this.ply("target")),
        button(".npz", "All arrays of the question chosen below", () => this.#download()),
      ),
      labelled("ask for", h("span", { class: "pair" }, this.what, this.how, button("copy", "Copy the code", () => this.#copy(this.code.value)))),
      this.code,
    );
    viewer.on("softmap", () => this.refresh());
    viewer.jobs.onAnswer = () => this.refresh();
  }

  /** Offer the questions behind what is shown. */
  refresh() {
    /** @type {Map<string, {id: string, spec: any}>} */
    this.questions = new Map();
    const { softmap, jobs } = this.viewer;
    if (softmap) this.questions.set("soft map", { id: softmap.id, spec: softmap.spec });
    for (const [title, one] of jobs.answered) if (!this.questions.has(title)) this.questions.set(title, one);
    const now = this.questions.has(this.what.value) ? this.what.value : (this.questions.keys().next().value ?? "");
    offer(this.what, [...this.questions.keys()].map((title) => [title, title]), now);
    this.#write();
  }

  async picture() {
    save("softmap.png", await this.viewer.stage.picture());
  }

  /** @param {"source" | "target"} side */
  ply(side) {
    const pane = this.viewer.stage[side];
    if (pane.surface) save(`${pane.surface.name.replace(/\.[a-z]+$/, "")}-painted.ply`, new Blob([plyOf(pane)], { type: "text/plain" }));
  }

  #download() {
    const chosen = this.questions?.get(this.what.value);
    if (chosen) h("a", { href: `/v1/artifacts/${chosen.id}.npz`, download: `${chosen.id}.npz` }).click();
  }

  /** @param {string} text */
  async #copy(text) {
    try {
      await navigator.clipboard.writeText(text);
      this.viewer.say("copied");
    } catch {
      // Only secure places have a clipboard; a person can still copy what is selected.
      this.code.value = text;
      this.code.select();
      this.viewer.say("press Ctrl-C to copy what is selected");
    }
  }

  #write() {
    const chosen = this.questions?.get(this.what.value);
    this.code.value = chosen ? (this.how.value === "curl" ? curl(chosen.spec, chosen.id) : python(chosen.spec)) : "";
  }
}

/** @param {any} spec @param {string} id @returns {string} */
export function curl(spec, id) {
  const body = JSON.stringify(spec).replaceAll("'", "'\\''");
  return [
    `curl -H 'Prefer: wait=60' -H 'Content-Type: application/json' ${location.origin}/v1/jobs -d '${body}'`,
    `curl -o ${id}.npz ${location.origin}/v1/artifacts/${id}.npz`,
  ].join("\n");
}

/** @param {any} spec @returns {string} */
export function python(spec) {
  return [
    "from service.client import Client",
    "",
    `spec = ${literal(spec)}`,
    `with Client("${location.origin}") as client:`,
    "    job = client.wait(client.submit(spec).id)",
    "    values, arrays = client.artifact(job.id).values, client.arrays(job.id)",
  ].join("\n");
}

/** @param {any} value @returns {string} a Python expression */
function literal(value) {
  if (value === null) return "None";
  if (typeof value === "boolean") return value ? "True" : "False";
  if (Array.isArray(value)) return `[${value.map(literal).join(", ")}]`;
  if (typeof value === "object") return `{${Object.entries(value).map(([key, one]) => `"${key}": ${literal(one)}`).join(", ")}}`;
  return JSON.stringify(value);
}

/** A surface in the file's units and order, with its colours at vertices or faces. @param {import("./pane.js").Pane} pane */
export function plyOf({ surface, paint }) {
  const { vertices, faces, nVertices, nFaces } = surface;
  const { domain, colours } = coloursOf(paint, nVertices, nFaces);
  const properties = ["property uchar red", "property uchar green", "property uchar blue"];
  const lines = [
    "ply", "format ascii 1.0",
    `element vertex ${nVertices}`, "property double x", "property double y", "property double z", ...(domain === "vertex" ? properties : []),
    `element face ${nFaces}`, "property list uchar int vertex_indices", ...(domain === "face" ? properties : []),
    "end_header",
  ];
  const colour = (/** @type {number} */ k) => ` ${colours[3 * k]} ${colours[3 * k + 1]} ${colours[3 * k + 2]}`;
  for (let v = 0; v < nVertices; v++) lines.push(`${vertices[3 * v]} ${vertices[3 * v + 1]} ${vertices[3 * v + 2]}${domain === "vertex" ? colour(v) : ""}`);
  for (let f = 0; f < nFaces; f++) lines.push(`3 ${faces[3 * f]} ${faces[3 * f + 1]} ${faces[3 * f + 2]}${domain === "face" ? colour(f) : ""}`);
  return `${lines.join("\n")}\n`;
}

/** The same colours that the surface is drawn with, without light. @param {import("./paint.js").Paint} paint @param {number} nVertices @param {number} nFaces */
function coloursOf(paint, nVertices, nFaces) {
  const u = paint.material.uniforms;
  const domain = u.domain.value === 2 ? /** @type {const} */ ("face") : /** @type {const} */ ("vertex");
  const count = domain === "face" ? nFaces : nVertices;
  const colours = new Uint8Array(3 * count);
  const table = colourTable(paint.tableName);
  const clay = u.clay.value.toArray();
  const [low, high] = u.logarithmic.value ? [Math.log(u.low.value), Math.log(u.high.value)] : [u.low.value, u.high.value];
  const tints = /** @type {Uint8Array} */ (paint.tints.image.data);
  for (let k = 0; k < count; k++) {
    const x = u.logarithmic.value ? Math.log(Math.max(paint.numbers[k], 1e-30)) : paint.numbers[k];
    const t = Math.min(Math.max((x - low) / (high - low), 0), 1);
    const ramp = Math.min(t / 0.12, 1);
    const full = u.domain.value === 0 ? 0 : u.fading.value ? ramp * ramp * (3 - 2 * ramp) : 1;
    const alpha = u.tinted.value && domain === "vertex" ? tints[4 * k + 3] / 255 : 0;
    for (let c = 0; c < 3; c++) {
      const base = 255 * clay[c] * (1 - full) + table[4 * Math.round(255 * t) + c] * full;
      colours[3 * k + c] = Math.round(base * (1 - alpha) + tints[4 * k + c] * alpha);
    }
  }
  return { domain, colours };
}
