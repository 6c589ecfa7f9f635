/** A soft map that is evaluated here: μ_x(y) = Σ_ij β₀ᵢ(x) C_ij βⱼ(y) / ∫βⱼ, mass per unit area of the target. */

import { array, artifact } from "./api.js";
import { loadSurface } from "./surface.js";

/** A partition of unity: functions as sparse rows, one a vertex. */
export class Basis {
  /**
   * @param {string} id
   * @param {import("./surface.js").Surface} surface
   * @param {{indptr: Int32Array, indices: Int32Array, values: Float64Array}} rows
   * @param {Int32Array} samples
   * @param {Int32Array} cells
   */
  constructor(id, surface, { indptr, indices, values }, samples, cells) {
    this.id = id;
    this.surface = surface;
    this.indptr = indptr;
    this.indices = indices;
    this.values = values;
    this.samples = samples;
    this.cells = cells;
    this.size = samples.length;
    /** ∫βⱼ; the whole surface has area 1. */
    this.integrals = new Float64Array(this.size);
    for (let v = 0; v < surface.nVertices; v++) {
      for (let k = indptr[v]; k < indptr[v + 1]; k++) this.integrals[indices[k]] += surface.vertexAreas[v] * values[k];
    }
  }

  /**
   * Σⱼ coefficientsⱼ βⱼ at every vertex.
   *
   * @param {ArrayLike<number>} coefficients (n,)
   * @param {Float32Array} out (≥ V,)
   */
  combine(coefficients, out) {
    const { indptr, indices, values } = this;
    const n = indptr.length - 1;
    for (let v = 0, k = 0; v < n; v++) {
      let sum = 0;
      for (const end = indptr[v + 1]; k < end; k++) sum += values[k] * coefficients[indices[k]];
      out[v] = sum;
    }
    return out;
  }
}

export class SoftMap {
  /**
   * @param {?import("./api.js").Artifact} manifest null for what a search has found so far
   * @param {Basis} source
   * @param {Basis} target
   * @param {Float64Array} coefficients (n₀, n)
   */
  constructor(manifest, source, target, coefficients) {
    this.id = manifest?.id ?? null;
    this.spec = manifest?.spec ?? null;
    this.source = source;
    this.target = target;
    this.coefficients = coefficients;
    this.row = new Float64Array(target.size);
  }

  /**
   * The distribution of a source vertex as densities of the target's functions: Σᵢ β₀ᵢ(x) C_ij / ∫βⱼ.
   *
   * @param {number} vertex
   * @returns {Float64Array} (n,), overwritten by the next call
   */
  densities(vertex) {
    const { source, target, coefficients, row } = this;
    const n = target.size;
    row.fill(0);
    for (let k = source.indptr[vertex]; k < source.indptr[vertex + 1]; k++) {
      const weight = source.values[k];
      const begin = source.indices[k] * n;
      for (let j = 0; j < n; j++) row[j] += weight * coefficients[begin + j];
    }
    for (let j = 0; j < n; j++) row[j] /= target.integrals[j];
    return row;
  }

  /**
   * μ_x at every target vertex.
   *
   * @param {number} vertex of the source
   * @param {Float32Array} out (≥ V,)
   */
  distribution(vertex, out) {
    return this.target.combine(this.densities(vertex), out);
  }

  /**
   * The mean of a function of the target under every μ_x: ∫ g dμ_x.
   *
   * @param {ArrayLike<number>} values (V,) of the target
   * @returns {Float32Array} (V₀,)
   */
  pullBack(values) {
    const { source, target, coefficients } = this;
    const { vertexAreas, nVertices } = target.surface;
    const means = new Float64Array(target.size);
    for (let v = 0; v < nVertices; v++) {
      for (let k = target.indptr[v]; k < target.indptr[v + 1]; k++) {
        means[target.indices[k]] += (vertexAreas[v] * target.values[k] * values[v]) / target.integrals[target.indices[k]];
      }
    }
    const rows = new Float64Array(source.size);
    for (let i = 0; i < source.size; i++) {
      for (let j = 0; j < target.size; j++) rows[i] += coefficients[i * target.size + j] * means[j];
    }
    return source.combine(rows, new Float32Array(source.surface.nVertices));
  }
}

/** @param {string} id @returns {Promise<Basis>} */
export async function loadBasis(id) {
  const manifest = await artifact(id);
  const arrays = ["functions_data", "functions_indices", "functions_indptr", "samples", "cells"];
  const [surface, values, indices, indptr, samples, cells] = await Promise.all([
    surfaceOf(manifest.parents.mesh ?? manifest.spec.mesh),
    ...arrays.map(async (name) => (await array(id, name)).data),
  ]);
  return new Basis(id, surface, { indptr, indices, values }, samples, cells);
}

/** @type {Map<string, Promise<import("./surface.js").Surface>>} */
const surfaces = new Map();

/** @param {string} id @returns {Promise<import("./surface.js").Surface>} the same object for the same mesh */
export function surfaceOf(id) {
  let surface = surfaces.get(id);
  if (!surface) {
    surface = loadSurface(id);
    surfaces.set(id, surface);
    surface.catch(() => surfaces.delete(id));
  }
  return surface;
}

/** @param {string} id @returns {Promise<SoftMap>} */
export async function loadSoftMap(id) {
  const manifest = await artifact(id);
  const [source, target, coefficients] = await Promise.all([
    loadBasis(manifest.spec.source),
    loadBasis(manifest.spec.target),
    array(id, "coefficients"),
  ]);
  return new SoftMap(manifest, source, target, /** @type {Float64Array} */ (coefficients.data));
}

/** @param {ArrayLike<number>} values @param {number} [count] @returns {number} index of the largest */
export function peakOf(values, count = values.length) {
  let best = 0;
  for (let k = 1; k < count; k++) if (values[k] > values[best]) best = k;
  return best;
}
