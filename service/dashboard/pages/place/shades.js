// What the colours of the surface mean, and which heights of it are drawn.

import { h, put } from "../lib/dom.js";
import { count, things, time } from "../lib/format.js";
import { tintOf } from "../paths/scene.js";

export const COLOURS = [["height", "Height"], ["session", "Session"], ["seen", "Times seen"], ["age", "Last seen"]];
const MOST_SESSIONS = 12;
/** Steps from the lowest height to the highest. */
const STEPS = 100;

/** @param {import("./surface.js").Surface} surface @param {() => void} onchange the address follows */
export function shades(surface, onchange) {
  const select = h("select", { id: "place-colour", onChange: () => { surface.paint({ colour: select.value }); draw(); onchange(); } },
    COLOURS.map(([value, text]) => h("option", { value, selected: value === surface.colour }, text)));
  const legend = h("div", { class: "place-legend" });
  const range = (id, label, change) => h("input", { type: "range", id, min: 0, max: STEPS, "aria-label": label, onInput: change, onChange: onchange });
  const ends = [range("place-low", "Lowest height drawn", () => cut(0)), range("place-high", "Highest height drawn", () => cut(1))];
  const told = h("span", { class: "number muted" });
  const facts = h("p", { class: "muted" });
  const ceiling = h("p", { class: "muted" });
  const element = h("section", { class: "card paths-section", "aria-labelledby": "place-surface", hidden: true },
    h("h2", { id: "place-surface" }, "Surface"),
    h("label", { class: "field" }, h("span", {}, "Colour by"), select), legend,
    h("div", { class: "field", role: "group", "aria-label": "Heights drawn" }, h("span", { class: "paths-row" }, "Heights", told), h("span", { class: "place-cut" }, ends)),
    ceiling, facts);

  // a step of a slider to metres: a little beyond what the colours reach, so that all is drawn at the ends
  const metresAt = (step) => { const [low, high] = surface.range ?? [0, 1], more = (high - low) * 0.05; return low - more + ((high - low + 2 * more) * step) / STEPS; };
  const stepAt = (height) => { const [a, b] = [metresAt(0), metresAt(STEPS)]; return Math.round(((height - a) / (b - a)) * STEPS); };

  function cut(moved) {
    const values = ends.map((one) => Number(one.value));
    if (values[0] > values[1]) values[moved] = values[1 - moved];
    ends[moved].value = String(values[moved]);
    const all = values[0] === 0 && values[1] === STEPS;
    surface.isChosen = true;
    surface.paint({ cut: all ? null : [values[0] === 0 ? -1e9 : metresAt(values[0]), values[1] === STEPS ? 1e9 : metresAt(values[1])] });
    surface.later();
    put(ceiling);
    tell();
  }

  function tell() {
    const text = ends.map((one) => tenths(metresAt(Number(one.value))));
    put(told, surface.cut === null ? "all" : text.join(" to "));
    ends.forEach((one, i) => one.setAttribute("aria-valuetext", text[i]));
  }

  function draw() {
    const { record, range: heights } = surface;
    element.hidden = true;
    if (!record?.parents.length || heights === null) return;
    element.hidden = false;
    const ramp = (low, high) => [h("span", { class: "place-ramp", "aria-hidden": "true" }), h("span", { class: "paths-row number" }, h("span", {}, low), h("span", {}, high))];
    if (surface.colour === "height") put(legend, ramp(...heights.map(tenths)));
    if (surface.colour === "seen") put(legend, ramp("1 frame", `${count(surface.mostSeen)} frames`));
    if (surface.colour === "age") put(legend, record.first_taken ? ramp(["seen ", time(record.first_taken)], time(record.last_taken)) : h("p", { class: "muted" }, "No frame says when it was taken: send `captured_at` with frames."));
    if (surface.colour === "session") put(legend, sessions(record.sessions, surface.runs));
    const [low, high] = surface.cut ?? [-1e9, 1e9];
    [low, high].forEach((height, i) => { ends[i].value = String(Math.min(Math.max(stepAt(height), 0), STEPS)); });
    tell();
    put(ceiling, !surface.isChosen && surface.cut !== null && "The upper part is not drawn: it covers the rest.");
    put(facts, `${things(record.frames, "frame")}, updated `, time(record.updated_at));
  }

  return { element, draw };
}

// a height; no "-0.0"
const tenths = (x) => `${(Math.round(10 * x) / 10 || 0).toFixed(1)} m`;

function sessions(names, runs) {
  if (!names.length) return h("p", { class: "muted" }, "No frame has a session.");
  const shown = names.slice(-MOST_SESSIONS);
  return [
    h("ul", { class: "place-sessions" }, shown.map((name, i) => {
      const run = runs[names.length - shown.length + i] ?? null;
      return h("li", {}, h("span", { class: "place-swatch", style: { background: run === null ? "var(--muted)" : `var(--${tintOf(run)})` } }), h("span", { class: "paths-name" }, name));
    })),
    h("p", { class: "muted" }, `A cell has the colour of the session that saw it last.${names.length > shown.length ? ` The last ${count(shown.length)} of ${count(names.length)}.` : ""}`),
  ];
}
