/** What a surface is painted with: one number a vertex or face through a colour map, and a tint a vertex over it. */

import * as THREE from "three";
import { colourTable } from "./colours.js";

const WIDTH = 1024;

const VERTEX = /* glsl */ `
in float corner;
out vec3 vPosition, vNormal, vBarycentric;
out float vValue;
out vec4 vTint;
uniform highp sampler2D values;
uniform sampler2D tints;
uniform int domain;
uniform bool tinted;

ivec2 place(int k) { return ivec2(k % ${WIDTH}, k / ${WIDTH}); }

void main() {
  int vertex = int(corner + 0.5);
  vValue = domain == 0 ? 0.0 : texelFetch(values, place(domain == 1 ? vertex : gl_VertexID / 3), 0).r;
  vTint = tinted ? texelFetch(tints, place(vertex), 0) : vec4(0.0);
  int k = gl_VertexID % 3;
  vBarycentric = vec3(k == 0, k == 1, k == 2);
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  vPosition = seen.xyz;
  vNormal = normalMatrix * normal;
  gl_Position = projectionMatrix * seen;
}`;

const FRAGMENT = /* glsl */ `
in vec3 vPosition, vNormal, vBarycentric;
in float vValue;
in vec4 vTint;
out vec4 colour;
uniform sampler2D table;
uniform int domain;
uniform bool logarithmic, fading, smoothly, tinted;
uniform float low, high, isolines, wires;
uniform vec3 clay, wire;

void main() {
  vec3 flatNormal = normalize(cross(dFdx(vPosition), dFdy(vPosition)));
  vec3 n = smoothly ? normalize(vNormal) : flatNormal;
  bool back = !gl_FrontFacing;
  if (dot(n, flatNormal) < 0.0 && smoothly && back) n = -n;
  vec3 base = clay;
  if (domain != 0) {
    float t = logarithmic
      ? (log(max(vValue, 1e-30)) - log(low)) / (log(high) - log(low))
      : (vValue - low) / (high - low);
    vec3 mapped = texture(table, vec2(0.5 / 256.0 + clamp(t, 0.0, 1.0) * 255.0 / 256.0, 0.5)).rgb;
    float full = fading ? smoothstep(0.0, 0.12, t) : 1.0;
    base = mix(base, mapped, full);
    if (isolines > 0.0 && domain == 1 && t > 0.0 && t < 1.0) {
      float level = t * isolines;
      float step = max(fwidth(level), 1e-6);
      float line = 1.0 - smoothstep(0.6, 1.5, abs(fract(level - 0.5) - 0.5) / step);
      base = mix(base, base * 0.25, 0.85 * line * (1.0 - smoothstep(0.2, 0.6, step)) * full);
    }
  }
  if (tinted) base = mix(base, vTint.rgb, vTint.a);
  // Light comes over the left shoulder; what faces away from the eye darkens.
  const vec3 LIGHT = vec3(0.2988, 0.4695, 0.8308);
  float lit = max(dot(n, LIGHT), 0.0);
  float away = 1.0 - max(n.z, 0.0);
  vec3 shade = base * (0.49 + 0.5 * lit + 0.07 * n.y - 0.1 * away * away * away);
  if (back) shade *= 0.55;
  if (wires > 0.0) {
    vec3 edge = vBarycentric / max(fwidth(vBarycentric), vec3(1e-6));
    float near = min(min(edge.x, edge.y), edge.z);
    shade = mix(shade, wire, wires * (1.0 - smoothstep(0.4, 1.2, near)));
  }
  colour = vec4(shade, 1.0);
}`;

/** @typedef {{domain: "vertex" | "face", values: ArrayLike<number>, low: number, high: number, logarithmic?: boolean,
 *             fading?: boolean, map: string, isolines?: number}} Layer */

export class Paint {
  /** @param {import("./surface.js").Surface} surface */
  constructor(surface) {
    this.surface = surface;
    this.values = texture(Float32Array, Math.max(surface.nVertices, surface.nFaces), THREE.RedFormat, THREE.FloatType);
    this.tints = texture(Uint8Array, 4 * surface.nVertices, THREE.RGBAFormat, THREE.UnsignedByteType);
    this.table = new THREE.DataTexture(colourTable("violet–yellow"), 256, 1, THREE.RGBAFormat);
    this.table.minFilter = this.table.magFilter = THREE.LinearFilter;
    this.table.needsUpdate = true;
    this.tableName = "violet–yellow";
    this.material = new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: surface.solid ? THREE.FrontSide : THREE.DoubleSide,
      uniforms: {
        values: { value: this.values },
        tints: { value: this.tints },
        table: { value: this.table },
        domain: { value: 0 },
        logarithmic: { value: false },
        fading: { value: false },
        smoothly: { value: true },
        tinted: { value: false },
        low: { value: 0 },
        high: { value: 1 },
        isolines: { value: 0 },
        wires: { value: 0 },
        clay: { value: new THREE.Color() },
        wire: { value: new THREE.Color() },
      },
    });
  }

  /** Numbers at vertices, to be written in place; `refresh` shows them. */
  get numbers() {
    return /** @type {Float32Array} */ (this.values.image.data);
  }

  /** Show what was written into `numbers`. */
  refresh() {
    this.values.needsUpdate = true;
  }

  /** @param {?Layer} layer what to show; null shows bare clay */
  show(layer) {
    const u = this.material.uniforms;
    u.domain.value = layer === null ? 0 : layer.domain === "vertex" ? 1 : 2;
    if (layer === null) return;
    if (layer.values !== this.numbers) this.numbers.set(layer.values);
    this.refresh();
    u.low.value = layer.low;
    u.high.value = layer.high;
    u.logarithmic.value = layer.logarithmic ?? false;
    u.fading.value = layer.fading ?? false;
    u.isolines.value = layer.isolines ?? 0;
    if (layer.map !== this.tableName) {
      this.tableName = layer.map;
      /** @type {any} */ (this.table.image).data = colourTable(layer.map);
      this.table.needsUpdate = true;
    }
  }

  /** @param {number} low @param {number} high */
  setRange(low, high) {
    this.material.uniforms.low.value = low;
    this.material.uniforms.high.value = high;
  }

  /** @param {?Uint8Array} rgba (V, 4), drawn over everything else by their alpha; null for none */
  tint(rgba) {
    this.material.uniforms.tinted.value = rgba !== null;
    if (rgba === null) return;
    /** @type {Uint8Array} */ (this.tints.image.data).set(rgba);
    this.tints.needsUpdate = true;
  }

  dispose() {
    for (const one of [this.values, this.tints, this.table, this.material]) one.dispose();
  }
}

/**
 * @template {Float32Array | Uint8Array} T
 * @param {new (length: number) => T} Kind @param {number} length @param {any} format @param {any} type
 */
function texture(Kind, length, format, type) {
  const channels = format === THREE.RedFormat ? 1 : 4;
  const height = Math.max(1, Math.ceil(length / channels / WIDTH));
  const made = new THREE.DataTexture(new Kind(channels * WIDTH * height), WIDTH, height, format, type);
  made.needsUpdate = true;
  return made;
}
