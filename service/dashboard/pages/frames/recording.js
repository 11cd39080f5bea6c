// ROS recordings: options of their import, what was found in them, and what the map is then worth.
import { at, get, send } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { count } from "../lib/format.js";
import { followJob, goesOn, repeat } from "../lib/products.js";
import { coded } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { flat } from "../plan/axes.js";
import { backdrops, cornersOf, drawBackdrop } from "../plan/backdrop.js";
import { placeOf } from "../paths/shapes.js";
import { Plan } from "../plan/plan.js";
import { countsCard } from "../coverage/panels.js";
import { drawCells } from "../coverage/sheet.js";
import { settingField, settingsForm } from "./source.js";

// as `sceneprint upload` names them; empty: as the service chooses
const OPTIONS = [
  ["topic", "Topic", "the only one"], ["camera_info", "Camera topic", "beside the images"], ["pose_frame", "Frame of poses", "map, odom or world"],
  ["sensor_frame", "Frame of the sensor", "that of the points"], ["depth_scale", "Depth units per metre", "1000"],
  ["keyframe_m", "Metres between frames", "0.3"], ["keyframe_deg", "or degrees", "15"], ["keyframe_s", "Seconds, without poses", "0.5"],
];

/** Fields of a form, which write into settings as they change. @param {any} given settings of source.js */
export function recordingFields(given) {
  return settingsForm(given, h("div", { class: "source-fields" }, h("details", {}, h("summary", {}, "ROS recordings"),
    h("div", { class: "source-row" }, OPTIONS.map(([name, label, placeholder]) => settingField(`bag_${name}`, label, { placeholder }))))));
}

/** Query parameters of the import of a recording. @param {Object<string, any>} given settings of source.js */
export function recordingParams(given) {
  const said = OPTIONS.map(([name]) => [name, (given[`bag_${name}`] ?? "").trim()]).filter(([, value]) => value !== "");
  return { as: "recording", ...Object.fromEntries(said) };
}

/**
 * The topics and findings of a recording; of several topics one can be chosen, and the file sent again with it.
 * @param {Object<string, any>} found RecordingOutline
 * @param {((topic: string) => void) | null} choose null: it is not asked for
 */
export function outlineOf(found, choose) {
  const rows = found.topics.map(({ name, type, count: n, use }) => h("tr", { dataset: { used: String(use.endsWith("used")) } },
    h("td", { class: "mono" }, name), h("td", { class: "muted" }, type.split("/").pop()), h("td", { class: "number" }, count(n)),
    h("td", {}, choose && use && use !== "camera"
      ? h("button", { class: "button", type: "button", "aria-label": `Import ${name}`, onClick: () => choose(name) }, `Import ${use}`) : use)));
  return [
    h("p", {}, `${found.kind}, ${found.span}. ${count(found.topics.length)} topics:`),
    h("div", { class: "row-topics" }, h("table", {}, h("thead", {}, h("tr", {}, ["Topic", "Type", "Messages", "Use"].map((text) => h("th", { scope: "col" }, text)))),
      h("tbody", {}, rows))),
    found.findings.length > 0 && h("ul", {}, found.findings.map((line) => h("li", {}, coded(line)))),
  ];
}

/**
 * Wait until the frames of an import are signed, measure coverage with them, and keep both in the item.
 * @param {string} map @param {Object<string, any>} item of a queue, whose `step` and `coverage` change; its `stop` ends it
 * @param {(changes: Object<string, any>) => void} change
 */
export async function measure(map, item, change) {
  const { signal } = item.stop, { finished_at: end, result: { summary } } = item.job;
  await repeat(async () => {
    for (const state of ["received", "signing"]) { // a frame has them in this order, so none is missed
      // robots may send others all the time: those that came after the import do not count
      const { items } = await get(at("maps", map, "frames"), { params: { state, received_before: end, limit: 1 }, signal });
      if (items.length === 0) continue;
      const { frames } = await get(at("maps", map), { signal });
      change({ step: `Frames of the map to sign: ${count((frames.received ?? 0) + (frames.signing ?? 0))}` });
      return false;
    }
    return true;
  }, signal);
  /** @type {Object<string, any>} */
  let now = {};
  if (summary.poses >= 2) {
    change({ step: "Measuring coverage" });
    await repeat(async () => {
      await send("POST", at("maps", map, "surface"), { signal }); // the plan is drawn on it
      now = (await send("POST", at("maps", map, "coverage"), { json: {}, signal })).data;
      return true;
    }, signal);
    if (signal.aborted) return;
    await followJob(at("maps", map, "coverage", now.job_id), (told) => {
      now = told ?? { state: "cancelled" };
      const { done = 0, total } = now.progress ?? {};
      if (goesOn(now) && total) change({ step: `Coverage: ${count(done)} of ${count(total)} frames` });
    }, signal);
  }
  change({ step: null, coverage: now.state === "succeeded" ? now : null });
}

/** A plan of the map with the cells of a coverage result, and the result in numbers.
 * @param {string} map @param {Object<string, any>} coverage @param {AbortSignal} signal */
export function measuredPlan(map, coverage, signal) {
  const place = h("div", { class: "row-plan" });
  fill(place, map, coverage, signal);
  const { found, frames } = coverage.result;
  return [place, countsCard(coverage.result),
    found < frames / 2 && h("p", {}, "Each frame is queried among frames taken at least 10 s before or after it. A single pass through a place has few of them: drive through it twice."),
    h("p", {}, h("a", { href: link("maps", map, "place") }, "Place"), " · ", h("a", { href: link("maps", map, "coverage", { result: coverage.job_id }) }, "Coverage, cell by cell"),
      " · ", h("a", { href: link("maps", map, "query") }, "Query"))];
}

async function fill(place, map, coverage, signal) {
  const planned = coverage.plans[0];
  const backdrop = planned && await backdrops(signal)(map, planned.parent_frame);
  if (!backdrop || signal.aborted) return;
  const plan = new Plan({ label: `Plan of ${map} with coverage`, signal }), wide = coverage.result.cell_m;
  const axes = { x: planned.x_axis, y: planned.y_axis };
  const corners = planned.cells.flatMap(({ column, row }) => [[column * wide, row * wide], [(column + 1) * wide, (row + 1) * wide]]);
  put(place, plan.element);
  drawCells(plan, planned.cells, wide, null);
  const runs = backdrop.runs.map((run) => ({ ...run, places: run.poses.map((m) => flat(axes, placeOf(m))) }));
  drawBackdrop(plan, { ...backdrop, axes, runs }, signal);
  plan.bounds(/** @type {any} */ ([...corners, ...cornersOf(backdrop.surface, /** @type {any} */ (corners))]));
}
