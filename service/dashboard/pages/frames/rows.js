// The files of a queue as rows: how far each one is, and why it was refused in the API's words.
import { h, put, throttle } from "../lib/dom.js";
import { bytes, count, percent, seconds, shortId, things } from "../lib/format.js";
import { coded } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { badge, isPending } from "./badge.js";
import { measuredPlan, outlineOf } from "./recording.js";
import { viewSwitch } from "./views.js";

const GROUPS = [["all", "All"], ["ready", "Ready"], ["way", "In progress"], ["done", "Done"], ["refused", "Refused"]];
const IN_GROUP = {
  ready: "ready", waiting: "way", sending: "way", received: "way", signing: "way", importing: "way",
  queued: "way", running: "way", indexed: "done", redundant: "done", imported: "done",
};
// as many rows as anybody reads; more are a click away, and 5,000 files cost no more than 100
const STEP = 100;
const KIND = { depth: "Depth image", cloud: "Point cloud", archive: "Archive", map: "Whole map", recording: "ROS recording" };
const PHASES = { read: "Reading the file", choose: "Choosing viewpoints", render: "Rendering views", sign: "Signing views", test: "Looking up other views" };

/** Which of the groups an item is in. @param {string} state */
export function groupOf(state) {
  return IN_GROUP[state] ?? "refused";
}

/**
 * The list of a queue; `update(item)` after one has changed, `update(null)` after many have.
 * @param {import("./queue.js").Queue} queue @param {AbortSignal} signal
 * @returns {HTMLElement & {update: (item: Object<string, any> | null) => void}}
 */
export function rowsOf(queue, signal) {
  let group = "all";
  let most = STEP;
  let all = false; // many have changed
  const rows = new Map();
  const dirty = new Set();
  const list = h("ul", { class: "rows" });
  const more = h("button", { class: "button", type: "button", onClick: () => { most += STEP; draw(); } });
  const choose = viewSwitch(group, (one) => { group = one; most = STEP; draw(); }, GROUPS, "Show");
  const element = Object.assign(h("section", { class: "rows-place", "aria-label": "Files" }, choose, list, more), { update });

  function draw() {
    const counts = Object.fromEntries(GROUPS.map(([name]) => [name, 0]));
    counts.all = queue.items.length;
    for (const item of queue.items) counts[groupOf(item.state)] += 1;
    for (const button of choose.querySelectorAll("button")) {
      const value = button.dataset.value ?? "";
      const text = GROUPS.find(([name]) => name === value)?.[1];
      put(button, text, h("span", { class: "number muted" }, ` ${count(counts[value])}`));
    }
    const wanted = queue.items.filter((one) => group === "all" || groupOf(one.state) === group);
    const shown = wanted.slice(0, most);
    const ids = new Set(shown.map((one) => one.id));
    const had = list.contains(document.activeElement);
    for (const [id, row] of rows) if (!ids.has(id)) { row.remove(); rows.delete(id); }
    shown.forEach((item, i) => {
      let row = rows.get(item.id);
      if (!row) { row = rowOf(queue, item, signal); rows.set(item.id, row); } else if (all || dirty.has(item)) row.show();
      if (list.children[i] !== row) list.insertBefore(row, list.children[i] ?? null);
    });
    dirty.clear();
    all = false;
    more.hidden = wanted.length <= most;
    put(more, `Show ${count(Math.min(STEP, wanted.length - most))} more of ${count(wanted.length - most)}`);
    element.hidden = queue.items.length === 0;
    if (had && !list.contains(document.activeElement)) /** @type {HTMLElement} */ (list.querySelector(".row-action button") ?? choose.firstElementChild).focus({ preventScroll: true });
  }

  // a transfer tells of itself many times a second, and several are under way
  function update(item) {
    if (item) dirty.add(item); else all = true;
    drawSoon();
  }
  const drawSoon = throttle(draw, 80, signal);
  draw();
  return element;
}

