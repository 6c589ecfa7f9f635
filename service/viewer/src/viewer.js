/** The page: two linked views of a soft map, and everything that can be asked about it. */

import "./viewer.css";
import { Look } from "./look.js";
import { Viewer } from "./session.js";

/** @param {string} id @returns {any} */
const part = (id) => document.getElementById(id);

const viewer = new Viewer({
  canvases: { source: part("canvas-source"), target: part("canvas-target") },
  overlays: { source: part("over-source"), target: part("over-target") },
  status: part("status"),
});
new Look(viewer, part("look"));
// For the console, and for whoever measures.
/** @type {any} */ (window).softmaps = viewer;
viewer.open().catch((error) => viewer.say(error.message));
