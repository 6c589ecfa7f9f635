/** The service over HTTP: artifacts and arrays, uploads, jobs and their events, problems in words. */

/** @typedef {{id: string, kind: string, spec: any, parents: Record<string, string>, values: Record<string, any>,
 *             arrays: Record<string, {shape: number[], dtype: string, href: string}>}} Artifact */
/** @typedef {{id: string, kind: string, status: string, progress: number, phase: string, created_at: string,
 *             started_at: ?string, finished_at: ?string, error: ?{title: string, detail: string},
 *             tasks: Array<{id: string, kind: string, status: string}>, values?: Record<string, any>}} Job */
/** @typedef {{data: Float64Array | Int32Array | Uint8Array, shape: number[]}} Numbers */

export const FINISHED = new Set(["successful", "failed", "dismissed"]);
/** Bytes of arrays that came over the network or out of the browser's cache. */
export const traffic = { bytes: 0 };

const TOKEN = "softmaps-token";
/** @type {Map<string, Promise<any>>} what never changes is asked for once */
const known = new Map();

/** Why the service refused, in its own words. */
export class Refused extends Error {
  /** @param {number} status @param {any} problem */
  constructor(status, problem) {
    const errors = (problem?.errors ?? []).map((one) => `${one.pointer}: ${one.detail}`);
    super([problem?.detail ?? `the service answered ${status}`, ...errors].join("\n"));
    this.status = status;
    this.problem = problem;
  }
}

/**
 * @param {string} address
 * @param {RequestInit} [options]
 * @returns {Promise<Response>}
 */
async function ask(address, options = {}) {
  const token = sessionStorage.getItem(TOKEN);
  const headers = { ...options.headers, ...(token ? { Authorization: `Bearer ${token}` } : {}) };
  let response;
  try {
    response = await fetch(address, { ...options, headers });
  } catch (error) {
    if (options.signal?.aborted) throw error;
    throw new Error("The service does not answer. Is it still running?");
  }
  if (response.ok) return response;
  const problem = await response.json().catch(() => null);
  if (response.status === 401) {
    const given = window.prompt("This service wants its token:");
    if (given) {
      sessionStorage.setItem(TOKEN, given.trim());
      return ask(address, options);
    }
  }
  throw new Refused(response.status, problem);
}

/** @param {string} address @param {RequestInit} [options] */
const json = async (address, options) => (await ask(address, options)).json();

/** @param {string} key @param {() => Promise<any>} make */
function once(key, make) {
  let promise = known.get(key);
  if (!promise) {
    promise = make();
    known.set(key, promise);
    promise.catch(() => known.delete(key));
  }
  return promise;
}

/** @param {string} id @returns {Promise<Artifact>} */
export const artifact = (id) => once(id, () => json(`/v1/artifacts/${id}`));

/**
 * Array of an artifact, row-major; integers come as 32 bits.
 *
 * @param {string} id
 * @param {string} name
 * @returns {Promise<Numbers>}
 */
export const array = (id, name) => once(`${id}/${name}`, () => fetchArray(id, name));

/** @param {string} id @param {string} name @returns {Promise<Numbers>} */
async function fetchArray(id, name) {
  const response = await ask(`/v1/artifacts/${id}/arrays/${name}`, { headers: { Accept: "application/octet-stream" } });
  const buffer = await response.arrayBuffer();
  traffic.bytes += buffer.byteLength;
  const shape = (response.headers.get("Array-Shape") ?? "").split(",").filter(Boolean).map(Number);
  return { data: typed(buffer, response.headers.get("Array-Dtype") ?? ""), shape };
}

/** @param {ArrayBuffer} buffer @param {string} dtype */
function typed(buffer, dtype) {
  if (dtype === "float64") return new Float64Array(buffer);
  if (dtype === "int32") return new Int32Array(buffer);
  if (dtype === "bool") return new Uint8Array(buffer);
  // Indices and small integers: the low words hold them, sign included.
  const words = new Int32Array(buffer);
  return Int32Array.from({ length: words.length / 2 }, (_, k) => words[2 * k]);
}

