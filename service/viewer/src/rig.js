/** Where a camera stands: a turntable about an upright axis. Two views that are linked share one rig. */

import * as THREE from "three";

const FIELD_OF_VIEW = 28;
const HALF_TANGENT = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
/** Turning to the pole itself would lose the sense of up. */
const STEEPEST = Math.PI / 2 - 0.01;

export class Rig {
  constructor() {
    this.up = "y";
    this.azimuth = 0.5;
    this.elevation = 0.25;
    /** Half the height that is seen at the centre, in √area. */
    this.reach = 1;
    this.centre = new THREE.Vector3();
    this.orthographic = false;
  }

  /** @returns {Rig} */
  copy() {
    return new Rig().become(this);
  }

  /** @param {Rig} other */
  become(other) {
    this.up = other.up;
    this.azimuth = other.azimuth;
    this.elevation = other.elevation;
    this.reach = other.reach;
    this.orthographic = other.orthographic;
    this.centre.copy(other.centre);
    return this;
  }

  /** @param {number} right @param {number} down angles */
  turn(right, down) {
    this.azimuth -= right;
    this.elevation = Math.min(Math.max(this.elevation + down, -STEEPEST), STEEPEST);
  }

  /** @param {number} right @param {number} up in halves of the view's height */
  pan(right, up) {
    const { x, y } = this.#axes();
    this.centre.addScaledVector(x, -right * this.reach).addScaledVector(y, -up * this.reach);
  }

  /** @param {number} factor above 1 goes nearer */
  zoom(factor) {
    this.reach = Math.min(Math.max(this.reach / factor, 1e-3), 100);
  }

  /**
   * Go where all of some points are seen, from the same side.
   *
   * @param {Float32Array[]} surfaces positions (V, 3) @param {number} aspect width / height
   */
  fit(surfaces, aspect) {
    const { x, y } = this.#axes();
    const ends = [x, y].map((axis) => {
      let [low, high] = [Infinity, -Infinity];
      for (const p of surfaces) {
        for (let k = 0; k < p.length; k += 3) {
          const along = axis.x * p[k] + axis.y * p[k + 1] + axis.z * p[k + 2];
          if (along < low) low = along;
          if (along > high) high = along;
        }
      }
      return { middle: (low + high) / 2, half: (high - low) / 2 };
    });
    const [across, upright] = ends;
    this.centre.set(0, 0, 0).addScaledVector(x, across.middle).addScaledVector(y, upright.middle);
    // What is nearer than the centre looks larger, and the colour bars want room.
    this.reach = 1.3 * Math.max(upright.half, across.half / aspect);
  }

  /** A new camera of this rig. @param {number} aspect width / height */
  camera(aspect) {
    const { x, y, z } = this.#axes();
    const distance = this.reach / HALF_TANGENT;
    const [near, far] = [Math.max(distance - 4, distance / 200), distance + 4];
    let camera;
    if (this.orthographic) {
      const r = this.reach;
      camera = new THREE.OrthographicCamera(-r * aspect, r * aspect, r, -r, near, far);
    } else {
      camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, aspect, near, far);
    }
    camera.matrixAutoUpdate = false;
    camera.matrix.makeBasis(x, y, z).setPosition(this.centre.clone().addScaledVector(z, distance));
    camera.matrixWorld.copy(camera.matrix);
    camera.matrixWorldInverse.copy(camera.matrixWorld).invert();
    return camera;
  }

  /** Right, up and backwards, in the world. */
  #axes() {
    const { azimuth: a, elevation: e } = this;
    const z = new THREE.Vector3(Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e));
    const x = new THREE.Vector3(Math.cos(a), 0, -Math.sin(a));
    const turned = [x, z.clone().cross(x), z].map((one) => (this.up === "z" ? one.set(one.x, -one.z, one.y) : one));
    return { x: turned[0], y: turned[1], z: turned[2] };
  }

  /** @returns {string} for a link */
  toString() {
    const numbers = [this.azimuth, this.elevation, this.reach, ...this.centre.toArray()];
    return [this.up + (this.orthographic ? "o" : "p"), ...numbers.map((one) => Number(one.toFixed(4)))].join(",");
  }

  /** @param {string} text @returns {?Rig} */
  static of(text) {
    const match = /^([yz])([op]),/.exec(text);
    const numbers = text.split(",").slice(1).map(Number);
    if (!match || numbers.length !== 6 || !numbers.every(Number.isFinite) || numbers[2] <= 0) return null;
    const rig = new Rig();
    rig.up = match[1];
    rig.orthographic = match[2] === "o";
    [rig.azimuth, rig.elevation, rig.reach] = numbers;
    rig.centre.fromArray(numbers, 3);
    return rig;
  }
}
