// A plan seen from above: what is drawn on it is the page's; moving, zooming, the scale bar, keys
// and the picture beneath are here. Places are metres along the axes of the plan, y to the top.
import { h, put, svg } from "../lib/dom.js";
import { metres } from "../lib/format.js";
import { hands, NEARER } from "../lib/hands.js";
import { nice } from "../paths/shapes.js";

const STEP = 0.12; // of a key
const EDGE_PX = 28, FOOT_PX = 48; // between what is shown and the edge, and the scale bar below
const LEAST_M = 0.5; // of what is fitted: a plan of one place shows its surroundings
const CLOSEST = 20_000; // pixels of a metre
const STILL_PX = 4; // a click may move so far
const BAR_PX = 120;
const KEYS = "Arrow keys move, plus and minus zoom, 0 shows all.";

/**
 * @typedef {[number, number]} Place metres to the right and to the top
 * @typedef {{x: (u: number) => number, y: (v: number) => number, scale: number, width: number, height: number}} View
 *   pixels of a place; scale: of a metre
 */

export class Plan {
  /** @type {Map<string, SVGElement>} shapes in metres, moved as a whole */
  #grounds = new Map();
  /** @type {Map<string, {group: SVGElement, make: (view: View) => any}>} drawn anew for each view */
  #marks = new Map();
  /** @type {Place[]} what `fit` shows */
  #whole = [[0, 0]];
  #centre = [0, 0];
  #scale = 100;
  #isFitted = true;
  #size = [0, 0];
  #frame = 0;
  /** @type {{canvas: HTMLCanvasElement, left: number, top: number, step: number} | null} */
  #picture = null;

