// A chart over time as SVG: lines or stacked bars, a readout that follows pointer and arrow keys,
// and the same numbers as a table. Values change without the element: focus and readout stay.

import { h, put, svg } from "./dom.js";
import { areaPath, clock, dotPath, linePath, stacked, steps, timeTicks } from "./scales.js";

const HEIGHT = 148;
const EDGE = { left: 48, right: 8, top: 8, bottom: 22 };
const KEYS = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10, Home: -Infinity, End: Infinity };

/**
 * A chart; it has nothing to show until `update` is called.
 * @param {{
 *   title: string,
 *   kind?: "lines" | "bars",
 *   series: {name: string, colour: string, dash?: string, area?: boolean, over?: boolean}[],
 *   format: (value: number) => string,
 *   axis?: (value: number) => string,
 *   least?: number,
 *   nothing?: string,
 * }} options colour: a custom property, with a dash that tells lines apart without it; format: of
 *   a value with its unit; axis: of a step of the axis, default `format`; least: the smallest
 *   step; nothing: said where there is no value at all. Bars stand on each other in the order given,
 *   but for those that are a line `over` them
 * @returns {{element: HTMLElement, update: (times: Date[], values: (number | null)[][]) => void}}
 *   times: rising and even; values: of each series, as many as times
 */
export function chart({ title, kind = "lines", series, format, axis = format, least = 0, nothing = "" }) {
  /** @type {{times: Date[], values: (number | null)[][], at: number | null, width: number}} */
  const state = { times: [], values: series.map(() => []), at: null, width: 480 };
  const drawing = svg("svg", { "aria-hidden": "true", height: HEIGHT });
  const plot = h("div", { class: "chart-plot", tabindex: "0", role: "slider", "aria-label": title,
    "aria-orientation": "horizontal" }, drawing);
  const told = series.map(() => h("span", { class: "number" }));
  const moment = h("span", { class: "muted number" });
  const table = h("table", { class: "table compact" });
  const more = h("details", { class: "chart-table", onToggle: () => fill() },
    h("summary", {}, "Show as table"), h("div", { class: "chart-scroll", tabindex: "0", role: "region", "aria-label": `${title}, table` }, table));
  const note = h("p", { class: "chart-nothing muted", hidden: true }, nothing);
  const element = h("figure", { class: "chart" },
    h("figcaption", {}, h("span", { class: "chart-title" }, title), moment,
      h("span", { class: "chart-legend" }, series.map((one, i) => h("span", { class: "chart-entry" }, swatch(one, kind === "bars" && !one.over), one.name, told[i])))),
    h("div", { class: "chart-box" }, plot, note), more);

  const parts = { drawing, state, series, kind, axis, least };
  const redraw = () => { draw(parts); read(); };

  /** Tell the values at the cursor, or of the last minute that is over. */
  function read() {
    const last = state.times.length - 1;
    const at = state.at ?? Math.max(last - 1, 0);
    const time = state.times[at];
    put(moment, time ? clock(time) : "");
    told.forEach((one, i) => { put(one, value(i, at)); });
    plot.setAttribute("aria-valuemin", "0");
    plot.setAttribute("aria-valuemax", String(Math.max(last, 0)));
    plot.setAttribute("aria-valuenow", String(at));
    const words = series.map((one, i) => `${one.name} ${value(i, at)}`);
    plot.setAttribute("aria-valuetext", time ? `${clock(time)}: ${words.join(", ")}` : "no values");
    mark(parts);
  }

  function value(i, at) {
    const found = state.values[i][at];
    return found === null || found === undefined ? "–" : format(found);
  }

  function fill() {
    if (!more.open) return;
    const rows = state.times.map((time, at) => h("tr", {}, h("th", { scope: "row" }, clock(time)),
      series.map((_, i) => h("td", { class: "number" }, value(i, at)))));
    put(table, h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Minute"), series.map((one) => h("th", { scope: "col", class: "number" }, one.name)))),
      h("tbody", {}, rows.reverse()));
  }

  plot.addEventListener("pointermove", (event) => {
    const x = event.clientX - drawing.getBoundingClientRect().left;
    const { left, step } = frame(parts);
    point(Math.floor((x - left) / step));
  });
  plot.addEventListener("pointerleave", () => { if (document.activeElement !== plot) point(null); });
  plot.addEventListener("blur", () => point(null));
  plot.addEventListener("keydown", (event) => {
    if (event.key === "Escape") { point(null); return; }
    const by = KEYS[event.key];
    if (by === undefined) return;
    event.preventDefault();
    point((state.at ?? state.times.length - 1) + by);
  });

  function point(at) {
    state.at = at === null || state.times.length === 0 ? null : Math.min(Math.max(at, 0), state.times.length - 1);
    read();
  }

  // its real width: a drawing that is stretched has text of another size in each chart
  const observer = new ResizeObserver(([entry]) => {
    const width = Math.round(entry.contentRect.width);
    if (width > 0 && width !== state.width) { state.width = width; redraw(); }
  });
  observer.observe(plot);

  return {
    element,
    update(times, values) {
      // the minute that is looked at stays under the cursor when all move on by one
      const looked = state.at === null ? null : state.times[state.at]?.getTime();
      Object.assign(state, { times, values });
      if (looked !== null) {
        const again = times.findIndex((time) => time.getTime() === looked);
        state.at = Math.max(again, 0);
      }
      note.hidden = values.some((one) => one.some((found) => found !== null && found !== 0));
      redraw();
      fill();
    },
  };
}

