// Points, lines and triangles in 3-D: one canvas, drawn when something has changed and not before.

import { hands } from "../lib/hands.js";
import { Orbit, VIEW } from "./camera.js";
import { colourOf } from "./colours.js";
import { CellsLayer } from "./cells.js";
import { CloudLayer, ShapeLayer, around } from "./layers.js";
import { dot, transformed } from "./matrix.js";
import { program } from "./shaders.js";

export { frustum } from "./shapes.js";

const KEYS = "Arrow keys turn, with Shift they move; plus and minus zoom; 0 shows all.";
const PLAN_KEYS = "Arrow keys move, with Shift they turn; plus and minus zoom; 0 shows all.";
const NOTHING = { low: [-1, -1, -1], high: [1, 1, 1] };
const TURN = 0.1, STEP = 0.05; // of an arrow key: radians, and share of the height
/** Radians for a drag across the height of the canvas. */
const ACROSS = Math.PI;
/** More pixels than that per CSS pixel nobody sees, and each costs. */
const DENSEST = 2;

/**
 * @typedef {object} Options
 * @property {string} label what is to be seen, for who does not see it
 * @property {import("./camera.js").Up} [up] "-y" of a camera's optical axes, "z" of maps and LiDAR
 * @property {boolean} [antialias]
 * @property {string} [background] a token's name
 * @property {(lost: boolean) => void} [onlost] the context went, or came back
 * @property {() => void} [onview] it was drawn anew: labels may have to move
 */

/**
 * @param {HTMLCanvasElement} canvas with a size of its own by CSS
 * @param {Options} options
 * @returns {Viewer} where there is no WebGL 2 its `available` is false, a sentence stands in place
 *   of the canvas, and all else does nothing
 */
export function createViewer(canvas, options) {
  return new Viewer(canvas, options);
}

export class Viewer {
  /** @type {any} the context; null without WebGL 2 */
  #gl;
  /** @type {Object<string, any>} programs of the context */
  #made = {};
  /** @type {Map<string, any>} */
  #layers = new Map();
  #dirty = 0;
  /** @type {ResizeObserver} */
  #watcher;
  #end = new AbortController();
  /** @type {number[][] | null} what is in view, until one looks elsewhere */
  #fitted = null;
  #lost = false;

