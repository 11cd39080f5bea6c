// Robots in the picture of a map: where each was found last, and where it got lost, by the records of
// its queries. A time line goes back through them. Nothing is asked again, and nothing is counted.

import { get, list } from "../lib/api.js";
import { h, put, throttle } from "../lib/dom.js";
import { count, time } from "../lib/format.js";
import { coded, sentence } from "../lib/prose.js";
import { robotTokens } from "../lib/palette.js";
import { link } from "../lib/router.js";
import { LOST, STATUSES } from "../lib/statuses.js";
import { placeOf } from "../paths/shapes.js";
import { multiply, ofQuaternion } from "../viewer/matrix.js";

/** Records that are read at most, the newest of a period; at a time. */
const MOST = 2000, PAGE = 500;
/** Without a period: so many. */
const LATEST = 500;
/** Failures that are marked, and robots that are told. */
const MOST_MARKS = 60, MOST_ROBOTS = 50;
/** Of one robot: failures that are told, and poses of the way it came. */
const MOST_FAILURES = 3, TRAIL = 40;
const PERIODS = [["", "Latest queries"], ["1", "Last hour"], ["24", "Last 24 hours"], ["168", "Last 7 days"]];
const HOUR_MS = 3_600_000;
/** How long a replay takes at most, and how fast and slow its steps are. */
const REPLAY_MS = 20_000, FASTEST_MS = 80, SLOWEST_MS = 800;
const TOGETHER_MS = 200;

/**
 * Where robots were when the last of some records came.
 * @param {Object<string, any>[]} records in the order of time
 * @returns {{name: string, last: any, found: any, trail: any[], lost: any[]}[]} those heard of last first;
 *   found: the last record with a pose; trail: those before it; lost: failures, each with the record `near`
 *   of where the robot had been found last; null: nowhere
 */
export function robotsOf(records) {
  /** @type {Map<string, any>} */
  const robots = new Map();
  for (const record of records) {
    const name = record.robot ?? (record.key ? `key ${record.key}` : "not named");
    const one = robots.get(name) ?? { name, found: null, trail: [], lost: [] };
    robots.delete(name); // and set again: the order is that of the last record
    robots.set(name, one);
    one.last = record;
    if (record.pose) {
      if (one.found) one.trail.push(one.found);
      one.found = record;
    } else if (LOST.includes(record.status)) {
      one.lost.push({ record, near: one.found });
    }
  }
  return [...robots.values()].reverse();
}

export class Robots {
  /** @type {any[]} in the order of time */
  #records = [];
  #more = false;
  /** @type {Timer} */
  #player = null;
  #later;
  /** @type {string | null} the robot that the camera follows, and the frame in which it came near */
  #followed = null;
  /** @type {string | null} */
  #near = null;
  /** @type {string | null | undefined} the period that the list of periods tells */
  #period;

