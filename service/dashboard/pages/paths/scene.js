// The picture: paths with frustums, edges, the query, the grid, and numbers that float over them.

import { h, put } from "../lib/dom.js";
import { metres } from "../lib/format.js";
import { spread } from "../lib/labels.js";
import { letterOf } from "../query/alternatives.js";
import { Orbit, VIEW } from "../viewer/camera.js";
import { colourOf } from "../viewer/colours.js";
import { around } from "../viewer/layers.js";
import { boxAbout, dot } from "../viewer/matrix.js";
import { crosses, links } from "../viewer/shapes.js";
import { createViewer, frustum } from "../viewer/viewer.js";
import { nearest } from "./pick.js";
import {
  copies, dashes, ellipsoid, grid, hollow, nice, placeOf, polyline, reachAlong, spaced,
} from "./shapes.js";

const FRUSTUMS = 160, CLOSEST = 16; // at first, and how many times as many when one is near
/** How edges of each verdict are drawn. */
export const EDGES = [
  { kind: "consistent", tint: "muted", dash: null },
  { kind: "unchecked", tint: "muted", dash: [0.35, 0.35] },
  { kind: "inconsistent", tint: "violation", dash: [1, 0.7] },
];
/** Layers of a query. */
const ASKED = ["query", "ellipsoid", "alternatives", "matches", "matched"];
/** Where a picture in 3-D begins. */
const ASIDE = { azimuth: 0.6, elevation: 0.55 };

/** Name of a run's colour in paths.css. @param {import("./data.js").Run} run */
export const tintOf = (run) => `path-${run.colour}`;

/**
 * @param {HTMLElement} place where the canvas goes
 * @param {{onview: () => void, signal: AbortSignal}} how onview: it was drawn anew
 */
export function createScene(place, { onview, signal }) {
  const canvas = h("canvas", { class: "paths-canvas" });
  const labels = h("div", { class: "paths-labels", "aria-hidden": "true" });
  const bar = h("span", { class: "paths-bar" });
  const scaleText = h("span", {});
  const ground = h("span", { class: "muted" });
  const scale = h("div", { class: "paths-scale" }, h("span", { class: "paths-ruler" }, bar, scaleText), ground);
  put(place, canvas, labels, scale);
  return new Scene(canvas, { labels, bar, scaleText, ground }, onview, signal);
}

export class Scene {
  #parts;
  /** @type {any} the viewer; null until paths are shown */
  #viewer = null;
  /** @type {{right: number[], ahead: number[], above: number[]}} */
  #axes = new Orbit("z");
  /** @type {(import("./data.js").Path & {world: number[][]})[]} */
  #drawn = [];
  #origin = [0, 0, 0];
  #hidden = new Set();
  /** @type {any} about the paths, less the origin; null about none */
  #box = null;
  /** @type {{box: any, floor: number | null}} of the surface beneath them, as `box` */
  #under = { box: null, floor: null };
  #size = 0.1;
  #ratio = 0;
  #wide = 1;
  /** @type {Object<string, any> | null} */
  #asked = null;
  /** @type {{path: number, place: number} | null} */
  #selected = null;
  /** @type {any[]} */
  #labels = [];

  /** @type {Map<string, {at: number[], node: HTMLElement}[]>} */
  #marks = new Map();

