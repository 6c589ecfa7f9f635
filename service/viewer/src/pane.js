/** One view: a canvas with a painted surface and what is drawn on it – markers, curves, arrows. */

import * as THREE from "three";
import { Line2 } from "three/addons/lines/Line2.js";
import { LineGeometry } from "three/addons/lines/LineGeometry.js";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { Paint } from "./paint.js";

/** Radius of a marker as a part of half the view's height. */
const MARKER = 0.018;
const PIXEL_RATIO = Math.min(window.devicePixelRatio, 2);
const BALL = new THREE.SphereGeometry(1, 20, 14);

/** @typedef {{light: boolean, background: number, clay: number, wire: number}} Theme */
/** @typedef {{vertex: number, colour: number[], owner?: object}} Marker */

export class Pane {
  /** @param {"source" | "target"} side @param {HTMLCanvasElement} canvas @param {import("./rig.js").Rig} rig */
  constructor(side, canvas, rig) {
    this.side = side;
    this.canvas = canvas;
    this.rig = rig;
    this.software = isSoftware();
    this.renderer = rendererOf(canvas, !this.software);
    /** Whether every pixel is drawn. */
    this.fine = true;
    /** Whether something changed since it was drawn. */
    this.stale = true;
    this.scene = new THREE.Scene();
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x777777, 2.6));
    this.markers = new THREE.Group();
    this.curves = new THREE.Group();
    this.arrows = new THREE.Group();
    this.scene.add(this.markers, this.curves, this.arrows);
    /** @type {?import("./surface.js").Surface} */
    this.surface = null;
    /** @type {?Paint} */
    this.paint = null;
    /** @type {?THREE.Mesh} */
    this.mesh = null;
    /** Size in CSS pixels. */
    this.width = this.height = 1;
  }

  /** @param {?import("./surface.js").Surface} surface */
  setSurface(surface) {
    if (this.mesh) {
      this.scene.remove(this.mesh);
      this.shapes.joined.dispose();
      this.shapes.split?.dispose();
      this.paint?.dispose();
    }
    for (const group of [this.markers, this.curves, this.arrows]) clear(group);
    this.surface = surface;
    this.mesh = this.paint = null;
    if (!surface) return;
    this.paint = new Paint(surface);
    this.shapes = { joined: joinedGeometry(surface), split: /** @type {?THREE.BufferGeometry} */ (null) };
    this.mesh = new THREE.Mesh(this.shapes.joined, this.paint.material);
    this.mesh.frustumCulled = false;
    this.scene.add(this.mesh);
  }

  /** @param {Theme} theme @param {{wires: boolean, smooth: boolean}} look */
  dress(theme, { wires, smooth }) {
    this.scene.background = new THREE.Color().setHex(theme.background);
    if (!this.paint) return;
    const u = this.paint.material.uniforms;
    // These colours are written to the screen as they are.
    u.clay.value.setHex(theme.clay, THREE.LinearSRGBColorSpace);
    u.wire.value.setHex(theme.wire, THREE.LinearSRGBColorSpace);
    u.wires.value = wires ? 0.55 : 0;
    u.smoothly.value = smooth;
  }

  get aspect() {
    return this.width / this.height;
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas;
    [this.width, this.height] = [Math.max(1, clientWidth), Math.max(1, clientHeight)];
    this.renderer.setSize(this.width, this.height, false);
  }

  fit() {
    if (this.surface) this.rig.fit([this.surface.positions], this.aspect);
  }

  /**
   * What is under a point of the canvas.
   *
   * @param {number} x @param {number} y CSS pixels from its top left
   * @returns {?import("./bvh.js").Hit}
   */
  pick(x, y) {
    if (!this.surface) return null;
    const { origin, direction } = this.ray(x, y);
    return this.surface.bvh.cast(origin.toArray(), direction.toArray());
  }

  /** @param {number} x @param {number} y CSS pixels */
  ray(x, y) {
    const seen = new THREE.Vector2(
      (2 * x) / this.width - 1,
      1 - (2 * y) / this.height,
    );
    const caster = new THREE.Raycaster();
    caster.setFromCamera(seen, this.rig.camera(this.aspect));
    return caster.ray;
  }

  /**
   * Where a vertex is seen, in CSS pixels of the canvas; on the far side too.
   *
   * @param {number} vertex
   */
  seen(vertex) {
    const camera = this.rig.camera(this.aspect);
    const point = new THREE.Vector3(...this.surface.point(vertex)).project(camera);
    return { x: ((point.x + 1) / 2) * this.width, y: ((1 - point.y) / 2) * this.height };
  }

  /** @param {Marker[]} markers */
  setMarkers(markers) {
    clear(this.markers);
    for (const { vertex, colour } of markers) {
      const material = new THREE.MeshLambertMaterial({ color: new THREE.Color().setRGB(...colour, THREE.SRGBColorSpace) });
      const ball = new THREE.Mesh(BALL, material);
      ball.position.set(...this.surface.point(vertex));
      this.markers.add(ball);
    }
  }

  /**
   * Curves over the surface, given as drawn points (k, 3).
   *
   * @param {Array<{points: number[], colour: number[], width?: number}>} curves
   */
  setCurves(curves) {
    clear(this.curves);
    for (const { points, colour, width = 4 } of curves) {
      if (points.length < 6) continue;
      const geometry = new LineGeometry().setPositions(points);
      const color = new THREE.Color().setRGB(...colour, THREE.SRGBColorSpace);
      const material = new LineMaterial({ color, linewidth: width, polygonOffset: true, polygonOffsetFactor: -4, polygonOffsetUnits: -8 });
      this.curves.add(new Line2(geometry, material));
    }
  }

  /** Corners of faces are needed for their own values and their edges only. */
  #shape() {
    const { domain, wires } = this.paint.material.uniforms;
    if (domain.value !== 2 && wires.value === 0) return this.shapes.joined;
    this.shapes.split ??= splitGeometry(this.surface);
    return this.shapes.split;
  }

  /** @param {?THREE.Object3D} arrows instead of those that are drawn */
  setArrows(arrows) {
    clear(this.arrows);
    if (arrows) this.arrows.add(arrows);
  }

  /** Draw every pixel, or each as large as four while things move under a software renderer. @param {boolean} fine */
  setDetail(fine) {
    if (!this.software || fine === this.fine) return;
    this.fine = fine;
    this.renderer.setPixelRatio(fine ? PIXEL_RATIO : PIXEL_RATIO / 2);
  }

  render() {
    this.stale = false;
    if (this.mesh) this.mesh.geometry = this.#shape();
    for (const ball of this.markers.children) ball.scale.setScalar(MARKER * this.rig.reach);
    for (const line of /** @type {Line2[]} */ (this.curves.children)) line.material.resolution.set(this.width, this.height);
    this.renderer.render(this.scene, this.rig.camera(this.aspect));
  }
}