  /** @param {HTMLCanvasElement} canvas @param {Options} options */
  constructor(canvas, {
    label, up = "-y", antialias = true, background = "sunken", onlost = () => {},
    onview = () => {},
  }) {
    this.canvas = canvas;
    this.frames = 0;
    this.orbit = new Orbit(up);
    this.background = background;
    this.onview = onview;
    this.label = label;
    this.#gl = canvas.getContext("webgl2", { antialias, alpha: false, powerPreference: "low-power" });
    this.available = this.#gl !== null;
    if (!this.available) {
      const told = document.createElement("p");
      told.className = "viewer-none muted";
      told.textContent = "This browser does not support WebGL 2, which the 3-D view needs.";
      canvas.hidden = true;
      canvas.after(told);
      return;
    }
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application"); // a screen reader leaves the arrow keys to it
    canvas.setAttribute("aria-roledescription", "3-D view");
    this.#name();
    canvas.style.setProperty("touch-action", "none");
    const { signal } = this.#end;
    this.#hands(signal);
    window.addEventListener("sceneprint:theme", () => this.redraw(), { signal });
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault(); // or it never comes back
      this.#lost = true;
      onlost(true);
    }, { signal });
    canvas.addEventListener("webglcontextrestored", () => {
      this.#lost = false;
      this.#begin();
      onlost(false);
    }, { signal });
    this.#watcher = new ResizeObserver(() => {
      if (this.#fitted) this.orbit.fit(this.#fitted, this.#aspect());
      this.redraw();
    });
    this.#watcher.observe(canvas);
    this.#begin();
  }

  /**
   * Set a cloud, or change one: what is left out stays.
   * @param {string} id
   * @param {Object<string, any>} told points, matrix (16, column-major), colour ("tint", "normal", "patch",
   *   "residual", "height"), tint (a token's name, or red, green, blue), size (metres), shade (share
   *   of light that a slant surface loses), visible, patchColours (Uint8Array, rgb of each patch)
   */
  cloud(id, told) {
    this.#set(id, told, () => new CloudLayer(told));
  }

  /** Segments: positions (six numbers each), colours (rgb of each end), tint, matrix, width (CSS
   * pixels), visible, onTop (nothing hides them). */
  lines(id, told) {
    this.#set(id, told, () => new ShapeLayer("lines", told));
  }

  /** Triangles: positions (nine numbers each), colours, tint, matrix, alpha, visible. */
  triangles(id, told) {
    this.#set(id, told, () => new ShapeLayer("triangles", told));
  }

  /** Cells of a map's surface: tiles, extent, colour, palette, heights, cut; see cells.js. */
  cells(id, told) {
    this.#set(id, told, () => new CellsLayer(told));
  }

  #set(id, told, make) {
    if (!this.available) return;
    const layer = this.#layers.get(id);
    if (layer) layer.set(told);
    else this.#layers.set(id, make());
    this.redraw();
  }

  has(id) {
    return this.#layers.has(id);
  }

  /** A layer as it is drawn, for tests; see layers.js. @param {string} id */
  layer(id) {
    return this.#layers.get(id);
  }

  remove(id) {
    this.#layers.get(id)?.free(this.#gl);
    if (this.#layers.delete(id)) this.redraw();
  }

  /** Look at some layers, or at all that can be seen, from the side one is looking from.
   * @param {string[] | null} [ids] */
  fit(ids = null) {
    if (!this.available) return;
    const there = [...this.#layers].filter(([id, one]) => (ids ? ids.includes(id) : one.visible));
    const outline = there.flatMap(([, one]) => one.outline);
    this.#fitted = outline.length ? outline : [NOTHING.low, NOTHING.high];
    this.orbit.fit(this.#fitted, this.#aspect());
    this.redraw();
  }

  /** @param {Partial<Orbit>} where target (metres), distance (metres), azimuth, elevation
   * (radians), flat (whether it is a plan) */
  look(where) {
    if (!this.available) return;
    this.#fitted = null;
    this.orbit.look(where);
    if (where.flat !== undefined) this.#name();
    this.redraw();
  }

  /** Where one looks from: target, distance, azimuth, elevation, flat, as `look` takes them. */
  get camera() {
    const { target, distance, azimuth, elevation, flat } = this.orbit;
    return { target: [...target], distance, azimuth, elevation, flat };
  }

  // what is to be seen, and what the keys do there
  #name() {
    this.canvas.setAttribute("aria-label", `${this.label}. ${this.orbit.flat ? PLAN_KEYS : KEYS}`);
  }

  /** Where points of the world are on the canvas: CSS pixels from its left and top, and metres
   * before the eye; null behind it. @returns {(p: number[]) => [number, number, number] | null} */
  get projector() {
    const { clip, canvas: { clientWidth, clientHeight } } = this;
    return (point) => {
      const [x, y, , w] = transformed(clip, point);
      return w <= 0 ? null : [((x / w + 1) / 2) * clientWidth, ((1 - y / w) / 2) * clientHeight, w];
    };
  }

  /** @param {number[]} point see `projector` */
  project(point) { return this.projector(point); }

  /** Whether a graphics card draws, as far as the browser tells. */
  get isFast() {
    const known = this.#gl?.getExtension("WEBGL_debug_renderer_info");
    const name = known ? this.#gl.getParameter(known.UNMASKED_RENDERER_WEBGL) : "";
    return Boolean(name) && !/swiftshader|llvmpipe|software|basic render/i.test(name);
  }

  /** Whether nobody has looked elsewhere since `fit`. */
  get isFitted() {
    return this.#fitted !== null;
  }

  /** World to clip coordinates; 16, column-major. */
  get clip() {
    const seen = [...this.#layers.values()].filter((one) => one.visible).map((one) => one.box);
    return this.orbit.projection(this.#aspect(), around(seen) ?? NOTHING);
  }

  redraw() {
    if (this.available && !this.#dirty) {
      this.#dirty = requestAnimationFrame(() => { this.#dirty = 0; this.#draw(); });
    }
  }

  /** Draw now and wait for it: milliseconds; for benchmarks. */
  timing() {
    const begun = performance.now();
    this.pixels(0, 0, 1, 1);
    return performance.now() - begun;
  }

  /** Draw now and read: rgba bytes row by row from the upper left, of all or a part, in device
   * pixels. Chromium warns in its console that this is slow. */
  pixels(x = 0, y = 0, wide = 0, high = 0) {
    this.#draw(); // which gives the canvas its size
    const width = wide || this.canvas.width, height = high || this.canvas.height;
    const copy = /** @type {OffscreenCanvasRenderingContext2D} */ (new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true }));
    copy.drawImage(this.canvas, -x, -y);
    return copy.getImageData(0, 0, width, height).data;
  }

  destroy() {
    if (!this.available) return;
    this.#end.abort();
    this.#watcher.disconnect();
    cancelAnimationFrame(this.#dirty);
    for (const layer of this.#layers.values()) layer.free(this.#gl);
    this.#layers.clear();
    this.available = false;
    // browsers keep only a few; one that is lost already has no extensions
    if (!this.#gl.isContextLost()) this.#gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  #hands(signal) {
    const { canvas, orbit } = this, size = () => canvas.clientHeight || 1;
    const changed = () => { this.#fitted = null; this.redraw(); };
    const move = (right, down) => { orbit.pan(right / size(), -down / size()); changed(); };
    const turn = (right, down) => { orbit.orbit(right, orbit.flat ? 0 : down); changed(); };
    canvas.addEventListener("contextmenu", (event) => event.preventDefault(), { signal }); // the right button moves
    hands(canvas, {
      move, fit: () => this.fit(), zoom: (factor) => { orbit.zoom(1 / factor); changed(); },
      drag: (right, down, { shiftKey, buttons }) => {
        // a plan is rather moved than turned
        if ((shiftKey || (buttons & 6) !== 0) !== orbit.flat) move(right, down); else turn((right / size()) * ACROSS, (down / size()) * ACROSS);
      },
      arrow: (right, up, { shiftKey }) => {
        if (shiftKey !== orbit.flat) move(-right * STEP * size(), up * STEP * size()); else turn(right * TURN, up * TURN);
      },
    }, { signal });
  }

  #begin() {
    for (const layer of this.#layers.values()) layer.free(null); // went with the old context
    this.#made = {};
    this.redraw();
  }

  // compiled when it is first drawn with
  #program(kind) {
    return this.#made[kind] ??= program(this.#gl, kind);
  }

  #aspect() {
    return (this.canvas.clientWidth || 1) / (this.canvas.clientHeight || 1);
  }

  #heights() {
    const above = this.orbit.above, heights = [];
    for (const one of this.#layers.values()) {
      if (one.visible && one.kind === "points" && one.box) {
        heights.push(dot(one.box.low, above), dot(one.box.high, above));
      }
    }
    return heights.length ? [Math.min(...heights), Math.max(...heights)] : [0, 1];
  }

  #draw() {
    const { canvas } = this, gl = this.#gl;
    if (!this.available || this.#lost || gl.isContextLost() || !canvas.clientWidth || !canvas.clientHeight) return;
    const density = Math.min(devicePixelRatio || 1, DENSEST);
    const width = Math.round(canvas.clientWidth * density);
    const height = Math.round(canvas.clientHeight * density);
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    const { clip } = this;
    const view = {
      clip, density, heights: this.#heights(), pixelsAtOneMetre: height / 2 / Math.tan(VIEW / 2),
    };
    gl.viewport(0, 0, width, height);
    gl.clearColor(...colourOf(this.background).map((x) => x / 255), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA); // colours come times alpha
    const clear = (one) => one.kind === "triangles" && (one.alpha ?? 1) < 1;
    const layers = [...this.#layers.values()].filter((one) => one.visible);
    for (const kind of ["cells", "points", "lines", "triangles"]) {
      const mine = layers.filter((one) => one.kind === kind && !one.onTop);
      if (!mine.length) continue;
      const { made, at } = this.#program(kind);
      gl.useProgram(made);
      gl.uniformMatrix4fv(at.clip, false, clip);
      if (kind === "points") gl.uniform3fv(at.eye, this.orbit.eye());
      if (kind === "points" || kind === "cells") gl.uniform3fv(at.above, this.orbit.above);
      if (kind === "lines") gl.uniform2f(at.screen, width, height);
      for (const one of [...mine.filter((x) => !clear(x)), ...mine.filter(clear)]) {
        gl[clear(one) ? "enable" : "disable"](gl.BLEND);
        gl.depthMask(!clear(one)); // what is behind glass is seen
        one.draw(gl, this.#program(kind), view);
      }
    }
    gl.disable(gl.BLEND);
    gl.depthMask(true);
    gl.disable(gl.DEPTH_TEST);
    for (const one of layers.filter((x) => x.kind === "lines" && x.onTop)) {
      const { made, at } = this.#program("lines");
      gl.useProgram(made);
      gl.uniformMatrix4fv(at.clip, false, clip);
      gl.uniform2f(at.screen, width, height);
      one.draw(gl, this.#program("lines"), view);
    }
    this.frames += 1;
    this.onview();
  }
}
