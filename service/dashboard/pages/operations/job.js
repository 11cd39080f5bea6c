// One job: what it is about, how far it is, what broke it, and trying it again.
import { badge } from "../frames/badge.js";
import { at, get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { count, shortId, time } from "../lib/format.js";
import { coded } from "../lib/prose.js";
import { go, link } from "../lib/router.js";
import { actions, progress, span, took, traceback } from "./joblist.js";
import { poll } from "./poll.js";

export const styles = ["operations/operations.css"];

const POLL_S = 2;
const SENTENCES = {
  queued: "Waiting for a worker, for the first attempt or a retry.",
  running: "A worker is running it.",
  succeeded: "Done, and its result is stored.",
  failed: "Its input cannot be used.",
  cancelled: "Cancelled on request, for example by deleting its frame.",
  dead: "Failed too many times.",
};

/** See lib/router.js. */
export async function render(root, { params, signal, title, actions: head }) {
  const said = h("span", { class: "visually-hidden", role: "status" });
  const body = h("div", { class: "page" });
  const place = at("jobs", params.job);
  /** @type {string | null} */
  let shown = null;
  /** @type {string | null} */
  let state = null;
  let ask = () => {};

  async function look() {
    const job = await get(place, { signal });
    const text = JSON.stringify(job);
    if (text === shown) return;
    shown = text;
    if (state !== null && state !== job.state) put(said, `The job is ${job.state}`);
    state = job.state;
    head(actions(job, (next) => { if (next.job_id === job.job_id) ask(); else go(link("operations", "jobs", next.job_id)); }));
    const open = body.querySelector("details")?.open ?? true;
    put(body, describe(job, open));
  }

  title(`Job ${shortId(params.job)}`);
  ask = await poll(look, POLL_S, signal);
  put(root, said, body);
}

function describe(job, open) {
  const facts = [
    ["Kind", job.kind],
    ["Map", job.map && h("a", { href: link("maps", job.map) }, job.map)],
    ["Frame", job.frame_id && h("a", { class: "mono", href: link("maps", job.map, "frames", job.frame_id) }, job.frame_id)],
    ["Id", h("span", { class: "mono" }, job.job_id)],
    ["Priority", String(job.priority)],
    ["Attempts", count(job.attempts)],
    ["Created", time(job.created_at)],
    ["Latest attempt", job.started_at && time(job.started_at)],
    ["Ended", job.finished_at && time(job.finished_at)],
    ["Duration", job.finished_at && took(job) !== null && span(took(job) ?? 0)],
    ["Retried by", job.followed_by && h("a", { class: "mono", href: link("operations", "jobs", job.followed_by) }, job.followed_by)],
  ];
  return [
    h("section", { class: "card", "aria-label": "State" },
      h("p", { class: "job-state" }, badge(job.state), " ", SENTENCES[job.state] ?? ""),
      job.progress && progress(job.progress),
      h("dl", { class: "facts" }, facts.filter(([, value]) => value).map(([name, value]) => h("div", {}, h("dt", {}, name), h("dd", {}, value))))),
    job.error && h("section", { class: "card", "aria-labelledby": "job-error" }, h("h2", { id: "job-error" }, "Error"),
      h("p", { class: "job-error" }, coded(job.error)), traceback(job, open)),
    job.result && h("section", { class: "card", "aria-labelledby": "job-result" }, h("h2", { id: "job-result" }, "Result"), result(job.result)),
  ];
}

/** What a long job came to: numbers and words as a list, all else as JSON. */
function result(found) {
  const plain = Object.entries(found).filter(([, value]) => typeof value !== "object" || value === null);
  const nested = Object.fromEntries(Object.entries(found).filter(([, value]) => typeof value === "object" && value !== null));
  return [
    h("dl", { class: "facts" }, plain.map(([name, value]) => h("div", {}, h("dt", {}, name.replaceAll("_", " ")),
      h("dd", { class: "number" }, typeof value === "number" && Number.isInteger(value) ? count(value) : String(value ?? "–"))))),
    Object.keys(nested).length > 0 && h("details", {}, h("summary", {}, "More"), h("pre", { class: "traceback", tabindex: "0", role: "region", "aria-label": "Result as JSON" }, JSON.stringify(nested, null, 2))),
  ];
}
