// Coverage is begun by a dialog, and followed until it is over.
import { at, send } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { beginFrom } from "../lib/products.js";
import { sheet } from "../lib/states.js";

/**
 * Ask what to measure, and begin it.
 * @param {string} map @param {{sessions: string[], robots: string[]}} names that can be chosen
 * @param {(begun: Object<string, any>) => void} onbegun
 */
export function beginCoverage(map, { sessions, robots }, onbegun) {
  const number = (name, value, more) => h("input", { type: "number", id: `cover-${name}`, name, value, ...more });
  const field = (name, text, input, hint) => h("div", { class: "field" }, h("label", { for: `cover-${name}` }, text), input,
    hint && h("small", { class: "muted" }, hint));
  const listed = (name, all, names) => h("select", { id: `cover-${name}` }, h("option", { value: "" }, all), names.map((one) => h("option", { value: one }, one)));
  const session = listed("session", "All sessions", sessions), robot = listed("robot", "All robots", robots);
  const every = number("every", 1, { min: 1, step: 1 }), most = number("most", 1000, { min: 1, max: 5000, step: 1 });
  const without = h("select", { id: "cover-without", onChange: () => { within.disabled = without.value !== "near"; } },
    h("option", { value: "near" }, "frames of its session taken just before and after"),
    h("option", { value: "session" }, "its whole session"),
    h("option", { value: "itself" }, "only the frame itself"));
  const within = number("not_within_s", 10, { min: 0, step: "any" });
  const off = number("tolerance_m", 0.5, { min: 0.01, max: 100, step: "any" }), turned = number("tolerance_deg", 15, { min: 0.1, max: 180, step: "any" });
  const wide = number("cell_m", "", { min: 0.1, max: 1000, step: "any", placeholder: "auto" });
  const dialog = sheet({ title: "Measure coverage", buttons: h("button", { class: "button primary" }, "Start"), children: [
    h("p", { class: "muted" }, "Queries frames of the map against the rest of it. Uploads and queries go first; it takes about 0.1 s per frame."),
    field("session", "Query frames of", session),
    robots.length > 1 && field("robot", "and of", robot),
    h("div", { class: "cover-pair" }, field("every", "Every n-th frame", every), field("most", "At most", most)),
    field("without", "A frame must not find", without, "A robot that comes back on another day has none of these. Decides what the result means."),
    field("not_within_s", "Just before and after: seconds", within),
    h("details", {}, h("summary", {}, "Tolerance and cells"),
      h("div", { class: "cover-pair" }, field("tolerance_m", "Right within, m", off), field("tolerance_deg", "and within, °", turned)),
      field("cell_m", "Cell width, m", wide, "Two results are compared only if their cells are equally wide.")),
    h("p", { class: "field-error", role: "alert" }),
  ] });
  beginFrom(dialog, at("maps", map, "coverage"), () => {
    const value = (input) => (Number.isFinite(input.valueAsNumber) ? input.valueAsNumber : undefined);
    const left = without.value === "session" ? { other_sessions: true } : { not_within_s: without.value === "itself" ? 0 : value(within) };
    return { session: session.value || undefined, robot: robot.value || undefined, every: value(every), most: value(most), ...left,
      tolerance_m: value(off), tolerance_deg: value(turned), cell_m: value(wide) };
  }, onbegun);
}

/** @param {string} id of the job */
export const cancelCoverage = (id) => send("POST", `${at("jobs", id)}/cancel`);
