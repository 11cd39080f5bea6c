// The filters of the gallery: fields that show what the address says, and write what it shall say.
import { h, put } from "../lib/dom.js";
import { STATES } from "./badge.js";

/** Of the address, those that choose frames. */
export const FILTERS = ["find", "robot", "session", "state", "tag", "captured_after", "captured_before"];
// more choices than this are typed, with suggestions: nobody scrolls through a list of thousands
const MOST_LISTED = 200;

/**
 * Fields for an id, name or session, for robot, session, state, tag and time.
 * @param {URLSearchParams} search of the address
 * @param {Object<string, any>[]} runs `items` of the map's sessions
 * @param {(change: Object<string, string | null>) => void} choose null takes a filter away
 * @returns {HTMLElement & {refill: (search: URLSearchParams) => void}}
 */
export function filterBar(search, runs, choose) {
  const fills = [];
  const names = (key) => [...new Set(runs.map((run) => run[key]).filter((one) => one !== null))].sort();

  function field(name, label, control) {
    control.id = `filter-${name}`;
    fills.push((given) => { control.show(given.get(name) ?? ""); });
    return h("label", { class: "field", for: control.id }, h("span", {}, label), control);
  }

  function listed(name, label, choices, all) {
    const told = (event) => choose({ [name]: event.target.value || null });
    if (choices.length > MOST_LISTED) return field(name, label, typed(name, choices, told));
    const select = h("select", { onChange: told });
    const fill = (value) => {
      // what the address asks for may be no choice any more, and is still what is asked for
      const missing = value !== "" && !choices.includes(value) ? [value] : [];
      put(select, h("option", { value: "" }, all), [...missing, ...choices].map((one) => h("option", { value: one }, one)));
      select.value = value;
    };
    return field(name, label, Object.assign(select, { show: fill }));
  }

  function typed(name, choices, told, hint = "any") {
    const list = `choices-${name}`;
    const input = h("input", { type: "text", autocomplete: "off", placeholder: hint, list: choices.length ? list : null, onChange: told });
    const suggested = h("datalist", { id: list }, choices.slice(0, 1000).map((one) => h("option", { value: one })));
    if (choices.length) fills.push(() => { if (!suggested.isConnected) input.after(suggested); });
    return Object.assign(input, { show: (value) => { input.value = value; } });
  }

  function moment(name, label) {
    const input = h("input", {
      type: "datetime-local", title: "In the time zone of this computer",
      onChange: () => {
        const at = new Date(input.value);
        // a year that is being typed is told digit by digit: 0002, 0020, 0202
        if (input.value && !(at.getFullYear() >= 1000 && at.getFullYear() <= 9999)) return;
        choose({ [name]: input.value ? at.toISOString() : null });
      },
    });
    return field(name, label, Object.assign(input, { show: (value) => { if (input.value !== local(value)) input.value = local(value); } }));
  }

  const tag = (event) => choose({ tag: event.target.value.trim() || null });
  const find = (event) => choose({ find: event.target.value.trim() || null });
  const element = h("div", { class: "filters", role: "group", "aria-label": "Filters" },
    field("find", "Find", Object.assign(typed("find", [], find, "id, file name or session"), { type: "search" })),
    listed("robot", "Robot", names("robot"), "All robots"),
    listed("session", "Session", names("session"), "All sessions"),
    listed("state", "State", STATES, "All except deleted"),
    field("tag", "Tag", typed("tag", [], tag)),
    moment("captured_after", "Taken from"),
    moment("captured_before", "Taken until"));
  const refill = (given) => { for (const fill of fills) fill(given); };
  refill(search);
  return Object.assign(element, { refill });
}

/** A time of the address, which has a zone, as the field has it, which has none. */
function local(iso) {
  const at = new Date(iso);
  if (iso === "" || Number.isNaN(at.getTime())) return "";
  return new Date(at.getTime() - 60_000 * at.getTimezoneOffset()).toISOString().slice(0, 16);
}

/**
 * How many frames pass, where the sessions tell; null where it would have to be counted.
 * @param {URLSearchParams} search
 * @param {Object<string, any>[] | null} runs all sessions of the map; null where there are more
 * @returns {number | null}
 */
export function countOf(search, runs) {
  const uncounted = ["tag", "find", "captured_after", "captured_before"];
  if (runs === null || uncounted.some((name) => search.has(name))) return null;
  const states = search.getAll("state");
  const passes = (run, name) => !search.has(name) || search.getAll(name).includes(run[name]);
  return runs.filter((run) => passes(run, "robot") && passes(run, "session"))
    .flatMap((run) => Object.entries(run.frames))
    .filter(([one]) => (states.length ? states.includes(one) : one !== "deleted"))
    .reduce((sum, [, n]) => sum + n, 0);
}