/** Where things are: the left edge, the width of a minute, and the heights.
 * @param {Object<string, any>} parts of `chart` */
function frame(parts) {
  const { state, series, least } = parts;
  const left = EDGE.left;
  const step = (state.width - left - EDGE.right) / Math.max(state.times.length, 1);
  const [piles, lines] = parted(parts);
  const piled = [...stacked(piles.map((i) => state.values[i])).flat().map(([, to]) => to), ...lines.flatMap((i) => state.values[i])];
  const axisSteps = steps(Math.max(0, ...piled.filter((one) => one !== null)), 3, least);
  const bottom = HEIGHT - EDGE.bottom;
  const y = (value) => bottom - (value / axisSteps[axisSteps.length - 1]) * (bottom - EDGE.top);
  return { left, step, bottom, y, axisSteps, x: (i) => left + (i + 0.5) * step, count: series.length };
}

function draw(parts) {
  const { drawing, state, series, axis } = parts;
  const { left, step, bottom, x, y, axisSteps } = frame(parts);
  drawing.setAttribute("width", state.width);
  drawing.setAttribute("viewBox", `0 0 ${state.width} ${HEIGHT}`);
  const grid = axisSteps.map((value) => [
    svg("line", { class: "chart-grid", x1: left, x2: state.width - EDGE.right, y1: y(value), y2: y(value) }),
    svg("text", { class: "chart-label", x: left - 6, y: y(value) + 3.5, "text-anchor": "end" }, axis(value)),
  ]);
  const labels = timeTicks(state.times, Math.max(Math.floor(state.width / 72), 2)).map((i) =>
    svg("text", { class: "chart-label", x: Math.min(x(i), state.width - 18), y: HEIGHT - 6, "text-anchor": "middle" }, clock(state.times[i])));
  const [piles, lines] = parted(parts);
  const curves = lines.map((i) => [
    series[i].area && svg("path", { d: areaPath(state.values[i], x, y), style: { fill: `var(${series[i].colour})`, opacity: "0.14" } }),
    svg("path", { class: "chart-line", d: linePath(state.values[i], x, y), "stroke-dasharray": series[i].dash ?? null,
      style: { stroke: `var(${series[i].colour})` } }),
    svg("path", { class: "chart-line chart-dot", d: dotPath(state.values[i], x, y), style: { stroke: `var(${series[i].colour})` } }),
  ]);
  const cursor = svg("rect", { class: "chart-cursor", y: EDGE.top, height: bottom - EDGE.top, width: Math.max(step, 1) });
  put(drawing, grid, labels, cursor, bars(parts, piles, step, x, y), curves);
}

function bars({ state, series }, piles, step, x, y) {
  const width = Math.max(step - (step > 5 ? 2 : 0.5), 1);
  return stacked(piles.map((i) => state.values[i])).map((values, s) => values.map(([from, to], i) => to > from
    && svg("rect", { x: x(i) - width / 2, width, y: y(to), height: Math.max(y(from) - y(to), 1), style: { fill: `var(${series[piles[s]].colour})` } })));
}

/** Places of the series that are piled up, and of those that are lines. @param {Object<string, any>} parts */
function parted({ series, kind }) {
  const isPiled = (one) => kind === "bars" && !one.over;
  const places = series.map((_, i) => i);
  return [places.filter((i) => isPiled(series[i])), places.filter((i) => !isPiled(series[i]))];
}

/** The minute that is read out. */
function mark(parts) {
  const { drawing, state } = parts;
  const cursor = drawing.querySelector(".chart-cursor");
  if (!cursor) return;
  const { left, step } = frame(parts);
  cursor.setAttribute("x", String(left + (state.at ?? 0) * step));
  cursor.style.setProperty("visibility", state.at === null ? "hidden" : "visible");
}

/** @param {{colour: string, dash?: string}} series @param {boolean} isBar */
function swatch({ colour, dash }, isBar) {
  const paint = isBar ? { fill: `var(${colour})` } : { stroke: `var(${colour})` };
  return svg("svg", { class: "chart-swatch", viewBox: "0 0 14 10", width: 14, height: 10, "aria-hidden": "true" },
    isBar ? svg("rect", { x: 2, y: 0, width: 10, height: 10, rx: 2, style: paint })
      : svg("path", { class: "chart-line", d: "M1 5h12", "stroke-dasharray": dash ?? null, style: paint }));
}
