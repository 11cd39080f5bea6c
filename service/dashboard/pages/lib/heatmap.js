// A square matrix as a heat map on a canvas: pointed at or walked through by keys, with a legend and
// a table that says the same.
import { h, put } from "./dom.js";

// viridis at equal steps, as previews of depth have it; in both themes dark is little
const SCALE = [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142], [31, 158, 137],
  [53, 183, 121], [109, 205, 89], [180, 222, 44], [253, 231, 37]];
const ROOM = 34; // CSS pixels for the labels at the left and on top
const STEPS = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };

/**
 * @param {{values: number[][], names: string[], ticks: string[], label: string, marked?: Set<number>,
 *   format?: (value: number) => string, size?: number,
 *   onmove?: (cell: [number, number] | null) => void, signal: AbortSignal}} what values: from 0 to 1;
 *   names: of rows and columns, in words; ticks: the same, a few signs; marked: which stand out
 * @returns {HTMLElement & {point: (row: number | null) => void}} point: make a row stand out
 */
export function heatmap({ values, names, ticks, label, marked = new Set(), format = String, size = 520, onmove = () => {}, signal }) {
  const n = values.length;
  const cell = Math.max(3, Math.min(26, Math.floor((size - ROOM) / n)));
  const side = ROOM + cell * n;
  const told = h("output", { class: "heatmap-told", "aria-live": "polite" });
  const canvas = h("canvas", { class: "heatmap", tabindex: "0", role: "application", "aria-roledescription": "heat map",
    "aria-label": `${label}. Arrow keys move from cell to cell, Home and End along the row.`,
    onpointermove: (event) => move(cellAt(event)), onpointerleave: () => move(null), onblur: () => move(null),
    onfocus: () => move(at ?? [0, Math.min(1, n - 1)]), onkeydown: walk });
  const cells = painted(values); // once: 200 x 200 of them take longer than a pointer waits
  /** @type {[number, number] | null} */
  let at = null; // the cell that is looked at
  /** @type {number | null} */
  let row = null; // a row that someone else points at

  function cellAt(event) {
    const box = canvas.getBoundingClientRect();
    const [i, j] = [event.clientY - box.top, event.clientX - box.left].map((x) => Math.floor((x * side / box.width - ROOM) / cell));
    return i >= 0 && j >= 0 && i < n && j < n ? [i, j] : null;
  }

  function move(to) {
    if (to?.[0] === at?.[0] && to?.[1] === at?.[1]) return;
    at = to;
    put(told, at === null ? "Hover over a cell, or use the arrow keys."
      : [names[at[0]], " and ", names[at[1]], ": ", h("strong", { class: "number" }, format(values[at[0]][at[1]]))]);
    draw();
    onmove(at);
  }

  function walk(event) {
    const step = STEPS[event.key];
    const [i, j] = at ?? [0, 0];
    const clip = (x) => Math.min(n - 1, Math.max(0, x));
    /** @type {[number, number] | null} */
    let to = null;
    if (step) to = [clip(i + step[0]), clip(j + step[1])];
    else if (event.key === "Home") to = [i, 0];
    else if (event.key === "End") to = [i, n - 1];
    if (to === null) return;
    event.preventDefault();
    move(to);
  }

  function draw() {
    const scale = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(side * scale)) canvas.width = canvas.height = Math.round(side * scale);
    const pen = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, side, side);
    const theme = getComputedStyle(canvas);
    const colour = (name) => theme.getPropertyValue(name).trim();
    pen.imageSmoothingEnabled = false;
    pen.drawImage(cells, ROOM, ROOM, n * cell, n * cell);
    if (cell > 6) {
      pen.strokeStyle = colour("--surface");
      pen.beginPath();
      for (let i = 1; i < n; i += 1) {
        const place = ROOM + i * cell - 0.5;
        pen.moveTo(place, ROOM); pen.lineTo(place, side);
        pen.moveTo(ROOM, place); pen.lineTo(side, place);
      }
      pen.stroke();
    }
    pen.font = "11px system-ui, sans-serif";
    pen.textBaseline = "middle";
    const every = Math.max(1, Math.ceil(16 / cell)); // a label to so many cells
    for (let i = 0; i < n; i += 1) {
      const isLooked = i === row || i === at?.[0] || i === at?.[1];
      const isMarked = marked.has(i);
      const middle = ROOM + (i + 0.5) * cell;
      pen.fillStyle = colour(isLooked || isMarked ? "--accent" : "--muted");
      if (isMarked) { pen.fillRect(ROOM - 5, middle - cell / 2, 3, cell - 1); pen.fillRect(middle - cell / 2, ROOM - 5, cell - 1, 3); }
      if (i % every && !isLooked) continue;
      if (isLooked) pen.fillStyle = colour("--ink");
      pen.textAlign = "right";
      pen.fillText(ticks[i], ROOM - 8, middle);
      pen.textAlign = "center";
      pen.fillText(ticks[i], middle, ROOM - 14);
    }
    pen.strokeStyle = colour("--ink");
    if (row !== null) pen.strokeRect(ROOM - 0.5, ROOM + row * cell - 0.5, n * cell, cell);
    if (at === null) return;
    const [y, x] = at.map((one) => ROOM + one * cell);
    pen.lineWidth = 1;
    pen.strokeRect(ROOM - 0.5, y - 0.5, n * cell, cell);
    pen.strokeRect(x - 0.5, ROOM - 0.5, cell, n * cell);
    pen.lineWidth = 2;
    pen.strokeStyle = colour("--focus");
    pen.strokeRect(x - 1, y - 1, cell + 1, cell + 1);
  }

  const table = h("details", { class: "heatmap-table", ontoggle: () => { if (table.open && table.childElementCount === 1) table.append(asTable(values, ticks, names, format, label)); } },
    h("summary", {}, "Show as table"));
  canvas.style.setProperty("width", `${side}px`);
  window.addEventListener("sceneprint:theme", draw, { signal });
  put(told, "Hover over a cell, or use the arrow keys.");
  requestAnimationFrame(draw); // colours are known when it is in the page
  const element = h("div", { class: "heatmap-block" }, h("div", { class: "heatmap-scroll" }, canvas),
    h("div", { class: "heatmap-foot" }, told, legend()), table);
  return Object.assign(element, { point(to) { if (to !== row) { row = to; draw(); } } });
}

