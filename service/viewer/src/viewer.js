/** The page: two linked views of a soft map, and everything that can be asked about it. */

import "./viewer.css";
import { h } from "./dom.js";
import { Jobs, inWords } from "./jobs.js";
import { Landmarks } from "./landmarks.js";
import { Look } from "./look.js";
import { Motion } from "./motion.js";
import { Pins } from "./pins.js";
import { Question } from "./question.js";
import { Viewer } from "./session.js";
import { Share } from "./share.js";
import { Shown } from "./shown.js";
import { Tools } from "./tools.js";

/** @param {string} id @returns {any} */
const part = (id) => document.getElementById(id);

/** @param {string} title @param {boolean} open @returns {HTMLElement} what goes below the title */
function panel(title, open) {
  const body = h("div");
  part("panels").append(h("details", { open }, h("summary", {}, title), body));
  return body;
}

const rooms = {
  question: panel("Soft map", true),
  jobs: panel("Jobs", true),
  brush: panel("Brush", true),
  shown: panel("Colours", true),
  motion: panel("Momentum and paths", false),
  landmarks: panel("Optimal map", false),
  share: panel("Take away", false),
};
const jobs = new Jobs(rooms.jobs);
const canvases = { source: part("canvas-source"), target: part("canvas-target") };
const overlays = { source: part("over-source"), target: part("over-target") };
const viewer = new Viewer({ canvases, overlays, status: part("status") }, jobs);
const question = new Question(viewer, rooms.question, part("stage"));
const tools = new Tools(viewer, part("tools"), part("stage"));
new Look(viewer, part("look"));
new Pins(viewer, rooms.brush);
for (const side of /** @type {const} */ (["source", "target"])) new Shown(viewer, side, rooms.shown);
new Motion(viewer, rooms.motion, tools);
new Landmarks(viewer, rooms.landmarks, tools, question);
const share = new Share(viewer, rooms.share);
document.addEventListener("keydown", (event) => {
  const typing = event.target instanceof Element && event.target.matches("input, textarea, select");
  if (!typing && !event.ctrlKey && !event.metaKey && event.key === "x") share.picture();
});

// For the console, and for whoever measures.
/** @type {any} */ (window).softmaps = viewer;

// What cannot be listed keeps nobody from looking.
for (const one of await Promise.allSettled([viewer.open(), question.refresh(), jobs.remember()])) {
  if (one.status === "rejected") viewer.say(inWords(one.reason));
}