  constructor(canvas, parts, onview, signal) {
    this.canvas = canvas;
    this.#parts = parts;
    this.onview = onview;
    signal.addEventListener("abort", () => this.#viewer?.destroy(), { once: true });
  }

  /** The viewer; null before `begin`. */
  get viewer() { return this.#viewer; }

  /** Directions of the picture: two level ones, and up. */
  get axes() { return this.#axes; }

  /** What is taken off all coordinates, metres. */
  get origin() { return this.#origin; }

  /**
   * Begin a picture in another frame, or with another axis up.
   * @param {{origin: number[], up: import("../viewer/camera.js").Up, label: string, flat: boolean}} what
   *   origin: a point near all that is drawn; label: what is to be seen; flat: as a plan
   */
  begin({ origin, up, label, flat }) {
    this.#origin = [...origin];
    const orbit = new Orbit(up), { above, ahead, right } = orbit;
    this.#axes = { above, ahead, right };
    if (this.#viewer === null) {
      this.#viewer = createViewer(this.canvas, { label, up, antialias: false, onview: () => { this.#moved(); this.onview(); } });
      Object.assign(this.canvas, { viewer: this.#viewer, scene: this }); // whoever debugs finds them there
    } else {
      Object.assign(this.#viewer.orbit, { above, ahead, right });
      this.#viewer.label = label;
    }
    this.#under = { box: null, floor: null };
    this.show([]);
    for (const name of this.#marks.keys()) this.mark(name, []);
    this.#viewer.look({ ...(flat ? { azimuth: 0 } : ASIDE), flat });
  }

  /**
   * Draw other paths.
   * @param {(import("./data.js").Path & {world: number[][]})[]} paths world: poses in the frame of
   *   the picture
   */
  show(paths) {
    const all = paths.flatMap((one) => one.world.map(placeOf));
    for (let i = 0; i < this.#drawn.length; i += 1) {
      this.#viewer.remove(`path ${i}`);
      this.#viewer.remove(`frustums ${i}`);
    }
    this.#drawn = paths;
    this.#hidden = new Set();
    this.#selected = this.#asked = null;
    for (const id of ["selected", ...ASKED]) this.#viewer.remove(id);
    this.#box = boxAbout(all.map((p) => this.near(p)));
    const size = this.#box ? Math.hypot(...this.#box.high.map((x, k) => x - this.#box.low[k])) : 1;
    this.#size = Math.max(size, 0.5) * 0.035;
    this.#ground();
    paths.forEach((one, i) => {
      const places = one.world.map((m) => this.near(placeOf(m)));
      this.#viewer.lines(`path ${i}`, { positions: one.isVirtual ? crosses(places, this.#size / 4) : polyline(places), tint: tintOf(one), width: 2 });
    });
    this.#ratio = 0;
    this.#thin(1);
    this.#label();
  }

  /** The surface that paths are drawn over, less the origin. @param {any} box null: none
   * @param {number | null} floor its height along the axis that is up; null: not known */
  lay(box, floor) {
    this.#under = { box, floor };
    this.#ground();
  }

  /**
   * Labels of others, at places of the picture's frame.
   * @param {string} name of a group, which replaces the group of that name
   * @param {{at: number[], node: HTMLElement}[]} marks
   */
  mark(name, marks) {
    this.#marks.set(name, marks.map((one) => ({ ...one, at: this.near(one.at) })));
    this.#label();
  }

  /**
   * Sensors at poses of the picture's frame, such as of robots.
   * @param {string} id of the layer
   * @param {{pose: number[], camera: any, token: string, trail?: number[][]}[]} ones camera: null of a
   *   cloud's sensor; token: of its colour; trail: poses before it
   */
  sensors(id, ones) {
    const size = 2 * this.#size;
    const shapes = ones.map(({ pose, camera }) => copies(sensor(camera, size), [this.moveOrigin(pose)]));
    const trails = ones.map(({ trail = [] }) => polyline(trail.map((pose) => this.near(placeOf(pose)))));
    const joined = (parts) => ({ positions: Float32Array.from(parts.flatMap((one) => [...one])),
      colours: parts.flatMap((one, i) => { const tint = colourOf(ones[i].token.slice(2)); return Array.from(one, (_, k) => tint[k % 3]); }) });
    this.#viewer.lines(id, { ...joined(shapes), width: 3 });
    this.#viewer.lines(`${id} trails`, { ...joined(trails), width: 1.5 });
  }

  /** Which runs are not drawn, by their place. @param {Set<number>} hidden */
  hide(hidden) {
    this.#hidden = hidden;
    this.#drawn.forEach((_, i) => {
      for (const id of [`path ${i}`, `frustums ${i}`]) if (this.#viewer.has(id)) this.#viewer.lines(id, { visible: !hidden.has(i) });
    });
    this.#moved();
  }

  /** @param {{kind: string, from: number[], to: number[]}[]} edges places in the picture's frame */
  edges(edges) {
    for (const { kind, tint, dash } of EDGES) {
      const mine = edges.filter((one) => one.kind === kind);
      const [from, to] = [mine.map((one) => this.near(one.from)), mine.map((one) => this.near(one.to))];
      const positions = dash
        ? dashes(from.map((p, i) => [p, to[i]]), dash[0] * this.#size, dash[1] * this.#size)
        : links(from, to);
      this.#viewer.lines(`edges ${kind}`, { positions, tint, width: 1.5 });
    }
  }

  /**
   * The query among the paths; null: none.
   * @param {{pose: number[] | null, alternatives: number[][], axes: any, turn: number[], camera: any,
   *   matches: {pose: number[], voted: number[], camera: any}[]} | null} asked pose: null unless found;
   *   voted: the pose of the query that a match speaks for; camera: null of a cloud's sensor; all in
   *   the picture's frame, but the axes, which `turn` brings there
   */
  ask(asked) {
    this.#asked = asked;
    for (const id of ASKED) this.#viewer.remove(id);
    if (asked === null) { this.#label(); return; }
    const size = 2.4 * this.#size, shape = sensor(asked.camera, size);
    if (asked.pose) this.#viewer.lines("query", { positions: copies(shape, [this.moveOrigin(asked.pose)]), tint: "query", width: 3.5 });
    // of one rank: none is drawn as the answer
    const broken = hollow(shape, size / 8);
    if (asked.alternatives.length) this.#viewer.lines("alternatives", { positions: copies(broken, asked.alternatives.map((m) => this.moveOrigin(m))), tint: "query", width: 2.5 });
    if (asked.pose && asked.axes) {
      const turn = [...asked.turn.slice(0, 12), ...this.near(placeOf(asked.pose)), 1];
      this.#viewer.lines("ellipsoid", { positions: copies(ellipsoid(asked.axes), [turn]), tint: "query", width: 1.5 });
    }
    const there = asked.matches.map(({ pose }) => this.moveOrigin(pose));
    const seen = asked.matches.map(({ camera }, i) => copies(sensor(camera, 1.3 * this.#size), [there[i]]));
    this.#viewer.lines("matches", { positions: links(asked.matches.map(({ voted }) => this.near(placeOf(voted))), there.map(placeOf)), tint: "query", width: 1.5 });
    this.#viewer.lines("matched", { positions: Float32Array.from(seen.flatMap((one) => [...one])), tint: "match", width: 2.5 });
    this.#label();
  }

  /** Mark a frame. @param {{path: number, place: number} | null} one */
  select(one) {
    this.#selected = one;
    if (one === null) { this.#viewer.remove("selected"); this.#label(); return; }
    const path = this.#drawn[one.path];
    const pose = this.moveOrigin(path.world[one.place]);
    this.#viewer.lines("selected", { positions: copies(this.#sensor(path, 1.6 * this.#size), [pose]), tint: "ink", width: 3 });
    this.#label();
  }

  /** Look at all of it. @param {"plan" | "space" | "keep"} how keep: as it is */
  look(how) {
    if (this.#viewer === null) return; // nothing has come yet
    if (how === "plan") this.#viewer.look({ flat: true, azimuth: 0 });
    if (how === "space") this.#viewer.look({ flat: false, ...ASIDE });
    const seen = this.#drawn.flatMap((_, i) => (this.#hidden.has(i) ? [] : [`path ${i}`, `frustums ${i}`]));
    this.#viewer.fit([...seen, "surface", "query", "alternatives", "matched"].filter((id) => this.#viewer.has(id)));
    this.#wide = this.#viewer.camera.distance;
    this.#moved();
  }

  /** Look at one place, from near by or from as far as now. @param {number[]} pose in the picture's frame
   * @param {boolean} [isNear] */
  approach(pose, isNear = true) {
    this.#viewer.look({ target: this.near(placeOf(pose)), distance: isNear ? Math.max(12 * this.#size, this.#wide / 2) : undefined });
    this.#moved();
  }

  /** A place less the origin. @param {number[]} p */
  near(p) { return p.map((x, k) => x - this.#origin[k]); }

  /** A pose less the origin. @param {number[]} pose 16, column-major */
  moveOrigin(pose) { return [...pose.slice(0, 12), ...this.near(placeOf(pose)), 1]; }

  #sensor(path, size) { return sensor(path.isCloud ? null : path.camera, size); }

  /** The frame whose sensor is near a place of the canvas, CSS pixels. @param {number} x
   * @param {number} y @param {number} within @returns {{path: number, place: number} | null} */
  pick(x, y, within) {
    const shown = this.#drawn.map((one, path) => ({ one, path })).filter(({ path }) => !this.#hidden.has(path));
    const all = shown.flatMap(({ one, path }) => one.world.map((m, place) => ({ path, place, at: this.near(placeOf(m)) })));
    if (!this.#viewer.available || !this.#box) return null;
    const found = nearest(all.map((one) => one.at), this.projector(), x, y, within);
    return found < 0 ? null : { path: all[found].path, place: all[found].place };
  }

  /** Places less the origin to CSS pixels of the canvas, and metres ahead of the eye. */
  projector() {
    const { orbit, projector } = this.#viewer, eye = orbit.eye(), { ahead } = orbit.axes();
    return (p) => {
      const seen = projector(p);
      return seen && /** @type {[number, number, number]} */ ([seen[0], seen[1], dot(ahead, p) - dot(ahead, eye)]);
    };
  }

  // more frustums, and smaller ones, the nearer one looks
  #thin(ratio) {
    if (ratio === this.#ratio) return;
    this.#ratio = ratio;
    const total = this.#drawn.reduce((sum, one) => sum + one.world.length, 0);
    this.#drawn.forEach((one, i) => {
      if (one.isVirtual) return; // thousands of views, all around: their places say enough
      const share = Math.max(Math.ceil((FRUSTUMS * ratio * one.world.length) / Math.max(total, 1)), 2);
      const size = this.#size / Math.sqrt(ratio), chosen = spaced(one.world.map(placeOf), 0.7 * size, share);
      const positions = copies(this.#sensor(one, size), chosen.map((k) => this.moveOrigin(one.world[k])));
      this.#viewer.lines(`frustums ${i}`, { positions, tint: tintOf(one), width: 1.5, visible: !this.#hidden.has(i) });
    });
  }

  #ground() {
    const box = around([this.#box, this.#under.box]);
    if (!box) { this.#viewer.remove("grid"); put(this.#parts.ground); return; }
    const lowest = reachAlong(box, this.#axes.above)[0] + dot(this.#axes.above, this.#origin);
    // what is measured from the floor has it at 0; where that is far from a small path, or unlikely,
    // the grid lies at the path
    const size = Math.max(...box.high.map((x, k) => x - box.low[k]));
    const height = this.#under.floor ?? (lowest >= 0 && lowest < Math.min(3, size) ? 0 : lowest);
    const { positions, step } = grid(box, this.#axes, height, this.#origin);
    this.#viewer.lines("grid", { positions, tint: "line", width: 1 });
    put(this.#parts.ground, `Grid ${metres(step)}${this.#under.floor !== null ? "" : height === 0 ? ", at height 0" : ", at the lowest pose"}`);
  }

  #label() {
    const made = [];
    this.#drawn.forEach((one, i) => {
      if (one.world.length) made.push({ path: i, at: this.near(placeOf(one.world[0])), node: h("span", { class: "paths-label", style: { borderColor: `var(--${tintOf(one)})` } }, String(i + 1)) });
    });
    this.#asked?.alternatives.forEach((pose, i) => {
      made.push({ at: this.near(placeOf(pose)), node: h("span", { class: "paths-label", dataset: { kind: "alternative" } }, letterOf(i)) });
    });
    if (this.#asked?.pose) made.push({ at: this.near(placeOf(this.#asked.pose)), node: h("span", { class: "paths-label", dataset: { kind: "query" } }, "Query") });
    if (this.#selected) {
      const { path, place } = this.#selected;
      made.push({ at: this.near(placeOf(this.#drawn[path].world[place])), node: h("span", { class: "paths-label", dataset: { kind: "selected" } }, "Chosen") });
    }
    const marks = [...this.#marks.values()].flat();
    this.#labels = [...marks, ...made]; // the first have the first choice of a place
    put(this.#parts.labels, [...made, ...marks].map((one) => one.node));
    for (const { node } of this.#labels) node.hidden = false; // what is hidden has no size
    for (const one of this.#labels) one.size = { width: one.node.offsetWidth, height: one.node.offsetHeight };
    this.#moved();
  }

  #moved() {
    if (!this.#viewer?.available) return;
    const { distance } = this.#viewer.camera, height = this.canvas.clientHeight;
    const ratio = Math.min(Math.max(this.#wide / distance, 1), CLOSEST);
    this.#thin(2 ** Math.floor(Math.log2(ratio)));
    const perMetre = height / (2 * Math.tan(VIEW / 2) * distance);
    const length = nice(60 / perMetre);
    this.#parts.bar.style.setProperty("width", `${length * perMetre}px`);
    put(this.#parts.scaleText, metres(length));
    const project = this.#viewer.projector, seen = this.#labels.map(({ path, at }) => {
      const place = this.#hidden.has(path) ? null : project(at);
      return place === null || place[0] < 0 || place[1] < 0 || place[0] > this.canvas.clientWidth || place[1] > height ? null : place;
    });
    const shown = this.#labels.flatMap((one, i) => (seen[i] ? [{ node: one.node, ...one.size, x: seen[i][0], y: seen[i][1] }] : []));
    for (const { node } of this.#labels) node.hidden = true;
    spread(shown, { width: this.canvas.clientWidth, height }).forEach((spot, i) => {
      const { node, x, y } = shown[i];
      node.hidden = spot === null;
      if (spot === null) return;
      node.style.setProperty("transform", `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`);
      node.style.setProperty("left", `${spot[0]}px`);
      node.style.setProperty("top", `${spot[1]}px`);
    });
  }
}

// a cloud's ring is as wide as a frustum
const sensor = (camera, size) => frustum(camera, camera ? size : size / 2);
