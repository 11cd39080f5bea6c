// The picture: paths with frustums, edges, the query, the grid, and numbers that float over them.

import { h, put } from "../lib/dom.js";
import { metres } from "../lib/format.js";
import { letterOf } from "../query/alternatives.js";
import { Orbit, VIEW } from "../viewer/camera.js";
import { links } from "../viewer/shapes.js";
import { createViewer, frustum } from "../viewer/viewer.js";
import { nearest, projector } from "./pick.js";
import {
  AXES, boxAbout, copies, dashes, ellipsoid, grid, hollow, nice, placeOf, polyline, spaced, upright,
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
const STEEP = Math.PI / 2;

/** Colour of a run: a token of paths.css. @param {number} colour */
export const tokenOf = (colour) => `--path-${colour}`;

/**
 * @param {HTMLElement} place where the canvas goes
 * @param {{onpick: (path: number, place: number) => void, signal: AbortSignal}} how
 */
export function createScene(place, { onpick, signal }) {
  const canvas = h("canvas", { class: "paths-canvas" });
  const labels = h("div", { class: "paths-labels", "aria-hidden": "true" });
  const bar = h("span", { class: "paths-bar" });
  const scaleText = h("span", {});
  const ground = h("span", { class: "muted" });
  const scale = h("div", { class: "paths-scale" }, h("span", { class: "paths-ruler" }, bar, scaleText), ground);
  put(place, canvas, labels, scale);
  return new Scene(canvas, { labels, bar, scaleText, ground }, onpick, signal);
}

class Scene {
  #parts;
  /** @type {any} the viewer; null until paths are shown */
  #viewer = null;
  /** @type {any} "z", "y" or "-y"; null until paths are shown */
  #up = null;
  /** @type {(import("./data.js").Path & {world: number[][]})[]} */
  #drawn = [];
  #origin = [0, 0, 0];
  #hidden = new Set();
  /** @type {any} about all that is drawn; null about nothing */
  #box = null;
  #size = 0.1;
  #ratio = 0;
  #wide = 1;
  /** @type {Object<string, any> | null} */
  #asked = null;
  /** @type {{path: number, place: number} | null} */
  #selected = null;
  /** @type {any[]} */
  #labels = [];

  constructor(canvas, parts, onpick, signal) {
    this.canvas = canvas;
    this.#parts = parts;
    /** @type {number[] | null} */
    let down = null;
    canvas.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; });
    canvas.addEventListener("click", (event) => {
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) > 4) return; // turned
      const found = this.#pick(event.offsetX, event.offsetY);
      if (found) onpick(found.path, found.place);
    });
    window.addEventListener("sceneprint:theme", () => this.#paint(), { signal });
    signal.addEventListener("abort", () => this.#viewer?.destroy(), { once: true });
  }

  /** The viewer; its up axis is that of the poses that came first. */
  get viewer() { return this.#viewer; }

  /** What is up, where the poses say so. @returns {"z" | "y" | "-y" | null} */
  get up() { return this.#up; }

  /**
   * Draw other paths.
   * @param {(import("./data.js").Path & {world: number[][]})[]} paths world: poses in the frame of
   *   the picture
   * @param {string} label what is to be seen
   * @param {"z" | "y" | "-y" | null} up null: as the poses say
   */
  show(paths, label, up) {
    const all = paths.flatMap((one) => one.world.map(placeOf));
    this.#origin = all.length ? [...all[0]] : [0, 0, 0];
    this.#up = up ?? upright(paths.flatMap((one) => one.world.map((matrix) => ({ matrix, isCloud: one.isCloud }))));
    if (this.#viewer === null) {
      this.#viewer = createViewer(this.canvas, { label, up: this.#up, onview: () => this.#moved() });
      this.canvas.viewer = this.#viewer; // whoever debugs finds it there
    } else {
      const { above, ahead, right } = new Orbit(this.#up);
      Object.assign(this.#viewer.orbit, { above, ahead, right });
    }
    for (let i = 0; i < this.#drawn.length; i += 1) {
      this.#viewer.remove(`path ${i}`);
      this.#viewer.remove(`frustums ${i}`);
    }
    this.#drawn = paths;
    this.#hidden = new Set();
    this.#selected = this.#asked = null;
    for (const id of ["selected", ...ASKED]) this.#viewer.remove(id);
    this.#box = boxAbout(all.map((p) => this.#near(p)));
    const size = this.#box ? Math.hypot(...this.#box.high.map((x, k) => x - this.#box.low[k])) : 1;
    this.#size = Math.max(size, 0.5) * 0.035;
    this.#ground();
    paths.forEach((one, i) => {
      this.#viewer.lines(`path ${i}`, { positions: polyline(one.world.map((m) => this.#near(placeOf(m)))), width: 2 });
    });
    this.#ratio = 0;
    this.#thin(1);
    this.#paint();
    this.#label();
  }

  /** Which runs are not drawn, by their place. @param {Set<number>} hidden */
  hide(hidden) {
    this.#hidden = hidden;
    this.#drawn.forEach((_, i) => {
      for (const kind of ["path", "frustums"]) this.#viewer.lines(`${kind} ${i}`, { visible: !hidden.has(i) });
    });
    this.#moved();
  }

  /** @param {{kind: string, from: number[], to: number[]}[]} edges places in the picture's frame */
  edges(edges) {
    for (const { kind, tint, dash } of EDGES) {
      const mine = edges.filter((one) => one.kind === kind);
      const [from, to] = [mine.map((one) => this.#near(one.from)), mine.map((one) => this.#near(one.to))];
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
    if (asked.pose) this.#viewer.lines("query", { positions: copies(shape, [this.#moveOrigin(asked.pose)]), tint: "query", width: 3.5 });
    // of one rank: none is drawn as the answer
    const broken = hollow(shape, size / 8);
    if (asked.alternatives.length) this.#viewer.lines("alternatives", { positions: copies(broken, asked.alternatives.map((m) => this.#moveOrigin(m))), tint: "query", width: 2.5 });
    if (asked.pose && asked.axes) {
      const turn = [...asked.turn.slice(0, 12), ...this.#near(placeOf(asked.pose)), 1];
      this.#viewer.lines("ellipsoid", { positions: copies(ellipsoid(asked.axes), [turn]), tint: "query", width: 1.5 });
    }
    const there = asked.matches.map(({ pose }) => this.#moveOrigin(pose));
    const seen = asked.matches.map(({ camera }, i) => copies(sensor(camera, 1.3 * this.#size), [there[i]]));
    this.#viewer.lines("matches", { positions: links(asked.matches.map(({ voted }) => this.#near(placeOf(voted))), there.map(placeOf)), tint: "query", width: 1.5 });
    this.#viewer.lines("matched", { positions: Float32Array.from(seen.flatMap((one) => [...one])), tint: "match", width: 2.5 });
    this.#label();
  }

  /** Mark a frame. @param {{path: number, place: number} | null} one */
  select(one) {
    this.#selected = one;
    if (one === null) { this.#viewer.remove("selected"); this.#label(); return; }
    const path = this.#drawn[one.path];
    const pose = this.#moveOrigin(path.world[one.place]);
    this.#viewer.lines("selected", { positions: copies(this.#sensor(path, 1.6 * this.#size), [pose]), tint: "ink", width: 3 });
    this.#label();
  }

  /** Look at all of it. @param {"top" | "side" | "keep"} from which side; keep: as it is */
  look(from) {
    if (this.#viewer === null) return; // nothing has come yet
    if (from === "top") this.#viewer.look({ azimuth: 0, elevation: STEEP });
    if (from === "side") this.#viewer.look({ azimuth: 0.6, elevation: 0.55 });
    const seen = this.#drawn.flatMap((_, i) => (this.#hidden.has(i) ? [] : [`path ${i}`, `frustums ${i}`]));
    this.#viewer.fit([...seen, "query", "alternatives", "matched"].filter((id) => this.#viewer.has(id)));
    this.#wide = this.#viewer.camera.distance;
    this.#moved();
  }

  /** Look at one place from near by. @param {number[]} pose in the picture's frame */
  approach(pose) {
    this.#viewer.look({ target: this.#near(placeOf(pose)), distance: 12 * this.#size });
    this.#moved();
  }

  #near(p) { return p.map((x, k) => x - this.#origin[k]); }

  #moveOrigin(pose) { return [...pose.slice(0, 12), ...this.#near(placeOf(pose)), 1]; }

  #sensor(path, size) { return sensor(path.isCloud ? null : path.camera, size); }

  #pick(x, y) {
    const shown = this.#drawn.map((one, path) => ({ one, path })).filter(({ path }) => !this.#hidden.has(path));
    const all = shown.flatMap(({ one, path }) => one.world.map((m, place) => ({ path, place, at: this.#near(placeOf(m)) })));
    if (!this.#viewer.available || !this.#box) return null;
    const { clientWidth, clientHeight } = this.canvas;
    const clip = this.#viewer.orbit.projection(clientWidth / clientHeight, this.#box);
    const found = nearest(all.map((one) => one.at), projector(clip, clientWidth, clientHeight), x, y);
    return found < 0 ? null : all[found];
  }

  // more frustums, and smaller ones, the nearer one looks
  #thin(ratio) {
    if (ratio === this.#ratio) return;
    this.#ratio = ratio;
    const total = this.#drawn.reduce((sum, one) => sum + one.world.length, 0);
    this.#drawn.forEach((one, i) => {
      const share = Math.max(Math.ceil((FRUSTUMS * ratio * one.world.length) / Math.max(total, 1)), 2);
      const size = this.#size / Math.sqrt(ratio), chosen = spaced(one.world.map(placeOf), 0.7 * size, share);
      const positions = copies(this.#sensor(one, size), chosen.map((k) => this.#moveOrigin(one.world[k])));
      this.#viewer.lines(`frustums ${i}`, { positions, width: 1.5, visible: !this.#hidden.has(i) });
    });
    this.#paint();
  }

  #ground() {
    if (!this.#box) { this.#viewer.remove("grid"); put(this.#parts.ground); return; }
    const [axis, sign] = AXES[this.#up];
    const lowest = (sign > 0 ? this.#box.low[axis] : this.#box.high[axis]) + this.#origin[axis];
    // what is measured from the floor has it at 0; where that is far from a small path, or unlikely,
    // the grid lies at the path
    const size = Math.max(...this.#box.high.map((x, k) => x - this.#box.low[k]));
    const height = sign * lowest >= 0 && sign * lowest < Math.min(3, size) ? 0 : lowest;
    const { positions, step } = grid(this.#box, this.#up, height, this.#origin);
    this.#viewer.lines("grid", { positions, tint: "line", width: 1 });
    put(this.#parts.ground, `Grid ${metres(step)}, at ${height === 0 ? "height 0" : "the lowest pose"}`);
  }

  #paint() {
    const style = getComputedStyle(document.documentElement);
    this.#drawn.forEach((one, i) => {
      const tint = rgb(style.getPropertyValue(tokenOf(one.colour)));
      for (const kind of ["path", "frustums"]) this.#viewer.lines(`${kind} ${i}`, { tint });
    });
  }

  #label() {
    const made = [];
    this.#drawn.forEach((one, i) => {
      if (one.world.length) made.push({ path: i, at: this.#near(placeOf(one.world[0])), node: h("span", { class: "paths-label", style: { borderColor: `var(${tokenOf(one.colour)})` } }, String(i + 1)) });
    });
    this.#asked?.alternatives.forEach((pose, i) => {
      made.push({ at: this.#near(placeOf(pose)), node: h("span", { class: "paths-label", dataset: { kind: "alternative" } }, letterOf(i)) });
    });
    if (this.#asked?.pose) made.push({ at: this.#near(placeOf(this.#asked.pose)), node: h("span", { class: "paths-label", dataset: { kind: "query" } }, "Query") });
    if (this.#selected) {
      const { path, place } = this.#selected;
      made.push({ at: this.#near(placeOf(this.#drawn[path].world[place])), node: h("span", { class: "paths-label", dataset: { kind: "selected" } }, "Chosen") });
    }
    this.#labels = made;
    put(this.#parts.labels, made.map((one) => one.node));
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
    for (const { path, at, node } of this.#labels) {
      const seen = this.#hidden.has(path) ? null : this.#viewer.project(at);
      node.hidden = seen === null || seen[0] < 0 || seen[1] < 0 || seen[0] > this.canvas.clientWidth || seen[1] > height;
      if (!node.hidden) node.style.setProperty("transform", `translate(${seen[0].toFixed(1)}px, ${seen[1].toFixed(1)}px)`);
    }
  }
}

// a cloud's ring is as wide as a frustum
const sensor = (camera, size) => frustum(camera, camera ? size : size / 2);

function rgb(text) {
  const number = parseInt(text.trim().slice(1), 16);
  return [(number >> 16) & 255, (number >> 8) & 255, number & 255];
}