/** Every vertex once: a sixth of the work of corners. @param {import("./surface.js").Surface} surface */
function joinedGeometry({ positions, normals, faces, nVertices }) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setAttribute("normal", new THREE.BufferAttribute(normals, 3));
  geometry.setAttribute("corner", new THREE.BufferAttribute(Float32Array.from({ length: nVertices }, (_, v) => v), 1));
  geometry.setIndex(new THREE.BufferAttribute(Uint32Array.from(faces), 1));
  return geometry;
}

/** @param {HTMLCanvasElement} canvas @param {boolean} antialias a software renderer spends more on it than on all else */
function rendererOf(canvas, antialias) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias, powerPreference: "high-performance" });
  renderer.setPixelRatio(PIXEL_RATIO);
  return renderer;
}

/** Whether the browser draws without a graphics processor. */
function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = info ? String(gl.getParameter(info.UNMASKED_RENDERER_WEBGL)) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

/** Every face with corners of its own, so that it can have one value, and know its edges.
 *  @param {import("./surface.js").Surface} surface */
function splitGeometry({ positions, normals, faces }) {
  const n = faces.length;
  const [place, normal, corner] = [new Float32Array(3 * n), new Float32Array(3 * n), new Float32Array(n)];
  for (let k = 0; k < n; k++) {
    const vertex = faces[k];
    corner[k] = vertex;
    for (let axis = 0; axis < 3; axis++) {
      place[3 * k + axis] = positions[3 * vertex + axis];
      normal[3 * k + axis] = normals[3 * vertex + axis];
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(place, 3));
  geometry.setAttribute("normal", new THREE.BufferAttribute(normal, 3));
  geometry.setAttribute("corner", new THREE.BufferAttribute(corner, 1));
  return geometry;
}

/** @param {THREE.Group} group */
function clear(group) {
  for (const one of /** @type {any[]} */ ([...group.children])) {
    group.remove(one);
    one.material?.dispose();
    if (one.isInstancedMesh) one.dispose();
    else if (one.geometry !== BALL && !one.geometry?.userData.shared) one.geometry?.dispose();
  }
}