function rowOf(queue, item, signal) {
  const state = h("div", { class: "row-state" });
  const more = h("div", { class: "row-more" });
  const action = h("div", { class: "row-action" });
  const about = h("div", { class: "row-about muted" }, aboutOf(item));
  const row = Object.assign(h("li", { class: "row", dataset: { name: item.file.name } },
    h("div", { class: "row-name" }, h("span", { title: item.path }, item.file.name), about), state, action, more), { show });
  /** @type {string | null} */
  let drawn = null;
  /** @type {any} what was drawn of a recording */
  let found = null;
  function show() {
    if (item.state === "sending" && drawn === "sending") { /** @type {HTMLProgressElement} */ (row.querySelector("progress")).value = item.share; return; }
    put(about, aboutOf(item)); // a cloud may have been marked as a map
    if (item.state === drawn && item.state !== "importing" && item.state !== "waiting" && item.step === undefined) return;
    drawn = item.state;
    row.dataset.state = item.state;
    put(state, stateOf(item));
    const had = action.contains(document.activeElement);
    put(action, actionOf(queue, item));
    if (had) /** @type {HTMLElement | null} */ (action.querySelector("button, a"))?.focus();
    // a plan is drawn once, and what is read or pressed is not drawn anew while a job goes on
    const now = item.coverage ?? item.job?.progress?.recording?.span;
    if (item.state === "importing" ? now && now === found : item.coverage && now === found) return;
    found = now;
    put(more, reasonOf(item, queue, signal));
    if (item.state === "waiting" && item.until) setTimeout(() => { if (item.state === "waiting") put(more, reasonOf(item, queue, signal)); }, 1000);
  }
  show();
  return row;
}

function aboutOf(item) {
  const said = [KIND[item.isMap ? "map" : item.source.kind], bytes(item.file.size)];
  if (item.source.width) said.push(`${item.source.width} × ${item.source.height}`);
  if (Object.keys(item.said).length) said.push(item.source.kind === "cloud" ? "clouds.json" : "intrinsics.json");
  if (item.pose) said.push("pose");
  return said.join(" · ");
}

function stateOf(item) {
  const { state, share } = item;
  if (state === "ready") return h("span", { class: "muted" }, "Ready");
  if (state === "waiting") return h("span", { class: "badge", dataset: { kind: "neutral" } }, "in the queue");
  if (state === "sending") return h("progress", { max: 1, value: share, "aria-label": `${item.file.name}, sent` });
  if (state === "refused") return h("span", { class: "badge", dataset: { kind: "bad" } }, "refused");
  if (state === "cancelled") return badge("cancelled");
  if (state === "importing") {
    const { done, total, phase } = item.job.progress ?? {};
    const words = PHASES[phase] ? PHASES[phase] : total ? `${count(done)} of ${count(total)} frames` : item.source.kind === "recording" && item.job.state === "running" ? "Reading the recording" : "Waiting for a worker";
    return [h("progress", { max: 1, value: total ? done / total : null, "aria-label": `${item.file.name}, imported` }),
      h("span", { class: "muted number" }, words)];
  }
  if (item.step) return h("span", { class: "muted number", role: "status" }, item.step);
  if (state === "imported") return h("span", { class: "badge", dataset: { kind: "good" } }, "imported");
  return badge(state);
}

function actionOf(queue, item) {
  const name = item.file.name;
  const button = (text, told) => h("button", { class: "button quiet", type: "button", "aria-label": `${text} ${name}`, onClick: told }, text);
  const group = groupOf(item.state);
  if (item.state === "ready") return [wholeOf(queue, item), button("Remove", () => queue.remove([item]))];
  if (["waiting", "sending", "importing"].includes(item.state)) return button("Cancel", () => queue.cancel(item));
  if (item.frame_id) return h("a", { class: "mono", href: link("maps", queue.map, "frames", item.frame_id) }, shortId(item.frame_id));
  if (group === "refused" && !item.job) return button("Retry", () => queue.again([item]));
  return item.job ? h("a", { href: link("operations", "jobs", item.job.job_id) }, "Job") : null;
}