  /**
   * @param {{label: string, signal: AbortSignal, onpick?: (at: Place, view: View) => void}} how label: what
   *   is to be seen; onpick: a click that did not move it
   */
  constructor({ label, signal, onpick = () => {} }) {
    this.world = svg("g", { class: "plan-world" });
    this.over = svg("g", { class: "plan-over" });
    this.svg = svg("svg", {
      class: "plan-sheet", id: "plan-sheet", tabindex: "0", role: "application", "aria-roledescription": "plan", "aria-label": `${label}. ${KEYS}`,
    }, this.world, this.over);
    this.under = h("div", { class: "plan-under" });
    this.bar = h("span", { class: "plan-bar" });
    this.length = h("span", {});
    this.about = h("span", { class: "muted" });
    const button = (text, name, act) => h("button", { class: "button", type: "button", title: name, "aria-label": name, onClick: act }, text);
    this.element = h("div", { class: "plan" }, this.under, this.svg,
      h("div", { class: "plan-scale" }, h("span", { class: "plan-ruler" }, this.bar, this.length), this.about),
      h("div", { class: "plan-buttons" }, button("+", "Zoom in", () => this.zoom(NEARER)), button("−", "Zoom out", () => this.zoom(1 / NEARER)),
        button("⤢", "Show all", () => this.fit())));
    this.#hands(signal, onpick);
    const watcher = new ResizeObserver(() => this.#resized());
    watcher.observe(this.element);
    signal.addEventListener("abort", () => { watcher.disconnect(); cancelAnimationFrame(this.#frame); }, { once: true });
    /** @type {any} */ (this.element).plan = this; // whoever tests it finds it there
  }

  /** Say what is to be seen. @param {string} text */
  label(text) { this.svg.setAttribute("aria-label", `${text}. ${KEYS}`); }

  /** Shapes in metres, beneath all marks. @param {string} id @param {...any} nodes */
  ground(id, ...nodes) {
    let group = this.#grounds.get(id);
    if (!group) {
      group = svg("g", { "data-layer": id });
      this.#grounds.set(id, group);
      this.world.append(group);
    }
    put(group, nodes);
  }

  /** Marks that keep their size on the screen. @param {string} id @param {(view: View) => any} make nodes for a view */
  mark(id, make) {
    const group = this.#marks.get(id)?.group ?? svg("g", { "data-layer": id });
    if (!this.#marks.has(id)) this.over.append(group);
    this.#marks.set(id, { group, make });
    this.#later();
  }

  /**
   * The picture beneath.
   * @param {HTMLCanvasElement | null} canvas
   * @param {{left: number, top: number, m_per_pixel: number}} [where] of its first pixel's corner
   */
  picture(canvas, where) {
    this.#picture = canvas && where ? { canvas, left: where.left, top: where.top, step: where.m_per_pixel } : null;
    put(this.under, canvas);
    this.#later();
  }

  /** What is to be shown in full; it is shown, unless one looks elsewhere. @param {Place[]} places */
  bounds(places) {
    this.#whole = places.length ? places : [[0, 0]];
    if (this.#isFitted) this.fit();
  }

  fit() {
    const [us, vs] = [0, 1].map((k) => this.#whole.map((one) => one[k]));
    const [low, high] = [[least(us), least(vs)], [most(us), most(vs)]];
    const [width, height] = this.#size, room = [width - 2 * EDGE_PX, height - EDGE_PX - FOOT_PX];
    this.#scale = Math.min(...room.map((x, k) => Math.max(x, 40) / Math.max(high[k] - low[k], LEAST_M)), CLOSEST);
    this.#centre = low.map((x, k) => (x + high[k]) / 2);
    this.#centre[1] -= (FOOT_PX - EDGE_PX) / 2 / this.#scale;
    this.#isFitted = true;
    this.#later();
  }

  /** @param {number} factor @param {[number, number]} [at] pixels that stay where they are */
  zoom(factor, at = [this.#size[0] / 2, this.#size[1] / 2]) {
    const [u, v] = this.place(at);
    this.#scale = Math.min(Math.max(this.#scale * factor, 1e-3), CLOSEST);
    const [u2, v2] = this.place(at);
    this.#centre = [this.#centre[0] + u - u2, this.#centre[1] + v - v2];
    this.#isFitted = false;
    this.#later();
  }

  /** @param {number} right @param {number} down pixels that all moves */
  move(right, down) {
    this.#centre = [this.#centre[0] - right / this.#scale, this.#centre[1] + down / this.#scale];
    this.#isFitted = false;
    this.#later();
  }

  /** Draw marks again: what they show has changed. */
  redraw() { this.#later(); }

  /** @returns {View} what is seen, in pixels of the element */
  get view() {
    const [width, height] = this.#size, scale = this.#scale, [u0, v0] = this.#centre;
    return { width, height, scale, x: (u) => width / 2 + (u - u0) * scale, y: (v) => height / 2 - (v - v0) * scale };
  }

  /** The place at a pixel. @param {[number, number]} at @returns {Place} */
  place([x, y]) {
    return [this.#centre[0] + (x - this.#size[0] / 2) / this.#scale, this.#centre[1] - (y - this.#size[1] / 2) / this.#scale];
  }

  #resized() {
    this.#size = [this.element.clientWidth, this.element.clientHeight];
    if (this.#isFitted) this.fit(); else this.#later();
  }

  #later() {
    cancelAnimationFrame(this.#frame);
    this.#frame = requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    const { view } = this, { scale } = view, [width, height] = this.#size;
    if (!width) return;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.world.setAttribute("transform", `matrix(${scale} 0 0 ${-scale} ${view.x(0)} ${view.y(0)})`);
    for (const { group, make } of this.#marks.values()) put(group, make(view));
    if (this.#picture) {
      const { canvas, left, top, step } = this.#picture;
      canvas.style.setProperty("transform", `translate(${view.x(left)}px, ${view.y(top)}px) scale(${step * scale})`);
    }
    const length = nice(BAR_PX / 2 / scale);
    this.bar.style.setProperty("width", `${length * scale}px`);
    put(this.length, length < 0.1 ? metres(length) : `${Number(length.toPrecision(3))} m`);
  }

  #hands(signal, onpick) {
    const move = (right, down) => this.move(right, down);
    hands(this.svg, {
      drag: move, move, zoom: (factor, at) => this.zoom(factor, at), fit: () => this.fit(),
      arrow: (right, up) => this.move(-right * STEP * this.#size[0], up * STEP * this.#size[1]),
      click: (at) => onpick(this.place(at), this.view),
      // a page is scrolled over a plan that nobody has chosen
      wheels: ({ ctrlKey }) => ctrlKey || document.activeElement === this.svg,
    }, { signal, still: STILL_PX });
  }
}

const least = (all) => all.reduce((a, b) => Math.min(a, b), Infinity);
const most = (all) => all.reduce((a, b) => Math.max(a, b), -Infinity);