  /**
   * @param {{map: string, signal: AbortSignal, search: URLSearchParams,
   *   scene: import("../paths/scene.js").Scene, runs: import("../paths/runs.js").Runs, onchange: () => void}} what
   */
  constructor({ map, signal, search, scene, runs, onchange }) {
    this.map = map;
    this.signal = signal;
    this.scene = scene;
    this.runs = runs;
    this.onchange = onchange;
    const when = (name) => (Number.isFinite(Date.parse(search.get(name) ?? "")) ? search.get(name) : null);
    this.since = when("since");
    this.until = when("until");
    /** @type {string | null} the time that is shown; null: the latest */
    this.at = when("at");
    window.addEventListener("sceneprint:theme", () => this.draw(), { signal });
    signal.addEventListener("abort", () => clearTimeout(this.#player), { once: true });
    this.#later = throttle(() => this.#newest(), TOGETHER_MS, signal);
    this.list = h("ul", { class: "place-robots" });
    this.none = h("p", { class: "muted" });
    this.slider = h("input", { type: "range", id: "place-time", min: 1, max: 1, value: 1, "aria-label": "Time", onInput: () => { this.stop(); this.#go(Number(this.slider.value)); }, onChange: () => this.onchange() });
    this.told = h("span", { class: "number place-when" });
    this.play = h("button", { class: "button", type: "button", id: "place-play", onClick: () => this.#toggle() });
    this.period = h("select", { id: "place-period", "aria-label": "Period", onChange: () => this.#choose(this.period.value) });
    this.live = h("button", { class: "button", type: "button", hidden: true, onClick: () => { this.stop(); this.#go(this.#records.length); this.onchange(); this.slider.focus(); } }, "Latest");
    this.bar = h("div", { class: "place-time", role: "group", "aria-label": "Queries over time" }, this.play, this.slider, this.told, this.live, this.period);
    const date = (id, text) => h("label", { class: "field" }, h("span", {}, text), h("input", { type: "datetime-local", id, onChange: () => this.#between() }));
    this.dates = h("details", { class: "place-dates" }, h("summary", {}, "Another period"), date("place-since", "From"), date("place-until", "To"));
    this.section = h("section", { class: "card paths-section", "aria-labelledby": "place-robots" },
      h("h2", { id: "place-robots" }, "Robots"), this.none, this.list, this.dates);
  }

  /** Read the records of the period. */
  async load() {
    const { since, until } = this, params = { map: this.map, since, until, limit: PAGE };
    const { items, cursor } = await list("queries", { params, signal: this.signal, most: since || until ? MOST : LATEST });
    this.#records = items.reverse();
    this.#more = cursor !== null;
    this.draw();
  }

  /** A query was answered: read what is new. */
  heard() { if (this.until === null) this.#later(); }

  async #newest() {
    const page = await get("queries", { params: { map: this.map, limit: 100 }, signal: this.signal });
    const known = new Set(this.#records.map((one) => one.query_id));
    this.#records.push(...page.items.reverse().filter((one) => !known.has(one.query_id)));
    this.#records.sort((a, b) => Date.parse(a.at) - Date.parse(b.at)); // a robot may send old ones later
    this.#records = this.#records.slice(-MOST);
    this.draw();
  }

  /** How many records are shown: those up to the time that was chosen. */
  get #shown() {
    if (this.at === null) return this.#records.length;
    const then = Date.parse(this.at);
    const later = this.#records.findIndex((one) => Date.parse(one.at) > then);
    return later < 0 ? this.#records.length : Math.max(later, 1);
  }

  /** Draw it as the picture is now. */
  draw() {
    const shown = this.#shown, all = this.#records.length;
    /** @type {any[]} */
    const robots = robotsOf(this.#records.slice(0, shown)).slice(0, MOST_ROBOTS);
    this.#controls(shown, all);
    this.none.hidden = robots.length > 0;
    put(this.none, this.since || this.until ? "No queries in this period." : "No robot has queried this map yet: the position of each will show here.");
    const held = this.list.contains(document.activeElement) ? document.activeElement?.getAttribute("aria-label") : null;
    const tokens = robotTokens(robotsOf(this.#records).map((one) => one.name)); // those of all times: none changes its colour
    for (const one of robots) one.token = tokens.get(one.name);
    put(this.list, robots.map((one) => this.#row(one)));
    if (held) /** @type {HTMLElement | null} */ (this.list.querySelector(`[aria-label="${CSS.escape(held)}"]`))?.focus();
    this.#marks(robots);
  }

  #controls(shown, all) {
    this.bar.hidden = all === 0 && !this.since && !this.until;
    this.slider.max = String(Math.max(all, 1));
    this.slider.value = String(Math.max(shown, 1));
    this.slider.disabled = this.play.disabled = all < 2;
    const record = this.#records[shown - 1];
    const text = record ? `${exact(record.at)}, query ${count(shown)} of ${count(all)}${this.#more ? " (the newest)" : ""}` : "No queries";
    this.slider.setAttribute("aria-valuetext", text);
    put(this.told, text);
    put(this.play, this.#player === null ? "Play" : "Pause");
    this.live.hidden = this.at === null;
    const chosen = this.since || this.until ? `${this.since ? exact(this.since) : "…"} to ${this.until ? exact(this.until) : "now"}` : null;
    if (chosen === this.#period) return; // an open list must not close
    this.#period = chosen;
    put(this.period, [...PERIODS, ...(chosen ? [["chosen", chosen]] : [])]
      .map(([value, name]) => h("option", { value, selected: value === (chosen ? "chosen" : "") }, name)));
  }

  #row({ name, token, last, found, lost }) {
    const [kind, word] = STATUSES[last.status] ?? ["neutral", last.status];
    const failures = lost.slice(-MOST_FAILURES).reverse();
    return h("li", { dataset: { robot: name } },
      h("div", { class: "paths-row" }, h("span", { class: "place-robot", style: { "--robot": `var(${token})` } }), h("strong", { class: "paths-name" }, name), h("span", { class: "badge", dataset: { kind } }, word)),
      h("span", { class: "muted" }, time(last.at), found && found !== last && [", found ", time(found.at)]),
      h("span", { class: "muted number" }, where(found)),
      LOST.includes(last.status) && h("p", {}, coded(sentence(last.reason))),
      failures.length > 0 && h("ul", { class: "place-failures", "aria-label": `Failures of ${name}` }, failures.map(({ record }) =>
        h("li", {}, h("a", { href: linkOf(record, this.map) }, STATUSES[record.status][1], ", ", time(record.at))))),
      lost.length > failures.length && h("a", { href: link("maps", this.map, "queries", { robot: last.robot, status: "lost" }) }, `All its ${count(lost.length)} failures`),
      h("div", { class: "toolbar" },
        found && this.runs.names.includes(found.pose.parent_frame) && h("button", { class: "button quiet", type: "button", "aria-label": `Follow ${name}`, "aria-pressed": this.#followed === name, onClick: () => this.#follow(name) }, "Follow"),
        h("a", { class: "button quiet", href: linkOf(last, this.map), "aria-label": `Last query of ${name}` }, "Last query")));
  }

  // where it was, in the frame of the picture; null where that is not drawn
  #pose({ pose }) {
    const matrix = pose && this.runs.reached(pose.parent_frame);
    if (!matrix) return null;
    const { translation: t, rotation: q } = pose;
    return multiply(matrix, ofQuaternion([q.x, q.y, q.z, q.w], [t.x, t.y, t.z]));
  }

  // look at a robot, and after it with each answer; once more: no longer
  #follow(name) {
    this.#followed = this.#followed === name ? null : name;
    this.#near = null;
    this.draw();
  }

  #look(found) {
    const { parent_frame: parent } = found.pose, pose = this.#pose(found);
    if (pose === null) { if (this.runs.names.includes(parent)) this.runs.show(parent); return; } // which draws this again
    this.scene.approach(pose, this.#near !== this.runs.parent);
    this.#near = this.runs.parent;
  }

  #marks(robots) {
    if (!this.scene.viewer) return;
    const { camera } = this.runs, drawn = [], marks = [];
    for (const one of robots) {
      const pose = one.found && this.#pose(one.found);
      if (pose) {
        const trail = [...one.trail.slice(-TRAIL), one.found].map((record) => this.#pose(record)).filter((p) => p !== null);
        drawn.push({ pose, token: one.token, camera: one.found.kind === "cloud" ? null : camera, trail });
        marks.push({ at: placeOf(pose), node: h("a", { class: "paths-label", tabindex: -1, dataset: { kind: "robot" }, style: { "--robot": `var(${one.token})` }, href: linkOf(one.found, this.map) }, one.name) });
      }
    }
    const lost = robots.flatMap((one) => one.lost.map((each) => ({ ...each, name: one.name }))).filter((one) => one.near && this.#pose(one.near));
    for (const { record, near, name } of lost.slice(-MOST_MARKS)) {
      const [kind, word] = STATUSES[record.status];
      marks.push({ at: placeOf(/** @type {number[]} */ (this.#pose(near))), node: h("a", {
        class: "paths-label", tabindex: -1, dataset: { kind: "lost", status: kind }, href: linkOf(record, this.map),
        title: `${name}: ${word.toLowerCase()}, ${exact(record.at)}`,
      }, record.status === "ambiguous" ? "?" : "!") });
    }
    this.scene.sensors("robots", drawn);
    this.scene.mark("robots", marks);
    const followed = robots.find((one) => one.name === this.#followed)?.found;
    if (followed) this.#look(followed);
  }

  #go(shown) {
    this.at = shown >= this.#records.length ? null : this.#records[shown - 1].at;
    this.draw();
  }

  #toggle() {
    // a browser bears few changes of an address at a time: it follows at the end
    const end = () => { this.stop(); this.draw(); this.onchange(); };
    if (this.#player !== null) { end(); return; }
    const all = this.#records.length, pace = Math.min(Math.max(REPLAY_MS / all, FASTEST_MS), SLOWEST_MS);
    const step = Math.max(Math.ceil((all * FASTEST_MS) / REPLAY_MS), 1);
    let shown = this.#shown >= all ? 1 : this.#shown;
    const turn = () => {
      this.#go(Math.min(shown, all));
      if (shown >= all || this.signal.aborted) { end(); return; }
      shown += step;
      this.#player = setTimeout(turn, pace);
    };
    this.#player = setTimeout(turn, 0);
    this.draw();
  }

  /** End a replay. */
  stop() {
    clearTimeout(this.#player);
    this.#player = null;
  }

  async #choose(hours) {
    if (hours === "chosen") return;
    await this.#read(hours ? new Date(Date.now() - Number(hours) * HOUR_MS).toISOString() : null, null);
  }

  async #between() {
    const [since, until] = [...this.dates.querySelectorAll("input")].map((one) => (one.value ? new Date(one.value).toISOString() : null));
    await this.#read(since, until);
  }

  async #read(since, until) {
    this.stop();
    [this.since, this.until, this.at] = [since, until, null];
    await this.load();
    this.onchange();
  }
}

/** Its answer while that is stored, and else its record among the queries of the map. */
function linkOf({ query_id: id, stored, at, robot }, map) {
  if (stored) return link("queries", id);
  const since = new Date(Date.parse(at)).toISOString(), end = new Date(Date.parse(at) + 1000).toISOString();
  return link("maps", map, "queries", { robot, since, until: end });
}

function where(found) {
  if (!found) return "No known position";
  const { x, y, z } = found.pose.translation;
  return `${[x, y, z].map((v) => v.toFixed(2)).join(", ")} m in ${found.pose.parent_frame}`;
}

function exact(iso) {
  return new Date(iso).toISOString().slice(0, 19).replace("T", " ");
}