/** Whether a cloud is one scan or a whole map: nothing in the file tells. */
function wholeOf(queue, item) {
  return item.source.kind === "cloud" && h("label", { class: "source-check row-whole" },
    h("input", { type: "checkbox", checked: item.isMap, onChange: (event) => queue.change(item, { isMap: event.target.checked }) }),
    h("span", {}, "Whole map"));
}

function reasonOf(item, queue, signal) {
  const { problem, state, coverage } = item;
  const recording = item.job?.progress?.recording;
  const choose = (topic) => { Object.assign(item, { topic, job: null }); queue.again([item]); };
  const outline = recording && outlineOf(recording, state === "failed" ? choose : null);
  if (state === "imported") {
    return [item.isMap ? [mapOf(item), h("p", {}, h("a", { href: link("maps", queue.map, "place") }, "See its plan"))] : importOf(item), coverage && measuredPlan(queue.map, coverage, signal),
      coverage ? h("details", {}, h("summary", {}, "Topics and findings"), outline) : outline];
  }
  if (outline) return [item.reason && h("p", {}, coded(item.reason)), outline];
  if (problem) {
    const rest = Math.max(0, (item.until - Date.now()) / 1000);
    return [
      state === "waiting" && h("p", {}, `Again ${rest > 0.5 ? `in ${seconds(rest)}` : "now"}: `),
      h("p", {}, problem.status ? h("strong", {}, `${problem.title}. `) : null, coded(problem.detail ?? problem.message)),
      (problem.errors ?? []).length > 0 && h("ul", {}, problem.errors.map((one) => h("li", {}, coded(one.field ? `${one.field}: ${one.reason}` : one.reason)))),
    ];
  }
  if (item.isThere && !isPending(state)) return h("p", {}, "The map already has this frame.", item.reason && coded(` ${item.reason}`));
  return item.reason && h("p", {}, coded(item.reason));
}

function importOf(item) {
  const { received = 0, there = 0, refused = 0, ignored = 0 } = item.job.result ?? {};
  const parts = [`${count(received)} imported`, there && `${count(there)} already there`, refused && `${count(refused)} refused`,
    ignored && `${things(ignored, "file")} skipped`].filter(Boolean);
  const faults = item.refused ?? [];
  return [
    h("p", {}, `Frames: ${parts.join(", ")}.`),
    item.job.result?.summary && h("p", {}, coded(item.job.result.summary.text)),
    faults.length > 0 && h("details", {}, h("summary", {}, `Rejected files${faults.length < refused ? ", the first of them" : ""}`),
      h("ul", {}, faults.slice(0, STEP).map((one) => h("li", {}, h("strong", {}, one.name), coded(` ${one.problem.detail}`))))),
  ];
}

/** Result of the import of a whole map, in sentences. */
function mapOf(item) {
  const result = item.job.result ?? {};
  const weak = result.weak ?? [];
  const at = ({ x, y, z }) => [x, y, z].map((value) => value.toFixed(1)).join(", ");
  return [
    h("p", {}, `${count(result.views)} views are in the map and see ${percent(result.seen)} of its surface.`,
      result.refused > 0 && ` ${count(result.refused)} were refused.`),
    result.coverage !== null && h("p", {}, h("strong", {}, `Of ${count(result.tested)} other views of this file, ${percent(result.coverage)} are found in the map. `),
      `${count(result.found)} were found, ${count(result.ambiguous)} ambiguous, ${count(result.not_found)} not found, ${count(result.wrong)} wrong. Real frames are found less often: try some.`),
    h("p", {}, `Units: ${result.units_per_metre} per metre (${result.units_from}). Up: ${at(result.up)} (${result.up_from}).`),
    Object.values(result.offset ?? {}).some((value) => value !== 0) && h("p", {}, `Offset: ${Object.values(result.offset).join(",")} m. Add it to a pose for the coordinates of the file.`),
    (result.notes ?? []).map((note) => h("p", {}, note)),
    weak.length > 0 && h("details", {}, h("summary", {}, "Weak here"),
      h("ul", {}, weak.map((area) => h("li", {}, `${at(area.centre)} m, ${area.width_m} m wide: ${count(area.found)} of ${count(area.views)} found`)))),
  ];
}
