// Which tiles of a surface are drawn: the coarse ones, and finer ones in their place where one looks,
// as many cells as a budget allows.

/**
 * @typedef {object} Piece
 * @property {string} parent frame
 * @property {number} level of its list, 0 the finest
 * @property {number} column @property {number} row @property {number} floor
 * @property {number} cells
 * @property {string} digest
 * @property {number} span metres of an edge
 * @property {number} cell metres of a cell
 */

/** A level of so few cells is drawn without coarser ones before it. */
const FEW = 30_000;

const keyOf = (column, row, floor) => `${column} ${row} ${floor}`;

/** The tiles of one parent frame, level by level. */
export class Pyramid {
  /** @type {(Piece[] | null)[]} by level; null: not listed yet */
  #lists;
  /** @type {(Map<string, Piece[]> | null)[]} finer pieces by the coarser one that holds them */
  #within;

  /** @param {string} parent @param {Object<string, any>[]} levels of the API, the finest first */
  constructor(parent, levels) {
    this.parent = parent;
    this.levels = levels;
    /** @type {Set<number>} places in `levels` whose tiles are on their way */
    this.coming = new Set();
    this.#lists = levels.map(() => null);
    this.#within = levels.map(() => null);
    const first = levels.findIndex((one) => one.cells <= FEW);
    /** Place in `levels` of the coarsest pieces that are drawn. */
    this.base = first < 0 ? levels.length - 1 : first;
  }

  /** The coarsest pieces; none before they are listed. */
  get roots() { return this.#lists[this.base] ?? []; }

  /** Whether a level is listed. @param {number} place in `levels` */
  knows(place) { return this.#lists[place] !== null; }

  /** @param {number} place in `levels` @param {Object<string, any>[]} tiles of the API */
  list(place, tiles) {
    const { tile_m: span, cell_m: cell } = this.levels[place], coarser = this.levels[place + 1];
    const pieces = tiles.map(({ column, row, floor, cells, digest }) => ({ parent: this.parent, level: place, column, row, floor, cells, digest, span, cell }));
    this.#lists[place] = pieces;
    if (!coarser) return;
    const ratio = Math.round(coarser.tile_m / span), within = new Map();
    for (const one of pieces) {
      const key = keyOf(...[one.column, one.row, one.floor].map((x) => Math.floor(x / ratio)));
      if (within.has(key)) within.get(key).push(one); else within.set(key, [one]);
    }
    this.#within[place] = within;
  }

  /** The finer pieces that show the same; null: not listed, or there are none.
   * @param {Piece} piece @returns {Piece[] | null} */
  parts({ level, column, row, floor }) {
    return (level > 0 && this.#within[level - 1]?.get(keyOf(column, row, floor))) || null;
  }
}

/**
 * What to draw in finer pieces.
 * @param {Piece[]} roots
 * @param {{parts: (piece: Piece) => Piece[] | null, size: (piece: Piece) => number, budget: number,
 *   least: number}} how size: pixels of a cell on the screen, 0 of what is not in view; budget: cells
 *   in view that are drawn, at most, if the roots are no more; least: a cell of fewer pixels is fine
 *   enough
 * @returns {{refined: Set<Piece>, cells: number, coarse: Set<number>}} cells: in view; coarse: levels whose
 *   pieces should be drawn in finer ones, if these were listed
 */
export function refine(roots, { parts, size, budget, least }) {
  const refined = new Set(), coarse = new Set();
  const seen = (pieces) => pieces.map((piece) => ({ piece, pixels: size(piece) })).filter((one) => one.pixels > 0);
  const count = (ones) => ones.reduce((sum, one) => sum + one.piece.cells, 0);
  const open = seen(roots);
  let cells = count(open);
  while (open.length) {
    let first = 0;
    for (let i = 1; i < open.length; i += 1) if (open[i].pixels > open[first].pixels) first = i;
    const [{ piece, pixels }] = open.splice(first, 1);
    if (pixels <= least) break; // so are all others
    const all = parts(piece);
    if (all === null) { if (piece.level > 0) coarse.add(piece.level); continue; }
    const finer = seen(all), more = count(finer) - piece.cells;
    if (cells + more > budget) continue;
    cells += more;
    refined.add(piece);
    open.push(...finer);
  }
  return { refined, cells, coarse };
}

/**
 * What can be drawn of it now: a piece stays until all in view that replaces it is there.
 * @param {Piece[]} roots
 * @param {{refined: Set<Piece>, parts: (piece: Piece) => Piece[] | null, there: (piece: Piece) => boolean,
 *   isSeen: (piece: Piece) => boolean}} what
 * @returns {{drawn: Piece[], missing: Piece[], needed: Set<Piece>}} missing: the coarser ones first;
 *   needed: both, and those that wait for others
 */
export function cover(roots, { refined, parts, there, isSeen }) {
  const missing = [], needed = new Set(roots);
  const of = (piece) => {
    needed.add(piece);
    const own = there(piece);
    if (!refined.has(piece)) {
      if (own) return [piece];
      if (!isSeen(piece)) return [];
      missing.push(piece);
      return null;
    }
    if (!own) missing.push(piece); // others are drawn before it is
    const all = (parts(piece) ?? []).map(of);
    if (all.every((one) => one !== null)) return all.flat();
    return own ? [piece] : null;
  };
  const drawn = roots.flatMap((one) => {
    const found = of(one);
    if (!there(one) && !missing.includes(one)) missing.push(one); // all of them: what comes into view is there
    return found ?? [];
  });
  return { drawn, missing: missing.sort((a, b) => b.level - a.level), needed };
}
