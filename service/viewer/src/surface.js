/** A mesh as it is drawn and picked: moved to the origin, scaled to area 1, as the solver does. */

import { array, artifact } from "./api.js";
import { Bvh } from "./bvh.js";

export class Surface {
  /**
   * @param {{id: string, name: string, vertices: Float64Array, faces: Int32Array, watertight: boolean}} mesh in the file's order
   *   and units
   */
  constructor({ id, name, vertices, faces, watertight }) {
    this.id = id;
    this.name = name;
    this.vertices = vertices;
    this.faces = faces;
    this.nVertices = vertices.length / 3;
    this.nFaces = faces.length / 3;
    const { areas, centre, total } = measured(vertices, faces);
    this.centre = centre;
    /** One √area in the file's units. */
    this.unit = Math.sqrt(total);
    this.positions = Float32Array.from(vertices, (x, k) => (x - centre[k % 3]) / this.unit);
    /** Areas of the faces; their sum is 1. */
    this.faceAreas = areas.map((area) => area / total);
    /** A third of the area of the faces at each vertex. */
    this.vertexAreas = new Float64Array(this.nVertices);
    for (let k = 0; k < faces.length; k++) this.vertexAreas[faces[k]] += this.faceAreas[Math.floor(k / 3)] / 3;
    this.normals = vertexNormals(this.positions, faces);
    this.bvh = new Bvh(this.positions, faces);
    /** Whether no face is ever seen from behind. */
    this.solid = watertight && volume(this.positions, faces) > 0;
  }

  /** @param {ArrayLike<number>} point in the file's units @param {number} [at] @returns {[number, number, number]} */
  drawn(point, at = 0) {
    const { centre, unit } = this;
    return [(point[at] - centre[0]) / unit, (point[at + 1] - centre[1]) / unit, (point[at + 2] - centre[2]) / unit];
  }

  /** @param {number} vertex @returns {[number, number, number]} where it is drawn */
  point(vertex) {
    const p = this.positions;
    return [p[3 * vertex], p[3 * vertex + 1], p[3 * vertex + 2]];
  }

  /** @param {number} face @returns {[number, number, number]} middle of a face as drawn */
  faceCentre(face) {
    const corners = [0, 1, 2].map((k) => this.point(this.faces[3 * face + k]));
    return [0, 1, 2].map((axis) => (corners[0][axis] + corners[1][axis] + corners[2][axis]) / 3);
  }

  /** @param {number} face @returns {[number, number, number]} unit normal */
  faceNormal(face) {
    const [a, b, c] = [0, 1, 2].map((k) => this.point(this.faces[3 * face + k]));
    const n = cross(minus(b, a), minus(c, a));
    const length = Math.hypot(...n) || 1;
    return [n[0] / length, n[1] / length, n[2] / length];
  }

  /** @param {import("./bvh.js").Hit} hit @returns {number} the nearest corner of the face */
  vertexOf(hit) {
    const corner = hit.barycentric.indexOf(Math.max(...hit.barycentric));
    return this.faces[3 * hit.face + corner];
  }

  /**
   * Values at faces as means of values at their corners.
   *
   * @param {ArrayLike<number>} values (V,)
   */
  faceMeans(values) {
    const f = this.faces;
    return Float32Array.from(
      { length: this.nFaces },
      (_, k) => (values[f[3 * k]] + values[f[3 * k + 1]] + values[f[3 * k + 2]]) / 3,
    );
  }
}

/** @param {string} id @returns {Promise<Surface>} */
export async function loadSurface(id) {
  const [manifest, vertices, faces] = await Promise.all([artifact(id), array(id, "vertices"), array(id, "faces")]);
  return new Surface({
    id,
    name: manifest.values.name ?? id,
    vertices: /** @type {Float64Array} */ (vertices.data),
    faces: /** @type {Int32Array} */ (faces.data),
    watertight: manifest.values.n_boundary_loops === 0 && manifest.values.warnings.length === 0,
  });
}

/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b @returns {[number, number, number]} */
export const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];

/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b @returns {[number, number, number]} */
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];

/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** @param {Float64Array} vertices @param {Int32Array} faces */
function measured(vertices, faces) {
  const areas = new Float64Array(faces.length / 3);
  const sum = [0, 0, 0];
  let total = 0;
  for (let face = 0; face < areas.length; face++) {
    const [a, b, c] = [0, 1, 2].map((k) => vertices.subarray(3 * faces[3 * face + k], 3 * faces[3 * face + k] + 3));
    areas[face] = Math.hypot(...cross(minus(b, a), minus(c, a))) / 2;
    total += areas[face];
    for (let axis = 0; axis < 3; axis++) sum[axis] += (areas[face] * (a[axis] + b[axis] + c[axis])) / 3;
  }
  return { areas, total, centre: sum.map((x) => x / total) };
}

/** Six times the volume inside, if normals point outwards. @param {Float32Array} p @param {Int32Array} faces */
function volume(p, faces) {
  let sum = 0;
  for (let k = 0; k < faces.length; k += 3) {
    const [a, b, c] = [3 * faces[k], 3 * faces[k + 1], 3 * faces[k + 2]];
    sum +=
      p[a] * (p[b + 1] * p[c + 2] - p[b + 2] * p[c + 1]) +
      p[a + 1] * (p[b + 2] * p[c] - p[b] * p[c + 2]) +
      p[a + 2] * (p[b] * p[c + 1] - p[b + 1] * p[c]);
  }
  return sum;
}

/** @param {Float32Array} p @param {Int32Array} faces @returns {Float32Array} area-weighted unit normals */
function vertexNormals(p, faces) {
  const normals = new Float32Array(p.length);
  for (let k = 0; k < faces.length; k += 3) {
    const [a, b, c] = [3 * faces[k], 3 * faces[k + 1], 3 * faces[k + 2]];
    const n = cross(
      [p[b] - p[a], p[b + 1] - p[a + 1], p[b + 2] - p[a + 2]],
      [p[c] - p[a], p[c + 1] - p[a + 1], p[c + 2] - p[a + 2]],
    );
    for (const corner of [a, b, c]) for (let axis = 0; axis < 3; axis++) normals[corner + axis] += n[axis];
  }
  for (let k = 0; k < normals.length; k += 3) {
    const length = Math.hypot(normals[k], normals[k + 1], normals[k + 2]) || 1;
    for (let axis = 0; axis < 3; axis++) normals[k + axis] /= length;
  }
  return normals;
}
