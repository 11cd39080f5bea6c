// A map's home: the place as its frames saw it, where robots went through it, where they are, and
// where they got lost.

import { at, send, watch } from "../lib/api.js";
import { h, once, put } from "../lib/dom.js";
import { count, things } from "../lib/format.js";
import { picture } from "../lib/picture.js";
import { link } from "../lib/router.js";
import { may } from "../lib/session.js";
import { empty } from "../lib/states.js";
import { answerOf } from "../paths/asked.js";
import { associationsOf, runsOf, sessionsOf } from "../paths/data.js";
import { leftOut } from "../paths/legend.js";
import { Runs } from "../paths/runs.js";
import { createScene } from "../paths/scene.js";
import { dot } from "../viewer/matrix.js";
import { crosses } from "../viewer/shapes.js";
import { Robots } from "./robots.js";
import { COLOURS, shades } from "./shades.js";
import { sightings } from "./spot.js";
import { Surface } from "./surface.js";
import { keepPicture, Tools } from "./tools.js";

export const styles = ["paths/paths.css", "place/place.css", "query/alternatives.css"];

/** How often a surface that is built is asked for, and one that may be soon. */
const BUILDING_MS = 1500, WAITING_MS = 6000;
const TOGETHER_MS = 1500; // frames of a burst are one look
const CHANGES = new Set(["events.missed", "frame.indexed", "frame.deleted", "frame.edited", "surface.updated"]);
/** Frames are told from so far below the plan to so far above it, metres. */
const TALL = 1000;

export async function render(root, { params: { map }, search, signal, go }) {
  const stage = h("div", { class: "paths-stage" });
  const scene = createScene(stage, { signal, onview: () => place?.looked() });
  const surface = new Surface({ map, signal, scene, onready: () => place?.measured() });
  const query = search.get("query");
  /** @type {Place | null} */
  let place = null;
  const [sessions, associations, asked] = await Promise.all([
    sessionsOf(map, signal), associationsOf(map, signal),
    query ? answerOf(query, map, signal).catch((error) => missing(error, query)) : null,
    surface.load(),
  ]);
  const told = runsOf(sessions.items);
  if (!told.runs.length && !surface.record.parents.length && surface.record.frames_left === 0) {
    put(root, nothing(map, told.without));
    return;
  }
  place = new Place(root, { map, search, signal, go, stage, scene, surface, ...told, more: sessions.more, associations, asked });
  await place.begin();
}

/** An answer that is kept no more is no reason to show no place. */
function missing(error, query) {
  if (error.status !== 404) throw error;
  return { gone: query };
}

function nothing(map, without) {
  const text = without.length
    ? "None of its frames has a pose, so where they were taken is not known. Upload frames with poses, or add poses to those that are there."
    : "Upload frames with poses to see the place here, and the paths of robots through it.";
  const box = empty({ title: without.length ? "This map has no poses" : "This map is empty", text, actions: [
    may("write", map) && h("a", { class: "button primary", href: link("maps", map, "upload") }, "Upload frames"),
    without.length > 0 && h("a", { class: "button", href: link("maps", map) }, "Show its frames"),
  ] });
  const list = leftOut(without);
  if (list) box.append(list);
  return box;
}

class Place {
  /** @type {Timer} */
  #timer = null;

