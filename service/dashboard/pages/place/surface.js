// The surface of a map in the picture: what the API has of it, and which tiles are fetched and drawn.

import { at, bytes, get, list } from "../lib/api.js";
import { throttle } from "../lib/dom.js";
import { tintOf } from "../paths/scene.js";
import { reachAlong } from "../paths/shapes.js";
import { cellUnder, cornersOf, isInView, placeIn, STRIDE } from "../viewer/cells.js";
import { VIEW } from "../viewer/camera.js";
import { colourOf } from "../viewer/colours.js";
import { around, movedBox } from "../viewer/layers.js";
import { dot, inverseRigid, transformed } from "../viewer/matrix.js";
import { cover, Pyramid, refine } from "./detail.js";

/** Cells that are drawn at once: what takes 50 ms without a graphics card, and with one. */
const BUDGET = 60_000, FAST_BUDGET = 400_000;
/** CSS pixels of a cell that is fine enough. */
const FINE_PX = 2.5;
const AT_ONCE = 6;
/** Tiles of a level that are listed: of a larger map the next coarser level is drawn. */
const MOST_LISTED = 20_000;
/** Cells that stay in memory, if they are not needed. */
const KEPT = 1_000_000;
const PAUSE_MS = 120;
/** Where even the coarsest cells are too many, every how many-th is drawn at most; and by what share of
 * the budget more are not too many. */
const MOST_THINNED = 31, SLACK = 0.2;
/** What is so near the edge of the picture comes into view soon. */
const MARGIN = 1.25;
/** Shares of the cells that are lower and higher than the colours of heights reach. */
const OUTER = 0.01;
/** A ceiling: above this share of the heights, over so many of the columns, of so many cells' width. */
const CEILING = 0.7, COVERED = 0.65, COLUMN = 16;

export class Surface {
  /** @type {any} as the API tells it; null before `load` */
  record = null;
  /** @type {Map<string, Pyramid>} by parent frame */
  #pyramids = new Map();
  /** @type {Map<string, any>} array buffers by digest, the longest unused first */
  #bytes = new Map();
  /** @type {Map<string, any>} what is drawn, by parent frame: its axes in those of the picture */
  #shown = new Map();
  /** @type {Set<string>} digests that are on their way */
  #coming = new Set();
  /** @type {Set<string>} digests that are needed for what is looked at */
  #needed = new Set();
  /** @type {any[]} drawn now, see viewer/cells.js */
  #tiles = [];
  #drawn = "";
  #later;
  /** @type {number[] | null} heights that colours reach from and to; null before they are known */
  range = null;
  #isMeasured = false;
  /** Whether other tiles are to come in place of those that are drawn. */
  #isReplaced = false;
  #most = 255;
  /** @type {number | null} */
  #budget = null;
  #isMarked = false;
  /** Whether somebody chose which heights are drawn: else what a ceiling hides is. */
  isChosen = false;
  /** @type {number[] | null} heights that are drawn */
  cut = null;
  colour = "height";
  /** @type {(import("../paths/data.js").Run | null)[]} a run of each session, whose colour it has */
  runs = [];
  /** @type {Set<string>} digests that are gone, until the API tells others */
  #gone = new Set();

  /**
   * @param {{map: string, signal: AbortSignal, scene: import("../paths/scene.js").Scene,
   *   onready: () => void}} what onready: the heights are known
   */
  constructor({ map, signal, scene, onready }) {
    this.map = map;
    this.signal = signal;
    this.scene = scene;
    this.onready = onready;
    this.#later = throttle(() => this.update(), PAUSE_MS, signal);
    window.addEventListener("sceneprint:theme", () => this.paint({}), { signal });
  }

