// All that the API tells of a frame, arranged for people.
import { h } from "../lib/dom.js";
import { bytes, count, seconds, time } from "../lib/format.js";
import { coded } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { badge, sentence } from "./badge.js";

/**
 * Cards about a frame: what became of it, who took it, its sensor, its poses.
 * @param {Object<string, any>} frame
 * @param {Object<string, any> | null} job that made it; null where it may not be seen, or is gone
 * @param {{edit?: () => void}} actions edit: null where the key may not
 */
export function about(frame, job, { edit }) {
  const who = [
    ["Robot", frame.robot], ["Session", frame.session],
    ["Tags", frame.tags.length ? h("span", { class: "chips" }, frame.tags.map((one) => h("span", { class: "chip" }, one))) : null],
    ["Taken", frame.captured_at && exact(frame.captured_at)],
    ["Name", frame.name && mono(frame.name)],
    ["Place in session", frame.sequence === null ? null : count(frame.sequence)],
  ];
  return [
    card("State", null, list([
      ["State", h("span", {}, badge(frame.state), h("span", { class: "muted" }, ` ${sentence(frame.state)}`))],
      frame.reason && ["Reason", coded(frame.reason)],
      ["Received", exact(frame.received_at)],
      frame.indexed_at && ["Indexed", exact(frame.indexed_at)],
      ["Job", jobOf(frame, job)],
      job?.error && job.error !== frame.reason && ["Error", coded(job.error)],
    ])),
    card("Source", edit && h("button", { class: "button", type: "button", id: "edit", onClick: edit }, "Edit"), list(who)),
    card("Sensor", null, list(frame.kind === "cloud" ? ofCloud(frame) : ofDepth(frame))),
    card("Pose", null, frame.pose ? transform(frame.pose) : h("p", { class: "muted" }, "No pose was sent, so answers cannot place this frame in the map."),
      frame.T_base_sensor && [h("h3", {}, "Mounting"), transform(frame.T_base_sensor)],
      frame.up && list([["Up", [frame.up.x, frame.up.y, frame.up.z].map((x) => x.toFixed(4)).join(", ")]])),
    card("Identity", null, list([
      ["Frame", mono(frame.frame_id)], ["Content", frame.content_id && mono(frame.content_id)],
      ["Upload", bytes(frame.bytes)], ["Note", frame.note],
    ]), h("details", {}, h("summary", {}, "JSON of the API"), h("pre", { class: "mono raw", tabindex: "0" }, JSON.stringify(frame, null, 2)))),
  ];
}

function card(title, action, ...children) {
  return h("section", { class: "card about", "aria-label": title }, h("div", { class: "card-head" }, h("h2", {}, title), action), children);
}

function list(entries) {
  return h("dl", { class: "facts" }, entries.filter(Boolean).map(([name, value]) =>
    [h("dt", {}, name), h("dd", {}, value ?? h("span", { class: "muted" }, "none"))]));
}

function mono(text) {
  return h("span", { class: "mono" }, text);
}

function exact(iso) {
  return h("span", {}, time(iso), h("span", { class: "muted" }, ` · ${new Date(iso).toISOString().replace("T", " ").slice(0, 19)} UTC`));
}

function jobOf(frame, job) {
  const name = h("a", { href: link("operations", "jobs", frame.job_id), class: "mono" }, frame.job_id.slice(0, 8));
  if (!job) return name;
  const took = job.started_at && job.finished_at ? (Date.parse(job.finished_at) - Date.parse(job.started_at)) / 1000 : null;
  return h("span", {}, name, " ", badge(job.state),
    h("span", { class: "muted" }, took !== null && ` in ${seconds(took)}`, job.attempts > 1 && `, ${count(job.attempts)} tries`));
}

/** @param {Object<string, any>} frame */
function ofDepth({ intrinsics: lens, depth_scale: scale, depth_along_ray: ray }) {
  return [
    ["Kind", "Depth image"],
    lens && ["Size", `${lens.width} × ${lens.height} px`],
    lens && ["Focal length", `${number(lens.fx)}, ${number(lens.fy)} px`],
    lens && ["Centre", `${number(lens.cx)}, ${number(lens.cy)} px`],
    lens && ["Distortion", lens.distortion.length ? lens.distortion.map(number).join(", ") : null],
    ["Depth scale", `${number(scale)} per metre`],
    ["Samples", ray ? "ranges along the ray" : "depth along z"],
  ];
}

function ofCloud(frame) {
  const seen = frame.viewpoint;
  return [
    ["Kind", "Point cloud"], ["Points", count(frame.points)],
    ["Viewpoint", seen ? `${number(seen.x)}, ${number(seen.y)}, ${number(seen.z)} m` : null],
    ["Units", `${number(frame.units_per_metre)} per metre`],
  ];
}

function number(value) {
  return String(Number(value.toPrecision(8)));
}

/** A transform: which frames, translation and rotation, and the matrix folded. */
function transform({ parent_frame, child_frame, translation: t, rotation: q, matrix }) {
  const fixed = (values, digits) => values.map((x) => x.toFixed(digits)).join(", ");
  return h("div", { class: "transform" },
    h("p", {}, mono(parent_frame), " ← ", mono(child_frame)),
    list([["Translation", `${fixed([t.x, t.y, t.z], 3)} m`], ["Rotation x y z w", fixed([q.x, q.y, q.z, q.w], 4)]]),
    h("details", {}, h("summary", {}, "Matrix"),
      h("table", { class: "table matrix", "aria-label": `Matrix, ${parent_frame} from ${child_frame}` },
        h("tbody", {}, matrix.map((row) => h("tr", {}, row.map((x) => h("td", { class: "number mono" }, x.toFixed(4)))))))));
}
