// What the colours and shapes of the view mean, and how many of each there are.
import { count, metres, percent } from "../lib/format.js";
import { h, svg } from "../lib/dom.js";
import { BESIDE, STEPS, VIOLATES } from "../viewer/colours.js";

const LISTED = 2000; // violations of a side that the API lists, at most

const rgb = (bytes) => `rgb(${bytes.join(" ")})`;

/** A shape as it is drawn: "dot", "cross", "line" or "lens". */
function mark(shape, colour) {
  const paths = {
    dot: svg("rect", { x: 3, y: 3, width: 10, height: 10, rx: 2, style: { fill: colour } }),
    cross: svg("path", { d: "M3 3l10 10M13 3L3 13", style: { stroke: colour } }),
    line: svg("path", { d: "M1 12L15 4", style: { stroke: colour } }),
    lens: svg("path", { d: "M2 8L12 3v10zM12 3h2v10h-2", style: { stroke: colour } }),
    both: svg("path", { d: "M1 8h14M4 5L1 8l3 3M12 5l3 3-3 3", style: { stroke: colour } }),
  };
  return svg("svg", { class: "overlay-mark", viewBox: "0 0 16 16", "aria-hidden": "true" }, paths[shape]);
}

/**
 * @param {Object<string, any>} shown see Scene
 * @param {{query: Object<string, any>, match: Object<string, any>}} points
 * @param {Object<string, any> | undefined} tally of the pose that is shown; undefined until it has come
 */
export function legend(shown, details, points, tally) {
  const rows = [], seen = (name) => !shown.hidden.has(name);
  const add = (shape, colour, text, more) => rows.push(h("li", {}, mark(shape, colour), h("span", {}, text, more && h("span", { class: "muted" }, ` ${more}`))));
  const isWhole = shown.pose !== "before" && shown.share === 1;
  if (shown.colour === "source") {
    for (const side of ["query", "match"]) {
      const { count: n, total } = points[side];
      if (seen(side)) add("dot", `var(--${side})`, side === "query" ? "Query" : "Match", n < total ? `${count(n)} of ${count(total)} points` : `${count(n)} points`);
    }
  } else if (shown.colour === "normal") {
    for (const [colour, text] of [["rgb(255 128 128)", "faces +x"], ["rgb(128 255 128)", "faces +y"], ["rgb(128 128 255)", "faces +z"]]) add("dot", colour, text);
    rows.push(h("li", { class: "muted" }, "red, green, blue: x, y, z of the normal, in the match’s axes"));
  } else if (tally) {
    const scale = points.query.scale, share = (n) => percent(n / Math.max(tally.total, 1));
    add("dot", rgb(STEPS[0]), `within ${metres(scale / 5)}`, share(tally.fifth));
    add("dot", rgb(STEPS[1]), `within ${metres((2 * scale) / 5)}`, share(tally.half));
    add("dot", rgb(STEPS[2]), `within ${metres(scale)}, the limit at short range`, share(tally.all));
    add("dot", rgb(BESIDE), "farther, hidden, or outside the view of the other", share(tally.outside));
    add("dot", rgb(VIOLATES), "the other sensor saw through", share(tally.violations));
  } else {
    rows.push(h("li", { class: "muted" }, details.transform ? "Comparing points…" : "Nothing to compare: there is no transform."));
  }
  if (isWhole && seen("violations") && shown.colour !== "residual") {
    const n = (details.query?.violations.length ?? 0) + (details.match?.violations.length ?? 0);
    const asked = (details.query?.sampled ?? 0) + (details.match?.sampled ?? 0), isRival = shown.pose === "rival";
    const least = [details.query, details.match].some((one) => one?.violations.length >= LISTED) ? "at least " : "";
    const more = isRival ? "some of them" : `${least}${count(n)} of ${count(asked)} compared points`;
    if (isRival ? tally?.violations : n) add("cross", "var(--violation)", "Violation: the other sensor saw through here", more);
  }
  if (seen("patches") && details.patches && shown.pose !== "rival") add("line", "var(--ink)", "Matching patches", `${count(details.patches.query.length)} pairs`);
  if (seen("cameras")) {
    add("lens", "var(--query)", "Query sensor");
    add("lens", "var(--match)", "Match sensor");
  }
  if (isWhole && seen("free") && shown.pose === "aligned" && details.uncertainty?.degenerate.length) add("both", "var(--accent)", "Free direction");
  return h("ul", { class: "overlay-legend", "aria-label": "Legend" }, rows);
}