/**
 * All artifacts of a kind.
 *
 * @param {string} kind
 * @returns {Promise<Artifact[]>}
 */
export async function artifacts(kind) {
  const found = [];
  let cursor = "";
  do {
    const page = await json(`/v1/artifacts?kind=${kind}&limit=200${cursor && `&cursor=${encodeURIComponent(cursor)}`}`);
    found.push(...page.items);
    cursor = page.next;
  } while (cursor);
  return found;
}

/** @param {number} limit @returns {Promise<Job[]>} the newest first */
export const jobs = async (limit) => (await json(`/v1/jobs?limit=${limit}`)).items;

/**
 * Upload a mesh as it is.
 *
 * @param {Blob} content
 * @param {string} name
 * @returns {Promise<any>} its facts
 */
export function uploadMesh(content, name) {
  const ending = name.split(".").pop()?.toLowerCase() ?? "";
  const format = ["off", "obj", "ply", "stl", "glb"].includes(ending) ? `&format=${ending}` : "";
  const headers = { "Content-Type": "application/octet-stream" };
  return json(`/v1/meshes?name=${encodeURIComponent(name.slice(0, 200))}${format}`, { method: "POST", headers, body: content });
}

/** @param {string} pose @returns {Promise<any>} facts of the built-in creature in one pose */
export async function uploadCreature(pose) {
  const file = await ask(`/viewer/creature/${pose}.off`);
  return uploadMesh(await file.blob(), `creature-${pose}.off`);
}

/**
 * Upload an array, given as nested lists.
 *
 * @param {any[]} list
 * @param {string} name
 * @returns {Promise<any>}
 */
export function uploadArray(list, name) {
  const headers = { "Content-Type": "application/json" };
  const address = `/v1/arrays?name=${encodeURIComponent(name.slice(0, 200))}`;
  return json(address, { method: "POST", headers, body: JSON.stringify(list) });
}

/** @param {Blob} content a .npy file @param {string} name @returns {Promise<any>} */
export function uploadNpy(content, name) {
  const headers = { "Content-Type": "application/x-npy" };
  const address = `/v1/arrays?name=${encodeURIComponent(name.slice(0, 200))}`;
  return json(address, { method: "POST", headers, body: content });
}

/** @param {any} spec @returns {Promise<Job>} */
export const submit = (spec) =>
  json("/v1/jobs", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(spec) });

/** @param {string} id of a job @returns {Promise<?Float64Array>} coefficients that its search has found so far */
export async function snapshot(id) {
  try {
    const response = await ask(`/v1/jobs/${id}/snapshot`, { headers: { Accept: "application/octet-stream" } });
    return new Float64Array(await response.arrayBuffer());
  } catch (error) {
    if (error instanceof Refused && error.status === 404) return null;
    throw error;
  }
}

/** @param {string} id @returns {Promise<Job>} */
export const dismiss = (id) => json(`/v1/jobs/${id}`, { method: "DELETE" });

/**
 * States of a job, now and after each change, the final one last. Not an EventSource, which can carry no token.
 *
 * @param {string} id
 * @param {AbortSignal} [signal]
 * @returns {AsyncGenerator<Job>}
 */
export async function* follow(id, signal) {
  for (;;) {
    const response = await ask(`/v1/jobs/${id}/events`, { signal });
    for await (const event of events(response)) {
      yield event;
      if (FINISHED.has(event.status)) return;
    }
    // The stream ended early: the service was restarted.
    await new Promise((resolve) => setTimeout(resolve, 1000));
  }
}

/** @param {Response} response @returns {AsyncGenerator<Job>} */
async function* events(response) {
  const reader = /** @type {ReadableStream} */ (response.body).pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      const blocks = (rest + value).split("\n\n");
      rest = /** @type {string} */ (blocks.pop());
      for (const block of blocks) {
        const line = block.split("\n").find((one) => one.startsWith("data:"));
        if (line) yield JSON.parse(line.slice(5));
      }
    }
  } finally {
    reader.cancel().catch(() => {});
  }
}
