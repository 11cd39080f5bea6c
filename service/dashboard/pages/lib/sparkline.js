// A line of a few numbers as small as a word: jobs that wait. No axes: the label tells the gist.
// In a file of its own, since the first page has a budget that charts.js would burst.

import { svg } from "./dom.js";

/**
 * Points of a line in a box, the first value at the left edge and the last at the right.
 *
 * From 0 to the greatest value, so that two sparklines side by side do not turn noise into mountains.
 *
 * @param {number[]} values
 * @param {number} width
 * @param {number} height
 * @param {number} [pad] room kept free at top and bottom, for the width of the line
 * @returns {[number, number][]}
 */
export function sparkPoints(values, width, height, pad = 1.5) {
  const most = Math.max(0, ...values);
  const step = values.length > 1 ? width / (values.length - 1) : 0;
  return values.map((value, i) => [
    round(i * step),
    round(height - pad - (most > 0 ? Math.max(value, 0) / most : 0) * (height - 2 * pad)),
  ]);
}

/**
 * @param {number[]} values oldest first
 * @param {{label: string, width?: number, height?: number, colour?: string}} options
 *   label: what it shows, for those who do not see it; colour: a custom property
 * @returns {SVGElement}
 */
export function sparkline(values, { label, width = 96, height = 24, colour = "--accent" }) {
  const points = sparkPoints(values, width, height);
  const line = points.length === 1 ? [points[0], [width, points[0][1]]] : points;
  const path = line.map(([x, y], i) => `${i ? "L" : "M"}${x} ${y}`).join("");
  const paint = { stroke: `var(${colour})`, fill: "none" };
  return svg(
    "svg",
    { class: "sparkline", role: "img", "aria-label": label, viewBox: `0 0 ${width} ${height}`, width, height },
    line.length > 1 && [
      svg("path", {
        d: `${path}L${width} ${height}L0 ${height}Z`,
        style: { fill: `var(${colour})`, opacity: "0.12" },
      }),
      svg("path", {
        d: path,
        style: { ...paint, "stroke-width": "1.5", "stroke-linejoin": "round", "stroke-linecap": "round" },
      }),
    ],
  );
}

function round(x) {
  return Math.round(x * 100) / 100;
}
