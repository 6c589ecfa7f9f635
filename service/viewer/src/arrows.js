/** Vectors on a surface as arrows: the longest in each small box of space, coloured by length. */

import * as THREE from "three";
import { mergeGeometries } from "three/addons/utils/BufferGeometryUtils.js";
import { colourTable } from "./colours.js";
import { percentiles } from "./statistics.js";

/** Edge of the boxes, and length of a long arrow, in √area. */
const BOX = 0.03;
const LONGEST = 0.07;
/** Where less than this part of the most mass moves, nothing is drawn. */
const FAINTEST = 0.02;

const SHAPE = arrowShape();

/**
 * @param {import("./surface.js").Surface} surface
 * @param {Float64Array} vectors (F, 3), one a face
 * @param {Float64Array} weights (F, 3): what moves; decides where arrows are worth drawing
 * @param {number} size factor of their length
 * @param {string} map of colours
 */
export function arrowsOn(surface, vectors, weights, size, map) {
  const lengths = lengthsOf(vectors);
  const moved = lengthsOf(weights);
  const [, most] = percentiles(moved, moved.length, [0, 99.5]);
  const chosen = strongest(surface, moved, FAINTEST * most);
  const shown = Float64Array.from(chosen, (face) => lengths[face]);
  const [, long] = percentiles(shown, shown.length, [0, 95]);
  const mesh = new THREE.InstancedMesh(SHAPE, new THREE.MeshLambertMaterial(), chosen.length);
  const table = colourTable(map);
  const [matrix, turn, scale, up] = [new THREE.Matrix4(), new THREE.Quaternion(), new THREE.Vector3(), new THREE.Vector3(0, 1, 0)];
  const colour = new THREE.Color();
  chosen.forEach((face, k) => {
    const part = Math.min(1, lengths[face] / (long || 1));
    const [direction, normal] = [new THREE.Vector3().fromArray(vectors, 3 * face).normalize(), surface.faceNormal(face)];
    const at = surface.faceCentre(face).map((x, axis) => x + 0.006 * normal[axis]);
    turn.setFromUnitVectors(up, direction);
    const length = LONGEST * size * Math.max(part, 0.12);
    scale.set(0.25 * length + 0.006 * size, length, 0.25 * length + 0.006 * size);
    mesh.setMatrixAt(k, matrix.compose(new THREE.Vector3(...at), turn, scale));
    const c = 4 * Math.round(255 * (0.15 + 0.85 * part));
    mesh.setColorAt(k, colour.setRGB(table[c] / 255, table[c + 1] / 255, table[c + 2] / 255, THREE.SRGBColorSpace));
  });
  mesh.frustumCulled = false;
  return { mesh, count: chosen.length, long };
}

/** One arrow from a point. @param {ArrayLike<number>} from @param {ArrayLike<number>} along @param {number[]} rgb */
export function oneArrow(from, along, rgb) {
  const vector = new THREE.Vector3(along[0], along[1], along[2]);
  const length = vector.length();
  const mesh = new THREE.Mesh(SHAPE, new THREE.MeshLambertMaterial({ color: new THREE.Color().setRGB(...rgb, THREE.SRGBColorSpace) }));
  mesh.position.set(from[0], from[1], from[2]);
  mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), vector.normalize());
  mesh.scale.set(0.05, length, 0.05);
  return mesh;
}

/** @param {Float64Array} vectors (F, 3) */
export function lengthsOf(vectors) {
  return Float64Array.from({ length: vectors.length / 3 }, (_, k) => Math.hypot(vectors[3 * k], vectors[3 * k + 1], vectors[3 * k + 2]));
}

/** @param {import("./surface.js").Surface} surface @param {Float64Array} moved @param {number} least @returns {number[]} faces */
function strongest(surface, moved, least) {
  /** @type {Map<string, number>} */
  const best = new Map();
  for (let face = 0; face < surface.nFaces; face++) {
    if (!(moved[face] > least)) continue;
    const key = surface.faceCentre(face).map((x) => Math.floor(x / BOX)).join();
    const other = best.get(key);
    if (other === undefined || moved[face] > moved[other]) best.set(key, face);
  }
  return [...best.values()];
}

/** An arrow of length 1 along y. */
function arrowShape() {
  const shaft = new THREE.CylinderGeometry(0.12, 0.12, 0.66, 8).translate(0, 0.33, 0);
  const head = new THREE.ConeGeometry(0.34, 0.36, 10).translate(0, 0.82, 0);
  const shape = mergeGeometries([shaft, head]);
  shape.userData.shared = true;
  return shape;
}
