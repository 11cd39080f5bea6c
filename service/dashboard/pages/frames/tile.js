// A frame of the gallery: its picture, or in its place why there is none, and whose it is.
import { at } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { frameLabel, frameTitle, time } from "../lib/format.js";
import { picture } from "../lib/picture.js";
import { coded } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { badge, isPending, sentence } from "./badge.js";

// 24 of these are 0.4 MB of depth or patches and 0.8 MB of normals; wider ones look no better, as
// validation sees 160 columns
export const PREVIEW = 240;
const VIEW = { depth: "Depth", normals: "Normals", patches: "Patches" };

/**
 * The picture of a frame, filling whatever holds it; or why there is none.
 * @param {Object<string, any>} frame as the API tells it
 * @param {{view?: "depth" | "normals" | "patches", width?: number, signal?: AbortSignal}} how
 * @returns {HTMLElement}
 */
export function preview(frame, { view = "depth", width = PREVIEW, signal }) {
  if (frame.state === "indexed") {
    const path = `${at("maps", frame.map, "frames", frame.frame_id)}/preview.png`;
    const alt = `${VIEW[view]} of frame ${frameLabel(frame)}`;
    const shown = picture(path, { view, width }, { alt, width, height: 0.75 * width, signal });
    return h("div", { class: "frame-picture" }, shown);
  }
  return h("div", { class: "frame-picture frame-why", dataset: { state: frame.state } },
    h("strong", {}, isPending(frame.state) ? "No picture yet" : `Not searchable`),
    h("p", {}, coded(frame.reason ?? sentence(frame.state))));
}

/**
 * A tile; `show(frame, view)` draws it again when either has changed.
 * @param {Object<string, any>} frame
 * @param {{view: string, signal?: AbortSignal, tick?: Element | null}} how tick: a box that selects it
 * @returns {HTMLElement & {show: (frame: Object<string, any>, view: string) => void, frame: any}}
 */
export function tile(frame, { view, signal, tick = null }) {
  const shown = h("div", { class: "tile-top" });
  const words = h("div", { class: "tile-words" });
  const element = Object.assign(h("li", { class: "tile", dataset: { frame: frame.frame_id } }, shown, words, tick), { show, frame });
  /** @type {string | null} */
  let drawn = null;
  function show(given, wanted) {
    element.frame = given;
    const looks = `${given.state} ${given.reason} ${wanted}`;
    if (looks !== drawn) put(shown, preview(given, { view: wanted, signal }));
    drawn = looks;
    const href = link("maps", given.map, "frames", given.frame_id, wanted === "depth" ? {} : { view: wanted });
    put(words,
      h("div", { class: "tile-name" },
        h("a", { href, class: "mono", title: frameTitle(given) }, frameLabel(given)), badge(given.state)),
      h("div", { class: "tile-who" }, who(given)),
      h("div", { class: "tile-when muted" }, when(given), given.kind === "cloud" && " · cloud"));
  }
  show(frame, view);
  return element;
}

/** Who took a frame, in which run. @param {Object<string, any>} frame @returns {string} */
export function who(frame) {
  return [frame.robot, frame.session].filter(Boolean).join(" · ") || "No robot, no session";
}

/** When a frame was taken, or else came. @param {Object<string, any>} frame */
export function when(frame) {
  return frame.captured_at ? ["taken ", time(frame.captured_at)] : ["received ", time(frame.received_at)];
}
