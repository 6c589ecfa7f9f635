/** The form that says what soft map: two meshes, how points are compared, and on which functions. */

import { artifacts, uploadArray, uploadCreature, uploadMesh, uploadNpy } from "./api.js";
import { choice, h, labelled, offer } from "./dom.js";
import { inWords } from "./jobs.js";

/** @type {Array<[string, string]>} */
const MAPS = [
  ["wks", "wave kernel signatures"],
  ["hks", "heat kernel signatures"],
  ["points", "points, from a file"],
  ["uniform", "uniform"],
];
const SIDES = /** @type {const} */ (["source", "target"]);

export class Question {
  /** @param {import("./session.js").Viewer} viewer @param {HTMLElement} parent @param {HTMLElement} stage where meshes may be dropped */
  constructor(viewer, parent, stage) {
    this.viewer = viewer;
    /** What the form says. */
    this.answer = { source: "", target: "", map: "wks", sigma: 0.1, size: 300, method: "maxent" };
    /** @type {?File} */
    this.file = null;
    const { answer } = this;
    this.selects = {
      source: choice([], "", (id) => this.choose("source", id), "Source mesh"),
      target: choice([], "", (id) => this.choose("target", id), "Target mesh"),
    };
    this.sigma = h("input", { type: "number", min: 0.001, step: 0.01, value: answer.sigma, oninput: () => (answer.sigma = this.sigma.valueAsNumber) });
    const size = h("input", { type: "number", min: 1, step: 1, value: answer.size, "aria-label": "Functions of each basis", oninput: () => (answer.size = size.valueAsNumber) });
    this.size = size;
    const method = choice([["maxent", "maximum entropy"], ["poisson", "Poisson"]], "maxent", (value) => (answer.method = value), "Method of the bases");
    const points = h("input", { type: "file", accept: ".txt,.map,.vts,.npy,.csv", onchange: () => (this.file = points.files?.[0] ?? null) });
    this.sigmaRow = labelled("σ", this.sigma, "Distances of descriptors that count as near, in root-mean-square distances");
    this.pointsRow = labelled("target vertices", points, "A file with one target vertex for each source vertex, counted from 0; or a .npy file");
    this.pointsRow.hidden = true;
    const map = choice(MAPS, "wks", (value) => this.#setMap(value), "How points are compared");
    this.go = h("button", { type: "button", class: "main", onclick: () => this.compute() }, "Compute the soft map");
    this.complaint = h("p", { class: "bad", role: "alert", hidden: true });
    this.known = choice([["", "–"]], "", (id) => id && this.attempt(() => viewer.showSoftMap(id)), "Soft maps that are known");
    parent.append(
      ...SIDES.map((side) => labelled(side, h("span", { class: "pair" }, this.selects[side], this.#uploader(side)))),
      h("div", { class: "buttons" }, h("button", { type: "button", onclick: () => this.attempt(() => this.builtIn()) }, "Built-in pair")),
      labelled("map by", map),
      this.sigmaRow,
      this.pointsRow,
      labelled("functions", h("span", { class: "pair" }, size, method), "How many functions each basis has, and how they are made"),
      this.go,
      this.complaint,
      labelled("known maps", this.known),
    );
    this.#acceptDrops(stage);
    for (const change of ["softmap", "meshes"]) viewer.on(change, () => this.#follow());
  }

  /** Offer the meshes and soft maps that the service has. */
  async refresh() {
    const [meshes, softmaps] = await Promise.all([artifacts("mesh"), artifacts("softmap")]);
    const names = new Map(meshes.map((mesh) => [mesh.id, mesh.values.name ?? mesh.id.slice(0, 13)]));
    for (const side of SIDES) {
      const options = meshes.map((mesh) => /** @type {[string, string]} */ ([mesh.id, `${names.get(mesh.id)} (${mesh.values.n_vertices.toLocaleString("en")})`]));
      offer(this.selects[side], [["", "–"], ...options.sort((a, b) => a[1].localeCompare(b[1]))], this.answer[side]);
    }
    const chosen = this.viewer.softmap?.id ?? "";
    offer(this.known, [["", "–"], ...softmaps.map((one) => /** @type {[string, string]} */ ([one.id, `${one.spec?.map?.type ?? "soft map"} · ${one.id.slice(8, 14)}`]))], chosen);
  }

  /** @param {"source" | "target"} side @param {string} id */
  async choose(side, id) {
    this.answer[side] = id;
    await this.attempt(() => this.viewer.showMeshes(this.answer.source || null, this.answer.target || null));
  }

  /** @param {Blob} content @param {string} name @param {"source" | "target"} side */
  async upload(content, name, side) {
    this.viewer.say(`uploading ${name} …`);
    const mesh = await uploadMesh(content, name);
    this.answer[side] = mesh.id;
    await this.refresh();
    await this.choose(side, mesh.id);
    const odd = mesh.warnings.length ? `; ${mesh.warnings.join("; ")}` : "";
    this.viewer.say(`${name}: ${mesh.n_vertices.toLocaleString("en")} vertices, ${mesh.n_faces.toLocaleString("en")} faces${odd}`);
  }

  async builtIn() {
    const [source, target] = await Promise.all(["standing", "trotting"].map(uploadCreature));
    Object.assign(this.answer, { source: source.id, target: target.id });
    await this.refresh();
    await this.viewer.showMeshes(source.id, target.id);
  }

  /** @param {"source" | "target"} side @param {number[]} [first] samples to begin with @returns {any} spec of a basis */
  basis(side, first) {
    const { size, method } = this.answer;
    return { kind: "basis", mesh: this.answer[side], size, method, ...(first?.length ? { first } : {}) };
  }

  /** Ask for the soft map that the form describes, and show it. */
  compute() {
    return this.attempt(async () => {
      if (!this.answer.source || !this.answer.target) throw new Error("Choose a source and a target mesh, or the built-in pair.");
      const spec = { kind: "softmap", source: this.basis("source"), target: this.basis("target"), map: await this.#map() };
      const id = await this.viewer.jobs.run(spec, "soft map");
      await this.viewer.showSoftMap(id);
      await this.refresh();
    });
  }

  /** Do something, saying what goes wrong. @param {() => Promise<any>} what */
  async attempt(what) {
    this.complaint.hidden = true;
    this.go.disabled = true;
    try {
      await what();
    } catch (error) {
      this.complaint.textContent = inWords(error);
      this.complaint.hidden = false;
    } finally {
      this.go.disabled = false;
    }
  }

  /** @returns {Promise<any>} the map's part of the spec */
  async #map() {
    const { map, sigma } = this.answer;
    if (map === "uniform") return { type: "uniform" };
    if (map !== "points") return { type: "descriptors", descriptor: map, sigma };
    if (!this.file) throw new Error("Choose the file that names a target vertex for each source vertex.");
    if (this.file.name.endsWith(".npy")) return { type: "points", targets: (await uploadNpy(this.file, this.file.name)).id };
    const words = (await this.file.text()).split(/[\s,;]+/).filter(Boolean);
    const bad = words.findIndex((word) => !/^-?[0-9]+$/.test(word));
    if (bad >= 0) throw new Error(`Entry ${bad} of ${this.file.name} is “${words[bad].slice(0, 30)}”, not a vertex.`);
    return { type: "points", targets: (await uploadArray(words.map(Number), this.file.name)).id };
  }

  /** @param {string} value */
  #setMap(value) {
    this.answer.map = value;
    this.sigmaRow.hidden = value !== "wks" && value !== "hks";
    this.pointsRow.hidden = value !== "points";
  }

  /** Let the form name the meshes that are shown. */
  #follow() {
    const { source, target } = this.viewer.stage;
    for (const pane of [source, target]) {
      if (!pane.surface) continue;
      this.answer[pane.side] = pane.surface.id;
      this.selects[pane.side].value = pane.surface.id;
    }
    const { softmap } = this.viewer;
    if (softmap) {
      this.known.value = softmap.id;
      this.answer.size = softmap.source.size;
      this.size.value = String(softmap.source.size);
    }
  }

  /** @param {"source" | "target"} side */
  #uploader(side) {
    const input = h("input", {
      type: "file", accept: ".off,.obj,.ply,.stl,.glb", hidden: true, "data-upload": side,
      onchange: () => {
        const file = input.files?.[0];
        if (file) this.attempt(() => this.upload(file, file.name, side));
        input.value = "";
      },
    });
    return h("span", {}, input, h("button", { type: "button", "aria-label": `Upload the ${side} mesh`, onclick: () => input.click() }, "upload…"));
  }

  /** @param {HTMLElement} stage */
  #acceptDrops(stage) {
    stage.addEventListener("dragover", (event) => {
      event.preventDefault();
      stage.classList.add("dropping");
    });
    stage.addEventListener("dragleave", () => stage.classList.remove("dropping"));
    stage.addEventListener("drop", (event) => {
      event.preventDefault();
      stage.classList.remove("dropping");
      const files = [...(event.dataTransfer?.files ?? [])];
      const left = event.clientX - stage.getBoundingClientRect().left < stage.clientWidth / 2;
      // Two files at once are the source and the target.
      const sides = files.length > 1 ? SIDES : [left ? SIDES[0] : SIDES[1]];
      this.attempt(async () => {
        for (const [k, side] of sides.entries()) if (files[k]) await this.upload(files[k], files[k].name, side);
      });
    });
  }
}
