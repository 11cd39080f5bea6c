// A square matrix as a table whose cells are colours: pointed at or walked through by keys, with a legend.
import { h, put } from "./dom.js";

// viridis at equal steps, as previews of depth have it; in both themes dark is little
const SCALE = ["#440154", "#48287c", "#3e4a89", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6dcd59", "#b4de2c", "#fde725"];
const ROOM = 34; // CSS pixels for the labels at the left
const STEPS = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1], Home: [0, -Infinity], End: [0, Infinity] };
const HINT = "Hover over a cell, or use the arrow keys.";

/**
 * @param {{values: number[][], names: string[], ticks: string[], label: string, marked?: Set<number>,
 *   format?: (value: number) => string, size?: number, onmove?: (cell: [number, number] | null) => void}} what
 *   values: from 0 to 1; names: of rows and columns, in words; ticks: the same, a few signs; marked: which stand out
 * @returns {HTMLElement & {point: (row: number | null) => void}} point: make a row stand out
 */
export function heatmap({ values, names, ticks, label, marked = new Set(), format = String, size = 520, onmove = () => {} }) {
  const last = values.length - 1, cell = Math.max(3, Math.min(26, Math.floor((size - ROOM) / values.length)));
  const every = Math.max(1, Math.ceil(16 / cell)); // a label to so many cells
  const told = h("output", { class: "heatmap-told", "aria-live": "polite" }, HINT);
  const head = (i, scope) => h("th", { scope, title: names[i], dataset: { marked: marked.has(i) || null } }, i % every ? null : h("span", {}, ticks[i]));
  const table = h("table", { class: "heatmap", style: { "--cell": `${cell}px` }, onpointerover: ({ target }) => {
    const { cellIndex, parentElement } = target.closest("td") ?? {};
    move(parentElement?.rowIndex > 0 && cellIndex > 0 ? [parentElement.rowIndex - 1, cellIndex - 1] : null);
  }, onpointerleave: () => move(null) },
  h("thead", {}, h("tr", {}, h("td", {}), ticks.map((_, i) => head(i, "col")))),
  h("tbody", {}, values.map((line, i) => h("tr", {}, head(i, "row"), line.map((value) => h("td", { style: { background: colourOf(value) } }, format(value)))))));
  /** @type {[number, number] | null} */
  let at = null; // the cell that is looked at

  function move(to) {
    for (const one of partsOf(at)) one.removeAttribute("data-at");
    at = to;
    for (const one of partsOf(at)) one.setAttribute("data-at", "");
    put(told, at === null ? HINT : [names[at[0]], " and ", names[at[1]], ": ", h("strong", { class: "number" }, format(values[at[0]][at[1]]))]);
    onmove(at);
  }

  /** A cell and the heads of its row and column. */
  function partsOf(place) {
    if (place === null) return [];
    const row = table.rows[place[0] + 1];
    return [row.cells[place[1] + 1], row.cells[0], table.rows[0].cells[place[1] + 1]];
  }

  function walk(event) {
    const step = STEPS[event.key];
    if (!step) return;
    event.preventDefault();
    move(/** @type {[number, number]} */ ([0, 1].map((k) => Math.min(last, Math.max(0, (at?.[k] ?? 0) + step[k])))));
  }

  const region = h("div", { class: "heatmap-scroll", tabindex: "0", role: "region", "aria-label": `${label}. Arrow keys move from cell to cell, Home and End along the row.`,
    onkeydown: walk, onfocus: () => move(at ?? [0, Math.min(1, last)]), onblur: () => move(null) }, table);
  const element = h("div", { class: "heatmap-block" }, region, h("div", { class: "heatmap-foot" }, told,
    h("span", { class: "heatmap-key" }, "unrelated 0 ", h("span", { class: "heatmap-legend", style: { background: `linear-gradient(to right, ${SCALE.join(", ")})` } }), " 1 the same")));
  return Object.assign(element, { point(row) { [...table.rows].forEach((one, i) => one.toggleAttribute("data-row", i - 1 === row)); } });
}

/** A colour between two of the scale. @param {number} value from 0 to 1 */
function colourOf(value) {
  const place = Math.min(1, Math.max(0, value)) * (SCALE.length - 1), low = Math.min(SCALE.length - 2, Math.floor(place));
  return `color-mix(in srgb, ${SCALE[low + 1]} ${(100 * (place - low)).toFixed(0)}%, ${SCALE[low]})`;
}