  constructor(root, told) {
    const { map, search, signal, go, stage, scene, surface } = told;
    /** @type {HTMLElement} */
    this.stage = stage;
    this.map = map;
    this.signal = signal;
    this.go = go;
    /** @type {import("../paths/scene.js").Scene} */
    this.scene = scene;
    /** @type {Surface} */
    this.surface = surface;
    this.flat = search.get("view") !== "3d";
    surface.colour = COLOURS.some(([name]) => name === search.get("colour")) ? search.get("colour") : "height";
    const [low, high] = ["low", "high"].map((name) => (search.get(name) ? Number(search.get(name)) : NaN));
    surface.isChosen = Number.isFinite(low) || Number.isFinite(high) || search.get("heights") === "all";
    surface.cut = Number.isFinite(low) || Number.isFinite(high) ? [Number.isFinite(low) ? low : -1e9, Number.isFinite(high) ? high : 1e9] : null;
    const names = surface.record.parents.map((one) => one.parent_frame);
    const onchange = () => this.address();
    this.runs = new Runs({
      ...told, names, onchange: () => { this.robots.draw(); onchange(); }, onreveal: () => this.spot.close(),
      onframe: (...frame) => this.#frame(...frame),
    });
    this.robots = new Robots({ map, signal, search, scene, runs: this.runs, onchange });
    this.shades = shades(surface, onchange);
    this.spot = sightings({ map, signal, onclose: () => this.#unmark() });
    this.tools = new Tools({
      stage, scene, surface, onframe: (one) => this.runs.choose(one), onspot: (spot) => this.#spot(spot),
      onbox: (corners) => this.#boxed(corners), onplan: () => this.#turn(true),
    });
    const button = (text, onClick, id) => h("button", { class: "button", type: "button", id, onClick }, text);
    this.views = [[true, "Plan"], [false, "3-D"]].map(([flat, text]) => h("button", {
      class: "button", type: "button", "aria-pressed": flat === this.flat, onClick: () => this.#turn(Boolean(flat)),
    }, String(text)));
    this.notice = h("div", { class: "place-notice", role: "status", hidden: true });
    this.bar = h("div", { class: "toolbar" }, h("div", { class: "place-views", role: "group", "aria-label": "View" }, this.views),
      button("Fit", () => this.scene.look("keep")), this.tools.buttons.measure, this.tools.buttons.box,
      button("Save picture", once(() => this.#keep())));
    put(root, h("div", { class: "paths" },
      h("div", { class: "paths-main" }, this.bar, this.notice, stage, this.tools.said, this.robots.bar, this.spot.element, this.runs.card.element, this.runs.words),
      h("div", { class: "paths-side" }, this.runs.asks, this.shades.element, this.robots.section, this.runs.section, this.runs.joinsBox), this.runs.said));
    signal.addEventListener("abort", () => { clearTimeout(this.#timer); this.robots.stop(); }, { once: true });
  }

  /** Draw it, and follow what happens. */
  async begin() {
    const records = this.robots.load();
    await this.runs.draw();
    this.#colours();
    await records;
    this.#state();
    this.#follow();
  }

  // the picture begins with the surface, or where there is none with the poses
  #frame(parent, reached, up, poses) {
    const { surface, scene } = this, told = surface.parent(parent), middle = surface.middle(parent);
    const label = `The place ${this.map} in ${parent}; Enter lists the frames that saw its middle`;
    if (told && middle) {
      if (poses) return true;
      const own = { above: ["x", "y", "z"].map((k) => told.up[k]), ahead: told.y_axis };
      scene.begin({ origin: middle, up: up ?? own, label, flat: this.flat });
    } else if (poses) {
      const found = poses();
      scene.begin({ origin: found.origin, up: up ?? found.up, label, flat: this.flat });
    } else {
      return false;
    }
    this.spot.close(); // it was of another picture
    this.tools.choose(null);
    this.#blind(parent);
    this.tools.offer(Boolean(told));
    surface.show(new Map([...reached].map(([name, one]) => [name, one.matrix])));
    scene.look("keep");
    return true;
  }

  /** Without WebGL the picture from above stands in its place. */
  #blind(parent) {
    if (this.scene.viewer.available) return;
    this.bar.hidden = true;
    if (!this.surface.parent(parent)) return;
    const shown = picture(at("maps", this.map, "surface", "plan.png"), { parent }, { alt: `The place in ${parent}, seen from above`, width: 1024, height: 576, signal: this.signal });
    shown.classList.add("place-plan");
    put(this.scene.canvas.parentElement ?? this.stage, h("p", { class: "muted place-blind" }, "This browser does not support WebGL 2, which the 3-D view needs. This is the place seen from above."), shown);
  }

  /** It was drawn anew: other tiles may be looked at. */
  looked() { this.surface.later(); }

  /** The heights are known. */
  measured() { this.shades.draw(); }

  #colours() {
    this.surface.colours(this.runs.runs);
    this.shades.draw();
    this.robots.draw();
  }

  /** @param {boolean} flat */
  #turn(flat) {
    if (this.flat !== flat) {
      this.flat = flat;
      this.views.forEach((one, i) => one.setAttribute("aria-pressed", String((i === 0) === flat)));
      this.scene.look(flat ? "plan" : "space");
      this.address();
    }
    if (!flat && this.tools.tool === "box") this.tools.choose(null);
  }

  #unmark() {
    this.scene.viewer?.remove("spot");
    this.scene.mark("spot", []);
  }

  async #spot({ parent, at: place, world, cell }) {
    this.runs.choose(null);
    this.scene.viewer.lines("spot", { positions: crosses([this.scene.near(world)], 6 * cell), tint: "ink", width: 2, onTop: true });
    this.scene.mark("spot", [{ at: world, node: h("span", { class: "paths-label", dataset: { kind: "selected" } }, "Spot") }]);
    const text = place.map((v) => v.toFixed(2)).join(", ");
    await this.spot.show({
      title: `Frames that saw ${text}`, none: "No frame saw this spot.",
      params: { parent, at: place.map((v) => v.toFixed(4)).join(","), radius: cell },
    });
  }

  async #boxed(corners) {
    const { above } = this.scene.axes, ends = corners.flatMap((p) => [-TALL, TALL].map((height) => p.map((x, k) => x + height * above[k])));
    const low = [0, 1, 2].map((k) => Math.min(...ends.map((p) => p[k]))), high = [0, 1, 2].map((k) => Math.max(...ends.map((p) => p[k])));
    // the box of the API has the axes of the parent frame, the one on the screen those of the screen
    const [corner, right, , below] = corners, sides = [right, below].map((p) => p.map((x, k) => x - corner[k]));
    const inside = ({ position: { x, y, z } }) => sides.every((side) => {
      const along = dot(side, [x, y, z].map((v, k) => v - corner[k])) / dot(side, side);
      return along >= 0 && along <= 1;
    });
    this.runs.choose(null);
    this.#unmark();
    await this.spot.show({
      title: "Frames taken in the box", none: "No frame was taken in this box.", inside,
      params: { parent: this.runs.parent, box: [...low, ...high].map((v) => v.toFixed(3)).join(",") },
    });
  }

  async #keep() {
    const when = new Date().toISOString().slice(0, 10);
    await keepPicture(this.stage, this.scene, `${this.map}, ${this.runs.parent}, ${when}`, `${this.map}-place-${when}.png`);
  }

