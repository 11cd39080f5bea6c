// Jobs as rows: what each is about, how it went, its traceback folded, and trying it again.
import { badge } from "../frames/badge.js";
import { at, send } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { count, ms, seconds, shortId, time } from "../lib/format.js";
import { coded } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { may } from "../lib/session.js";
import { confirm, toast } from "../lib/states.js";

const GIVEN_UP = new Set(["dead", "cancelled", "failed"]);

/** Whether to try again: given up, by nobody tried since, and not as its frame cannot be used. */
export function canRetry(job) {
  const isRejected = job.state === "failed" && job.frame_id;
  return GIVEN_UP.has(job.state) && !isRejected && !job.followed_by && may("write", job.map ?? undefined);
}

/** Seconds that the latest try took, or takes so far; null where it has not begun. */
export function took(job) {
  if (!job.started_at) return null;
  const end = job.finished_at ? Date.parse(job.finished_at) : Date.now();
  return Math.max(end - Date.parse(job.started_at), 0) / 1000;
}

/** A span, also a short one. @param {number} s */
export function span(s) {
  return s < 1 ? ms(1000 * s) : seconds(s);
}

/** A job as a row of a list. @param {(job: Object<string, any>) => void} changed after a retry or a cancel, with the new job */
export function jobRow(job, changed) {
  const about = [
    job.map && h("a", { href: link("maps", job.map), dataset: { part: "map" } }, job.map),
    job.frame_id && [" / ", h("a", { class: "mono", href: link("maps", job.map, "frames", job.frame_id), title: job.frame_id, dataset: { part: "frame" } }, shortId(job.frame_id))],
  ];
  const facts = [
    job.attempts > 1 && `${count(job.attempts)} attempts`,
    job.finished_at && ["ended ", time(job.finished_at)],
    !job.finished_at && ["came ", time(job.created_at)],
    job.finished_at && took(job) !== null && `took ${span(took(job) ?? 0)}`,
  ].filter(Boolean).flatMap((one, i) => (i ? [" · ", one] : one));
  return h("li", { class: "job", dataset: { job: job.job_id } },
    h("div", { class: "job-line" }, badge(job.state),
      h("a", { class: "job-kind", href: link("operations", "jobs", job.job_id), dataset: { part: "job" }, "aria-label": `${job.kind}, job ${shortId(job.job_id)}` }, job.kind),
      h("span", { class: "job-about" }, about),
      h("span", { class: "job-facts muted" }, facts),
      h("span", { class: "job-actions" }, actions(job, changed))),
    job.progress && !job.finished_at && progress(job.progress),
    job.error && h("p", { class: "job-error" }, coded(job.error)),
    traceback(job));
}

/** The traceback, folded. @param {boolean} [open] */
export function traceback(job, open = false) {
  return job.traceback && h("details", { open }, h("summary", { dataset: { part: "traceback" } }, "Traceback of the last attempt"),
    h("pre", { class: "traceback", tabindex: "0", role: "region", "aria-label": "Traceback" }, job.traceback));
}

/** How far a long job is. */
export function progress({ done, total }) {
  return h("div", { class: "job-progress" },
    h("progress", { "aria-label": "Progress", max: total ?? null, value: total === null ? null : done }),
    h("span", { class: "muted number" }, total === null ? count(done) : `${count(done)} of ${count(total)}`));
}

/** Buttons of a job, by its state and what the key may. @param {(job: Object<string, any>) => void} changed */
export function actions(job, changed) {
  if (job.followed_by) return h("a", { href: link("operations", "jobs", job.followed_by), dataset: { part: "next" } }, "retried");
  const press = (what, told) => async (event) => {
    event.target.disabled = true;
    try {
      const { data } = await send("POST", at("jobs", job.job_id, what));
      toast(told);
      changed(data);
    } catch (error) {
      event.target.disabled = false;
      throw error;
    }
  };
  if (canRetry(job)) return h("button", { class: "button", type: "button", dataset: { part: "act" }, onClick: press("retry", "Queued again") }, "Retry");
  const over = job.state !== "queued" && job.state !== "running";
  if (over || !may("write", job.map ?? undefined)) return null;
  return h("button", { class: "button quiet", type: "button", dataset: { part: "act" }, onClick: press("cancel", "Cancelled") }, "Cancel");
}

/**
 * Try again all dead jobs of a map or of all, after asking.
 * @param {string | null} map @param {AbortSignal} signal @param {(text: string) => void} tell how far it is
 */
export async function retryAll(map, signal, tell) {
  const text = h("p", {}, `All dead jobs${map ? ` of map ${map}` : ""} will be queued again with a fresh number of attempts. They may fail again for the same reason.`);
  if (!(await confirm({ title: "Retry all dead jobs", text, action: "Retry all" }))) return;
  let [done, refused] = [0, 0];
  /** @type {string | null} */
  let cursor = null;
  do {
    const { data } = await send("POST", "jobs/retry", { params: { map, cursor }, signal });
    done += data.retried.length;
    refused += data.refused.length;
    cursor = data.next_cursor;
    tell(`Queued ${count(done)}…`);
  } while (cursor);
  tell(`${count(done)} queued again${refused ? `, ${count(refused)} could not be` : ""}.`);
}

/** A status line that tells what `retryAll` does, and its button. */
export function retryAllButton(map, signal, changed) {
  const status = h("span", { class: "muted", role: "status" });
  const button = h("button", { class: "button", type: "button", onClick: async () => {
    button.disabled = true;
    try {
      await retryAll(map, signal, (text) => put(status, text));
    } finally {
      button.disabled = false;
      changed();
    }
  } }, "Retry all dead");
  return [status, button];
}
