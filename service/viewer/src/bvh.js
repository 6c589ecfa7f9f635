/** A bounding-volume hierarchy over triangles: which face a ray meets first. */

const LEAF_SIZE = 6;
/** How far outside a face a ray still meets it, in barycentric coordinates: none may slip between neighbours. */
const SLACK = 1e-6;

/** @typedef {{face: number, barycentric: [number, number, number], distance: number}} Hit */

export class Bvh {
  /**
   * @param {Float32Array} positions (V, 3)
   * @param {Int32Array} faces (F, 3)
   */
  constructor(positions, faces) {
    this.positions = positions;
    this.faces = faces;
    const n = faces.length / 3;
    this.order = Int32Array.from({ length: n }, (_, k) => k);
    const boxes = faceBoxes(positions, faces);
    this.bounds = new Float32Array(12 * Math.max(1, n));
    // An inner node holds its right child (the left one follows it), a leaf −1 − its first place in the order.
    this.links = new Int32Array(2 * Math.max(1, n));
    this.counts = new Int32Array(2 * Math.max(1, n));
    this.size = 0;
    if (n > 0) this.#split(boxes, 0, n);
    this.stack = new Int32Array(128);
  }

  /** @param {Float32Array} boxes @param {number} begin @param {number} end @returns {number} the node */
  #split(boxes, begin, end) {
    const node = this.size++;
    const { bounds, order } = this;
    const low = [Infinity, Infinity, Infinity, Infinity, Infinity, Infinity];
    const high = low.map((x) => -x);
    for (let k = begin; k < end; k++) {
      const box = 6 * order[k];
      for (let axis = 0; axis < 3; axis++) {
        const a = boxes[box + axis];
        const b = boxes[box + 3 + axis];
        const middle = a + b;
        if (a < low[axis]) low[axis] = a;
        if (b > high[axis]) high[axis] = b;
        if (middle < low[3 + axis]) low[3 + axis] = middle;
        if (middle > high[3 + axis]) high[3 + axis] = middle;
      }
    }
    for (let axis = 0; axis < 3; axis++) {
      bounds[6 * node + axis] = low[axis];
      bounds[6 * node + 3 + axis] = high[axis];
    }
    if (end - begin <= LEAF_SIZE) {
      this.links[node] = -1 - begin;
      this.counts[node] = end - begin;
      return node;
    }
    const spread = [0, 1, 2].map((axis) => high[3 + axis] - low[3 + axis]);
    const axis = spread.indexOf(Math.max(...spread));
    const pivot = (low[3 + axis] + high[3 + axis]) / 2;
    let middle = begin;
    for (let k = begin; k < end; k++) {
      const box = 6 * order[k];
      if (boxes[box + axis] + boxes[box + 3 + axis] < pivot) {
        const face = order[k];
        order[k] = order[middle];
        order[middle++] = face;
      }
    }
    if (middle === begin || middle === end) middle = (begin + end) >> 1;
    this.#split(boxes, begin, middle);
    this.links[node] = this.#split(boxes, middle, end);
    return node;
  }

  /**
   * The nearest face along a ray, from either side.
   *
   * @param {ArrayLike<number>} origin
   * @param {ArrayLike<number>} direction
   * @returns {?Hit}
   */
  cast(origin, direction) {
    if (this.size === 0) return null;
    const { bounds, links, counts, order, stack } = this;
    const [ox, oy, oz] = [origin[0], origin[1], origin[2]];
    const [ix, iy, iz] = [1 / direction[0], 1 / direction[1], 1 / direction[2]];
    /** @type {Hit} */
    const hit = { face: -1, barycentric: [0, 0, 0], distance: Infinity };
    let depth = 0;
    stack[depth++] = 0;
    while (depth > 0) {
      const node = stack[--depth];
      const b = 6 * node;
      const x0 = (bounds[b] - ox) * ix;
      const x1 = (bounds[b + 3] - ox) * ix;
      const y0 = (bounds[b + 1] - oy) * iy;
      const y1 = (bounds[b + 4] - oy) * iy;
      const z0 = (bounds[b + 2] - oz) * iz;
      const z1 = (bounds[b + 5] - oz) * iz;
      const near = Math.max(Math.min(x0, x1), Math.min(y0, y1), Math.min(z0, z1));
      const far = Math.min(Math.max(x0, x1), Math.max(y0, y1), Math.max(z0, z1));
      if (far < Math.max(near, 0) || near > hit.distance) continue;
      const link = links[node];
      if (link >= 0) {
        stack[depth++] = link;
        stack[depth++] = node + 1;
      } else {
        for (let k = -1 - link; k < -1 - link + counts[node]; k++) this.#meet(order[k], origin, direction, hit);
      }
    }
    return hit.face < 0 ? null : hit;
  }

  /**
   * Möller and Trumbore's test of one face; the hit is moved if it is nearer.
   *
   * @param {number} face @param {ArrayLike<number>} o @param {ArrayLike<number>} d @param {Hit} hit
   */
  #meet(face, o, d, hit) {
    const p = this.positions;
    const a = 3 * this.faces[3 * face];
    const b = 3 * this.faces[3 * face + 1];
    const c = 3 * this.faces[3 * face + 2];
    const [e1x, e1y, e1z] = [p[b] - p[a], p[b + 1] - p[a + 1], p[b + 2] - p[a + 2]];
    const [e2x, e2y, e2z] = [p[c] - p[a], p[c + 1] - p[a + 1], p[c + 2] - p[a + 2]];
    const [px, py, pz] = [d[1] * e2z - d[2] * e2y, d[2] * e2x - d[0] * e2z, d[0] * e2y - d[1] * e2x];
    const determinant = e1x * px + e1y * py + e1z * pz;
    if (determinant === 0) return;
    const [tx, ty, tz] = [o[0] - p[a], o[1] - p[a + 1], o[2] - p[a + 2]];
    const u = (tx * px + ty * py + tz * pz) / determinant;
    if (u < -SLACK || u > 1 + SLACK) return;
    const [qx, qy, qz] = [ty * e1z - tz * e1y, tz * e1x - tx * e1z, tx * e1y - ty * e1x];
    const v = (d[0] * qx + d[1] * qy + d[2] * qz) / determinant;
    if (v < -SLACK || u + v > 1 + SLACK) return;
    const distance = (e2x * qx + e2y * qy + e2z * qz) / determinant;
    if (distance <= 0 || distance >= hit.distance) return;
    hit.face = face;
    hit.barycentric = [1 - u - v, u, v];
    hit.distance = distance;
  }
}

/** @param {Float32Array} positions @param {Int32Array} faces */
function faceBoxes(positions, faces) {
  const boxes = new Float32Array(2 * faces.length);
  for (let face = 0; face < faces.length / 3; face++) {
    for (let axis = 0; axis < 3; axis++) {
      const a = positions[3 * faces[3 * face] + axis];
      const b = positions[3 * faces[3 * face + 1] + axis];
      const c = positions[3 * faces[3 * face + 2] + axis];
      boxes[6 * face + axis] = Math.min(a, b, c);
      boxes[6 * face + 3 + axis] = Math.max(a, b, c);
    }
  }
  return boxes;
}
