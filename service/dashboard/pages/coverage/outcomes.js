// What can become of a queried frame, and how a cell compares with an earlier result: words, shapes
// and what a cell counts for. Colours are of coverage.css, by these names.
import { svg } from "../lib/dom.js";

/** Outcomes of frames, in the order in which they are listed. */
export const OUTCOMES = [
  { name: "found", text: "Found", next: null },
  { name: "wrong", text: "Wrong place", next: "Look at once: a wrong pose of the map, drift between sessions, or another place that looks the same." },
  { name: "ambiguous", text: "Ambiguous", next: "Other places look the same. Map what differs (doors, corners), or let robots send `gravity` and a `prior`." },
  { name: "not_found", text: "Not found", next: "Map this area again, from the directions in which robots drive." },
  { name: "unchecked", text: "Not checked", next: "Frame and answer have no poses in one parent frame, so nothing says whether they are right. Join the sessions." },
];
/** How a cell compares with an earlier result. */
export const TRENDS = [
  { name: "better", text: "Better", sign: "▲" }, { name: "worse", text: "Worse", sign: "▼" },
  { name: "same", text: "Same", sign: "=" }, { name: "new", text: "New", sign: "+" }, { name: "gone", text: "Gone", sign: "–" },
];
const NAMES = OUTCOMES.map((one) => one.name);
/** Of equally many the worse colours a cell. */
const WORST_FIRST = ["not_found", "ambiguous", "found", "unchecked"];

/** @param {string} name */
export const outcomeOf = (name) => OUTCOMES.find((one) => one.name === name) ?? OUTCOMES[3];

/** Queried frames of a cell. */
export const queriedIn = (cell) => NAMES.reduce((sum, name) => sum + cell[name], 0);

/** The outcomes that counts are listed by. */
export const outcomesIn = (...counts) => OUTCOMES.filter(({ name }) => name !== "unchecked" || counts.some((one) => one.unchecked > 0));

/** Of queried frames those of which it is known what came of them: a share that is found is one of these. */
export const checkedIn = (counts) => queriedIn(counts) - counts.unchecked;

/** What colours a cell: `wrong` where any frame is, else what most queried frames have; null where none was queried. */
export function outcomeIn(cell) {
  if (queriedIn(cell) === 0) return null;
  if (cell.wrong > 0) return "wrong";
  return WORST_FIRST.reduce((best, name) => (cell[name] > cell[best] ? name : best));
}

/**
 * Cells in which robots get lost, the worst first: by the share that is found less the share that is wrong, then by
 * how many were queried.
 */
export function worstCells(cells) {
  const worth = (cell) => (cell.found - cell.wrong) / checkedIn(cell);
  return cells.filter((cell) => cell.found < checkedIn(cell))
    .sort((a, b) => worth(a) - worth(b) || checkedIn(b) - checkedIn(a) || a.row - b.row || a.column - b.column);
}

/** "2 found, 1 not found". */
export const tally = (cell) => OUTCOMES.filter(({ name }) => cell[name] > 0)
  .map(({ name, text }) => `${cell[name]} ${text.toLowerCase()}`).join(", ") || "none queried";

/**
 * The path of a shape about a place, in pixels: a disc, a diamond, a triangle, a square or a bar.
 * @param {string} name of an outcome @param {number} x @param {number} y @param {number} r
 */
export function shapePath(name, x, y, r) {
  const [px, py] = [x.toFixed(1), y.toFixed(1)], far = (1.35 * r).toFixed(1), wide = (2.7 * r).toFixed(1);
  if (name === "found") return `M${(x - r).toFixed(1)} ${py}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0z`;
  if (name === "not_found") return `M${(x - r).toFixed(1)} ${(y - r).toFixed(1)}h${2 * r}v${2 * r}h${-2 * r}z`;
  if (name === "ambiguous") return `M${px} ${(y - 1.35 * r).toFixed(1)}l${far} ${(2.35 * r).toFixed(1)}h-${wide}z`;
  if (name === "unchecked") return `M${(x - r).toFixed(1)} ${(y - r / 3).toFixed(1)}h${2 * r}v${((2 * r) / 3).toFixed(1)}h${-2 * r}z`;
  return `M${px} ${(y - 1.35 * r).toFixed(1)}l${far} ${far}l-${far} ${far}l-${far} -${far}z`;
}

/** The shape of an outcome, for lists. @param {string} name */
export function outcomeMark(name) {
  return svg("svg", { class: "cover-mark", viewBox: "0 0 16 16", "aria-hidden": "true" },
    svg("path", { class: "cover-shape", "data-outcome": name, d: shapePath(name, 8, 8, 5) }));
}
