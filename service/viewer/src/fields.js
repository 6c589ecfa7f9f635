/** Everything that a surface can show, and where its numbers come from. */

import { array, artifact, artifacts } from "./api.js";
import { distinct } from "./colours.js";

/** @typedef {"source" | "target"} Side */
/** @typedef {{field?: import("./layers.js").Field, tint?: Uint8Array, last?: number}} Shown `last`: the greatest index to choose */

/**
 * Quantities to choose from; `label:index` where `indexed`.
 *
 * @type {Array<{key: string, text: string, side?: Side, indexed?: boolean, needsMap?: boolean}>}
 */
export const QUANTITIES = [
  { key: "mu", text: "distribution μₓ of the brush", side: "target", needsMap: true },
  { key: "none", text: "bare surface" },
  { key: "dirichlet", text: "Dirichlet energy density", side: "source", needsMap: true },
  { key: "bijectivity", text: "mass received (bijectivity density)", side: "target", needsMap: true },
  { key: "reciprocal", text: "1 / mass received", side: "target", needsMap: true },
  { key: "coordinates", text: "coordinates as colours, carried over", needsMap: true },
  { key: "function", text: "basis function", indexed: true, needsMap: true },
  { key: "cells", text: "cells of the basis", needsMap: true },
  { key: "wks", text: "wave kernel signature", indexed: true },
  { key: "hks", text: "heat kernel signature", indexed: true },
];

/**
 * Numbers or colours of one quantity; jobs are run where they are needed.
 *
 * @param {import("./session.js").Viewer} viewer @param {Side} side @param {string} key @param {number} index
 * @returns {Promise<Shown>}
 */
export async function load(viewer, side, key, index) {
  const { softmap, stage, jobs } = viewer;
  const surface = stage[side].surface;
  if (key === "none" || !surface) return {};
  if (key === "wks" || key === "hks") {
    const other = stage[side === "source" ? "target" : "source"].surface;
    const partner = other && other.id !== surface.id ? { partner: other.id } : {};
    const id = await jobs.run({ kind: "descriptor", mesh: surface.id, type: key, ...partner }, `${key.toUpperCase()} of the ${side}`);
    return column(await array(id, "descriptor"), index, `${key.toUpperCase()} ${index}`, "vertex");
  }
  if (key.startsWith("array-")) return ofArray(key, index, surface);
  if (!softmap) throw new Error("Compute a soft map first.");
  const basis = softmap[side];
  if (key === "function") {
    const last = basis.size - 1;
    const one = new Float64Array(basis.size);
    one[Math.min(index, last)] = 1;
    const values = basis.combine(one, new Float32Array(surface.nVertices));
    const name = side === "source" ? "β₀" : "β";
    return { field: { domain: "vertex", values, title: `${name} ${Math.min(index, last)}, sample at vertex ${basis.samples[Math.min(index, last)]}`, unit: "", fading: true }, last };
  }
  if (key === "cells") return { tint: cellColours(basis.cells) };
  if (key === "coordinates") {
    const target = coordinateColours(softmap.target.surface);
    return { tint: rgba(side === "target" ? target : target.map((channel) => softmap.pullBack(channel))) };
  }
  const id = await jobs.run({ kind: "energy", softmap: softmap.id }, "energies");
  const { values } = await artifact(id);
  if (key === "dirichlet") {
    const { data } = await array(id, "dirichlet_density");
    const title = `Dirichlet density, E = ${values.dirichlet.toPrecision(4)}`;
    return { field: { domain: "face", values: data, title, unit: "per area", logarithmic: true, range: [2, 98] } };
  }
  const { data } = await array(id, "bijectivity_density");
  if (key === "bijectivity") {
    const title = `mass received, E = ${values.bijectivity.toPrecision(4)}`;
    return { field: { domain: "face", values: data, title, unit: "per area", range: [2, 98] } };
  }
  const inverse = data.map((x) => 1 / x);
  return { field: { domain: "face", values: inverse, title: "1 / mass received", unit: "area", logarithmic: true, range: [2, 98] } };
}

/**
 * Arrays of the service that fit a surface: one row for each vertex or face.
 *
 * @param {import("./surface.js").Surface} surface
 * @returns {Promise<Array<[string, string]>>}
 */
export async function fitting(surface) {
  const found = (await artifacts("array")).filter(({ arrays }) => {
    const [rows] = arrays.array.shape;
    return arrays.array.shape.length <= 2 && (rows === surface.nVertices || rows === surface.nFaces);
  });
  return found.map(({ id, values, arrays }) => [id, `array: ${values.name ?? id.slice(6, 14)} (${arrays.array.shape.join(" × ")})`]);
}

/** @param {string} id @param {number} index @param {import("./surface.js").Surface} surface @returns {Promise<Shown>} */
async function ofArray(id, index, surface) {
  const [manifest, numbers] = await Promise.all([artifact(id), array(id, "array")]);
  const [rows] = numbers.shape;
  if (rows !== surface.nVertices && rows !== surface.nFaces) {
    throw new Error(`The array has ${rows} rows; the ${surface.name} has ${surface.nVertices} vertices and ${surface.nFaces} faces.`);
  }
  return column(numbers, index, manifest.values.name ?? "array", rows === surface.nVertices ? "vertex" : "face");
}

/**
 * @param {import("./api.js").Numbers} numbers (rows,) or (rows, k) @param {number} index of the column
 * @param {string} title @param {"vertex" | "face"} domain @returns {Shown}
 */
function column({ data, shape }, index, title, domain) {
  const [rows, width = 1] = shape;
  const last = width - 1;
  const k = Math.min(index, last);
  const values = width === 1 ? data : Float64Array.from({ length: rows }, (_, row) => data[row * width + k]);
  const signed = values.some((x) => x < 0) && values.some((x) => x > 0);
  return { field: { domain, values, title, unit: "", signed }, last };
}

/** Positions in the box around a surface as red, green and blue. @param {import("./surface.js").Surface} surface */
function coordinateColours({ positions, nVertices }) {
  return [0, 1, 2].map((axis) => {
    const along = Float32Array.from({ length: nVertices }, (_, v) => positions[3 * v + axis]);
    const low = along.reduce((a, b) => Math.min(a, b), Infinity);
    const high = along.reduce((a, b) => Math.max(a, b), -Infinity);
    return along.map((x) => 0.12 + (0.82 * (x - low)) / (high - low || 1));
  });
}

/** @param {Float32Array[]} channels @returns {Uint8Array} */
function rgba([red, green, blue]) {
  const out = new Uint8Array(4 * red.length);
  for (let v = 0; v < red.length; v++) out.set([255 * red[v], 255 * green[v], 255 * blue[v], 255], 4 * v);
  return out;
}

/** @param {Int32Array} cells @returns {Uint8Array} */
function cellColours(cells) {
  const out = new Uint8Array(4 * cells.length);
  cells.forEach((cell, v) => {
    if (cell >= 0) out.set([...distinct(cell), 255], 4 * v);
  });
  return out;
}