  /** Ask what there is. @returns {Promise<any>} the record */
  async load() {
    const before = this.record?.updated_at;
    this.record = await get(at("maps", this.map, "surface"), { signal: this.signal });
    if (this.record.updated_at === before) return this.record;
    this.#gone.clear();
    const pyramids = new Map(this.record.parents.map((one) => [one.parent_frame, new Pyramid(one.parent_frame, one.levels)]));
    const shown = [...pyramids.values()].filter((one) => this.#shown.has(one.parent));
    await Promise.all(shown.map((one) => this.#list(one, one.base)));
    this.#pyramids = pyramids;
    this.#isReplaced = this.#tiles.length > 0;
    this.#isMeasured = false;
    this.update();
    return this.record;
  }

  /** What the API tells of a parent frame; undefined of one without a surface. @param {string} parent */
  parent(parent) {
    return this.record?.parents.find((one) => one.parent_frame === parent);
  }

  /** Middle of a parent frame's surface. @param {string} parent @returns {number[] | null} */
  middle(parent) {
    const told = this.parent(parent);
    return told ? ["x", "y", "z"].map((k) => (told.low[k] + told.high[k]) / 2) : null;
  }

  /**
   * Draw the surfaces of parent frames.
   * @param {Map<string, number[]>} parents each with the matrix that brings it into the picture's frame
   */
  async show(parents) {
    this.#shown = parents;
    this.#drawn = "";
    this.#isMeasured = this.#isReplaced = false;
    this.range = null;
    const here = this.#here();
    if (!here.length || !this.scene.viewer?.available) {
      this.scene.viewer?.remove("surface");
      this.#tiles = [];
      return;
    }
    this.scene.viewer.cells("surface", { tiles: [], extent: this.#extent(), ...this.#look() });
    await Promise.all(here.map((one) => this.#list(one, one.base)));
    this.update();
  }

  #here() {
    return [...this.#shown.keys()].map((name) => this.#pyramids.get(name)).filter((one) => one !== undefined);
  }

  async #list(pyramid, place) {
    const isMuch = place !== pyramid.base && pyramid.levels[place].tiles > MOST_LISTED;
    if (pyramid.knows(place) || pyramid.coming.has(place) || isMuch) return;
    pyramid.coming.add(place);
    try {
      const params = { parent: pyramid.parent, level: pyramid.levels[place].level };
      pyramid.list(place, (await list(at("maps", this.map, "surface", "tiles"), { params, signal: this.signal })).items);
    } finally {
      pyramid.coming.delete(place);
    }
  }

  /** What should be drawn may have changed: soon. */
  later() { this.#later(); }

  /** Choose tiles for what is looked at, fetch what is missing, and draw what is there. */
  update() {
    const here = this.#here(), { viewer } = this.scene;
    if (this.signal.aborted || !here.length || !viewer?.available) return;
    const size = this.#sizes(viewer), wanted = [], drawn = [];
    this.#needed = new Set();
    let isWhole = true, cells = 0;
    const budget = (this.#budget ??= viewer.isFast ? FAST_BUDGET : BUDGET) / here.length;
    for (const pyramid of here) {
      const parts = (piece) => pyramid.parts(piece);
      const { refined, coarse, cells: own } = refine(pyramid.roots, { parts, size, budget, least: FINE_PX });
      cells += own;
      isWhole &&= coarse.size === 0;
      for (const level of coarse) this.#list(pyramid, level - 1).then(() => this.later());
      const found = cover(pyramid.roots, { refined, parts, there: (piece) => this.#bytes.has(piece.digest), isSeen: (piece) => size(piece) > 0 });
      for (const piece of found.needed) this.#needed.add(piece.digest);
      wanted.push(...found.missing);
      drawn.push(...found.drawn);
    }
    if (!this.#isMeasured && here.every((one) => one.roots.length && one.roots.every((piece) => this.#bytes.has(piece.digest)))) this.#measure(here);
    this.#isReplaced &&= wanted.length > 0; // what is drawn stays until all the others are there
    if (!this.#isReplaced) this.#draw(drawn, Math.min(Math.ceil(cells / (budget * here.length) - SLACK), MOST_THINNED));
    this.#fetch(wanted);
    if (isWhole && !wanted.length && drawn.length && !this.#isMarked) {
      this.#isMarked = true;
      requestAnimationFrame(() => performance.mark("place")); // for benchmarks
    }
  }

  /** How large a cell of a piece is on the screen: 0 out of view. @returns {(piece: any) => number} */
  #sizes(viewer) {
    const { clip, orbit, canvas } = viewer, focal = canvas.clientHeight / 2 / Math.tan(VIEW / 2);
    const eye = orbit.eye(), known = new Map();
    const size = (piece) => {
      const tile = { matrix: this.#matrix(piece), span: piece.span }, corners = cornersOf(tile);
      if (!isInView(tile, clip, MARGIN) || this.#isCut(corners)) return 0;
      const middle = [0, 1, 2].map((k) => (corners[0][k] + corners[7][k]) / 2);
      const away = orbit.flat ? orbit.distance : Math.hypot(...middle.map((x, k) => x - eye[k])) - 0.87 * piece.span;
      return (piece.cell * focal) / Math.max(away, piece.span / 4);
    };
    return (piece) => {
      if (!known.has(piece)) known.set(piece, size(piece));
      return known.get(piece);
    };
  }

  #isCut(corners) {
    if (!this.cut) return false;
    const up = this.scene.axes.above, base = dot(up, this.scene.origin);
    const heights = corners.map((p) => dot(up, p) + base);
    return Math.min(...heights) > this.cut[1] || Math.max(...heights) < this.cut[0];
  }

  // where its corner is, less the origin in numbers of 64 bits: those that are drawn have 32
  #matrix({ parent, column, row, floor, span }) {
    const matrix = this.#shown.get(parent), corner = [column, row, floor].map((x) => x * span);
    return this.scene.moveOrigin([...matrix.slice(0, 12), ...transformed(matrix, corner)]);
  }

  #draw(pieces, every) {
    const names = pieces.map((one) => `${one.parent} ${one.level} ${one.column} ${one.row} ${one.floor} ${one.digest}`);
    const all = [every, ...names].join("\n");
    if (all === this.#drawn) return;
    this.#drawn = all;
    this.#tiles = pieces.map((piece, i) => ({
      name: names[i], data: this.#bytes.get(piece.digest), span: piece.span, cell: piece.cell,
      matrix: this.#matrix(piece), piece,
    }));
    this.scene.viewer.cells("surface", { tiles: this.#tiles, every: Math.max(every, 1), extent: this.#extent(), ...this.#look() });
  }

  /** How cells are drawn, for the viewer. */
  #look() {
    const base = dot(this.scene.axes.above, this.scene.origin), shift = (pair) => pair && pair.map((x) => x - base);
    const { taken_from: from, taken_step_s: step, first_taken: first, last_taken: last } = this.record;
    const code = (iso) => (from && step ? (Date.parse(iso) - Date.parse(from)) / 1000 / step : 0);
    return {
      colour: this.colour, palette: this.palette(), most: this.#most, cut: shift(this.cut),
      heights: shift(this.range ?? reachAlong(/** @type {any} */ (this.#extent()), this.scene.axes.above).map((x) => x + base)),
      ages: first ? [code(first), code(last)] : [0, 1],
    };
  }

  /** Draw cells in other colours, or other heights of them. @param {{colour?: string, cut?: number[] | null}} how */
  paint({ colour = this.colour, cut = this.cut }) {
    this.colour = colour;
    this.cut = cut;
    if (this.scene.viewer?.has("surface")) this.scene.viewer.cells("surface", this.#look());
  }

  /** Give sessions the colours of their runs. @param {import("../paths/data.js").Run[]} runs of the map */
  colours(runs) {
    const named = new Map(runs.slice().reverse().map((one) => [one.session, one])); // the first of a name
    this.runs = this.record.sessions.map((name) => named.get(name) ?? null);
    this.paint({});
  }

  /** Colours of sessions, as the theme has them. */
  palette() {
    return Uint8Array.from(this.runs.flatMap((one) => colourOf(one === null ? "muted" : tintOf(one))));
  }

  #extent() {
    const boxes = [...this.#shown].map(([name, matrix]) => [this.parent(name), matrix]).filter(([told]) => told)
      .map(([{ low, high }, matrix]) => movedBox({ low: [low.x, low.y, low.z], high: [high.x, high.y, high.z] }, this.scene.moveOrigin(matrix)));
    return around(boxes);
  }

  // heights and counts that colours reach to, by the coarsest cells
  #measure(here) {
    const { above, right, ahead } = this.scene.axes, base = dot(above, this.scene.origin);
    const heights = [], seen = [], columns = new Map(), wide = COLUMN * here[0].levels[0].cell_m;
    for (const piece of here.flatMap((one) => one.roots)) {
      const data = this.#bytes.get(piece.digest), matrix = this.#matrix(piece), codes = new Uint8Array(data);
      for (let i = 0; i * STRIDE < data.byteLength; i += 1) {
        const p = transformed(matrix, placeIn({ data, span: piece.span }, i)), height = dot(above, p) + base;
        heights.push(height);
        seen.push(codes[i * STRIDE + 3]);
        const key = [right, ahead].map((axis) => Math.floor(dot(axis, p) / wide)).join(" ");
        const [low, high] = columns.get(key) ?? [height, height];
        columns.set(key, [Math.min(low, height), Math.max(high, height)]);
      }
    }
    const least = (values, share) => values[Math.min(Math.floor(share * values.length), values.length - 1)];
    heights.sort((a, b) => a - b);
    seen.sort((a, b) => a - b);
    this.range = [least(heights, OUTER), least(heights, 1 - OUTER)];
    this.#most = Math.max(least(seen, 1 - OUTER), 17);
    if (!this.isChosen) this.cut = ceiling([...columns.values()], this.range);
    this.#isMeasured = true;
    this.scene.lay(this.#extent(), this.range[0]);
    this.#drawn = "";
    this.onready();
  }

  /** Frames that saw the cell that was seen by most, for the legend. */
  get mostSeen() { return Math.round(2 ** (this.#most / 16) - 1); }

  #fetch(wanted) {
    for (const piece of wanted) {
      if (this.#coming.size >= AT_ONCE) return;
      if (!this.#coming.has(piece.digest) && !this.#gone.has(piece.digest)) this.#one(piece);
    }
  }

  async #one({ digest }) {
    this.#coming.add(digest);
    try {
      this.#bytes.set(digest, await bytes(at("maps", this.map, "surface", "tiles", digest), { signal: this.signal }));
      this.#forget();
    } catch (error) {
      if (error.name === "AbortError") return;
      if (error.status !== 404) throw error;
      this.#gone.add(digest); // it was replaced meanwhile
      await this.load();
    } finally {
      this.#coming.delete(digest);
    }
    this.update();
  }

  #forget() {
    let cells = [...this.#bytes.values()].reduce((sum, one) => sum + one.byteLength / STRIDE, 0);
    for (const [digest, data] of this.#bytes) {
      if (cells <= KEPT) return;
      if (this.#needed.has(digest)) continue;
      this.#bytes.delete(digest);
      cells -= data.byteLength / STRIDE;
    }
  }

  /**
   * The spot that is drawn at a place of the canvas.
   * @param {number} x @param {number} y CSS pixels @param {number} near CSS pixels from there at most
   * @returns {{parent: string, at: number[], world: number[], cell: number} | null} at: in its parent
   *   frame; world: in that of the picture; cell: metres
   */
  spot(x, y, near) {
    const up = this.scene.axes.above, base = dot(up, this.scene.origin), { cut } = this;
    const allowed = (p) => !cut || (dot(up, p) + base >= cut[0] && dot(up, p) + base <= cut[1]);
    const found = cellUnder(this.#tiles, this.scene.projector(), { x, y, near, allowed });
    if (!found) return null;
    const tile = /** @type {any} */ (found.tile);
    const world = transformed(tile.matrix, placeIn(tile, found.cell)).slice(0, 3).map((v, k) => v + this.scene.origin[k]);
    const { parent } = tile.piece;
    return { parent, world, at: transformed(inverseRigid(this.#shown.get(parent)), world).slice(0, 3), cell: tile.cell };
  }
}

/**
 * Heights to draw so that a ceiling does not hide what is under it; null: there is none.
 * @param {number[][]} columns the lowest and the highest cell of each column of the plan
 * @param {number[]} range the lowest and the highest @returns {number[] | null}
 */
export function ceiling(columns, [low, high]) {
  const top = low + CEILING * (high - low);
  const covered = columns.filter((one) => one.some((x) => x > top) && one.some((x) => x <= top));
  return covered.length > COVERED * columns.length ? [-1e9, top] : null;
}
