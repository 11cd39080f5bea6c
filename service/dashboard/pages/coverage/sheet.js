// The cells and queried frames of a result on a plan: by outcome, or by how they changed.
import { svg } from "../lib/dom.js";
import { OUTCOMES, outcomeIn, shapePath, TRENDS } from "./outcomes.js";

const RADIUS = 5;
const COUNTS_PX = 26; // a narrower cell has no room for its number
const REACH_PX = 12; // of a click, about a frame

/** Name of a cell, in lists and addresses. @param {Object<string, any>} cell */
export const keyOf = ({ column, row }) => `${column},${row}`;

/**
 * Draw a plan's cells.
 * @param {import("../plan/plan.js").Plan} plan @param {Object<string, any>[]} cells of a plan, or changes of cells
 * @param {number} wide of a cell, metres
 * @param {string | null} chosen key of a cell
 */
export function drawCells(plan, cells, wide, chosen) {
  const rect = (cell) => svg("rect", {
    class: "cover-cell", x: cell.column * wide, y: cell.row * wide, width: wide, height: wide, "data-cell": keyOf(cell),
    "data-outcome": cell.trend ? null : outcomeIn(cell) ?? "none", "data-trend": cell.trend,
  });
  plan.ground("cells", cells.map(rect));
  const one = cells.find((cell) => keyOf(cell) === chosen);
  plan.ground("chosen", one && svg("rect", { class: "cover-chosen", x: one.column * wide, y: one.row * wide, width: wide, height: wide }));
  plan.mark("counts", ({ x, y, scale, width, height }) => wide * scale >= COUNTS_PX && cells.flatMap((cell) => {
    const left = x(cell.column * wide), top = y((cell.row + 1) * wide), size = wide * scale;
    if (left > width || top > height || left + size < 0 || top + size < 0) return []; // of thousands few are seen
    const text = cell.trend ? TRENDS.find(({ name }) => name === cell.trend)?.sign : cell.frames;
    return [svg("text", { class: "plan-text cover-count", x: left + 4, y: top + 13 }, text)];
  }));
}

/**
 * Draw queried frames, and lines from some to what they are mistaken for.
 * @param {import("../plan/plan.js").Plan} plan @param {{outcome: string, at: import("../plan/plan.js").Place}[]} frames
 * @param {{from: import("../plan/plan.js").Place, to: import("../plan/plan.js").Place}[]} links
 */
export function drawFrames(plan, frames, links) {
  plan.mark("links", ({ x, y }) => links.map(({ from, to }) => svg("path", { class: "cover-link", d: `M${x(from[0])} ${y(from[1])}L${x(to[0])} ${y(to[1])}` })));
  plan.mark("shapes", ({ x, y }) => OUTCOMES.map(({ name }) => svg("path", {
    class: "cover-shape", "data-outcome": name,
    d: frames.filter((one) => one.outcome === name).map(({ at }) => shapePath(name, x(at[0]), y(at[1]), RADIUS)).join(""),
  })));
}

/**
 * What lies at a click: the frame nearest to it, and the cell.
 * @param {import("../plan/plan.js").Place} at @param {import("../plan/plan.js").View} view
 * @param {{at: import("../plan/plan.js").Place}[]} frames @param {number} wide
 */
export function hit([u, v], view, frames, wide) {
  const apart = (one) => Math.hypot(one.at[0] - u, one.at[1] - v) * view.scale;
  const near = frames.reduce((best, one) => (best === null || apart(one) < apart(best) ? one : best), /** @type {any} */ (null));
  return { frame: near && apart(near) <= REACH_PX ? near : null, cell: cellAt([u, v], wide) };
}

/** Key of the cell that a place lies in. @param {import("../plan/plan.js").Place} at @param {number} wide */
export const cellAt = ([u, v], wide) => keyOf({ column: Math.floor(u / wide), row: Math.floor(v / wide) });