/** A pixel for each cell. */
function painted(values) {
  const n = values.length;
  const cells = h("canvas", { width: n, height: n });
  const pen = /** @type {CanvasRenderingContext2D} */ (cells.getContext("2d"));
  const image = pen.createImageData(n, n);
  values.flat().forEach((value, i) => { image.data.set([...rgbOf(value), 255], 4 * i); });
  pen.putImageData(image, 0, 0);
  return cells;
}

function legend() {
  const strip = h("canvas", { class: "heatmap-legend", width: 120, height: 10, "aria-hidden": "true" });
  const pen = /** @type {CanvasRenderingContext2D} */ (strip.getContext("2d"));
  for (let x = 0; x < 120; x += 1) { pen.fillStyle = `rgb(${rgbOf(x / 119).join(",")})`; pen.fillRect(x, 0, 1, 10); }
  return h("span", { class: "heatmap-key" }, "unrelated 0 ", strip, " 1 the same");
}

function asTable(values, ticks, names, format, label) {
  return h("div", { class: "heatmap-scroll", tabindex: "0", role: "region", "aria-label": label },
    h("table", { class: "table" },
      h("thead", {}, h("tr", {}, h("td"), ticks.map((tick, i) => h("th", { scope: "col", title: names[i] }, tick)))),
      h("tbody", {}, values.map((line, i) => h("tr", {}, h("th", { scope: "row", title: names[i] }, ticks[i]),
        line.map((value) => h("td", { class: "number" }, format(value))))))));
}

function rgbOf(value) {
  const place = Math.min(1, Math.max(0, value)) * (SCALE.length - 1);
  const low = Math.min(SCALE.length - 2, Math.floor(place));
  return SCALE[low].map((from, c) => Math.round(from + (place - low) * (SCALE[low + 1][c] - from)));
}
