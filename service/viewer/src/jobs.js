/** Jobs: asked, followed as they run, cancelled, and their errors in words. */

import { FINISHED, Refused, dismiss, follow, jobs as recent, submit } from "./api.js";
import { h } from "./dom.js";

/** Jobs of earlier visits that are listed. */
const LISTED = 5;
/** What a person may do about a refusal, by status. @type {Record<number, string>} */
const ADVICE = {
  404: "It may have been forgotten: compute it again.",
  410: "It was forgotten to make room: compute it again.",
  413: "Use a smaller mesh, or raise the limit in the service's settings.",
  429: "Wait until some jobs are done, or cancel one.",
  503: "Its Redis or its workers are away: look at the terminal where it was started.",
};

export class JobDismissed extends Error {}

export class Jobs {
  /** @param {HTMLElement} parent */
  constructor(parent) {
    this.list = h("ul", { class: "plain jobs", "aria-label": "Jobs" });
    this.empty = h("p", { class: "note" }, "Nothing was computed yet.");
    parent.append(this.empty, this.list);
    /** @type {Map<string, {row: HTMLElement, show: (job: import("./api.js").Job) => void}>} */
    this.rows = new Map();
    /** The latest answered question of each title. @type {Map<string, {id: string, spec: any}>} */
    this.answered = new Map();
    this.onAnswer = () => {};
  }

  /** List what was asked before. */
  async remember() {
    for (const job of (await recent(LISTED)).reverse()) {
      this.#row(job.id, job.kind).show(job);
      if (!FINISHED.has(job.status)) this.#watch(job.id).catch(() => {});
    }
  }

  /**
   * Ask a question and wait for its answer.
   *
   * @param {any} spec
   * @param {string} title for people
   * @param {(job: import("./api.js").Job) => void} [onChange]
   * @returns {Promise<string>} id of the artifact
   */
  async run(spec, title, onChange) {
    const job = await submit(spec);
    const { show } = this.#row(job.id, title);
    show(job);
    onChange?.(job);
    const last = FINISHED.has(job.status) ? job : await this.#watch(job.id, onChange);
    if (last.status === "dismissed") throw new JobDismissed(`${title} was cancelled.`);
    if (last.status === "failed") throw new Error(`${title} failed: ${last.error?.detail ?? "no reason was given"}`);
    this.answered.delete(title);
    this.answered.set(title, { id: job.id, spec });
    this.onAnswer();
    return job.id;
  }

  /** @param {string} id @param {(job: import("./api.js").Job) => void} [onChange] */
  async #watch(id, onChange) {
    let last;
    for await (const job of follow(id)) {
      last = job;
      this.rows.get(id)?.show(job);
      onChange?.(job);
    }
    return /** @type {import("./api.js").Job} */ (last);
  }

  /** @param {string} id @param {string} title */
  #row(id, title) {
    this.empty.hidden = true;
    this.rows.get(id)?.row.remove();
    const bar = h("progress", { max: 100, value: 0, "aria-label": `Progress of ${title}` });
    const state = h("span", { class: "note" });
    const error = h("p", { class: "bad", role: "alert" });
    const cancel = h("button", { type: "button", class: "quiet", title: "Cancel this job, for everyone", "aria-label": `Cancel ${title}`, onclick: () => dismiss(id).catch(() => {}) }, "✕");
    const row = h("li", { "data-job": id, title: id }, h("span", { class: "grow" }, title), state, cancel, bar, error);
    const show = (/** @type {import("./api.js").Job} */ job) => {
      const ended = FINISHED.has(job.status);
      row.dataset.status = job.status;
      state.textContent = job.status === "running" ? `${Math.round(job.progress)} %` : { successful: took(job) }[job.status] ?? job.status;
      bar.value = job.progress;
      bar.hidden = cancel.hidden = ended;
      error.textContent = job.status === "failed" ? (job.error?.detail ?? "It failed without a reason.") : ended ? "" : job.phase;
      error.className = job.status === "failed" ? "bad" : "note";
      error.hidden = error.textContent === "";
    };
    const made = { row, show };
    this.rows.set(id, made);
    this.list.prepend(row);
    return made;
  }
}

/** @param {import("./api.js").Job} job */
function took({ started_at, finished_at }) {
  if (!started_at || !finished_at) return "done";
  return `${((Date.parse(finished_at) - Date.parse(started_at)) / 1000).toFixed(1)} s`;
}

/** What went wrong, and what to do about it. @param {any} error @returns {string} */
export function inWords(error) {
  const advice = error instanceof Refused ? ADVICE[error.status] : null;
  return [error?.message ?? String(error), advice].filter(Boolean).join("\n");
}