  /** Tell how far the surface is, and ask again while it changes. */
  #state() {
    const { record } = this.surface, write = may("write", this.map);
    const begin = (text) => write && h("button", { class: "button", type: "button", onClick: once(() => this.#begin()) }, text);
    const left = things(record.frames_left, "frame");
    const whole = record.frames + record.frames_left;
    this.notice.hidden = record.state === "ready" || (record.state === "none" && record.frames_left === 0);
    if (record.state === "none") put(this.notice, record.error && h("p", {}, record.error), h("span", {}, `The surface of ${left} is not built yet.`), begin("Build it now"));
    if (record.state === "stale") put(this.notice, record.error && h("p", {}, record.error), h("span", {}, `The surface is out of date: ${left} to add or remove.`), begin("Update it now"));
    if (record.state === "building") put(this.notice, h("span", {}, `Building the surface: ${count(record.frames)} of ${count(whole)} frames`), h("progress", { max: Math.max(whole, 1), value: record.frames, "aria-label": "Progress of the surface" }));
    clearTimeout(this.#timer);
    if (record.state === "ready") return;
    this.#timer = setTimeout(() => this.#again(), record.state === "building" ? BUILDING_MS : WAITING_MS);
  }

  async #begin() {
    await send("POST", at("maps", this.map, "surface"), { signal: this.signal });
    await this.#again();
  }

  async #again() {
    const had = this.surface.record.parents.length, before = JSON.stringify(this.surface.record);
    try {
      await this.surface.load();
    } catch (error) {
      if (error.status !== 0 && error.status !== 503) throw error; // a service that restarts comes back
    }
    if (this.signal.aborted) return;
    if (JSON.stringify(this.surface.record) === before) { this.#state(); return; } // nothing to draw
    if (had === 0 && this.surface.record.parents.length > 0) {
      this.runs.add(this.surface.record.parents.map((one) => one.parent_frame));
      await this.runs.draw();
    }
    if (this.scene.viewer?.isFitted) this.scene.look("keep"); // it may have grown
    this.#colours();
    this.#state();
  }

  #follow() {
    watch({
      map: this.map, kinds: ["query.answered", "frame.", "surface."], signal: this.signal,
      onevent: ({ kind }) => {
        if (kind === "query.answered" || kind === "events.missed") this.robots.heard();
        if (CHANGES.has(kind)) this.#soon();
      },
      onstate: (state) => { if (state === "live") { this.robots.heard(); this.#soon(); } }, // what came before it was live
    });
  }

  #soon() {
    if (this.surface.record.state === "building") return; // it is asked for anyway
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#again(), TOGETHER_MS);
  }

  /** The address says what is shown, so that it survives a reload. */
  address() {
    if (this.signal.aborted) return; // it is another page's by now
    const { colour, cut, isChosen } = this.surface;
    const height = (value) => (!isChosen || value === undefined || Math.abs(value) >= 1e8 ? null : value.toFixed(2));
    const search = {
      ...this.runs.search, view: this.flat ? null : "3d", colour: colour === "height" ? null : colour,
      low: height(cut?.[0]), high: height(cut?.[1]), heights: isChosen && cut === null ? "all" : null,
      at: this.robots.at, since: this.robots.since, until: this.robots.until,
    };
    this.go(link("maps", this.map, "place", search), { replace: true, quiet: true });
  }
}
