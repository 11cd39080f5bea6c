// The state of all maps in one sentence, and where to see what is wrong.
import { things } from "../lib/format.js";
import { link } from "../lib/router.js";

const DAY_MS = 86_400_000; // a job that failed before is no news

/** Whether a failed job is news. If no frame of a recording can be used, the page of its upload says why. */
export function isNews(job) {
  return !job.frame_id && !job.followed_by && !job.progress?.recording?.problem && Date.now() - Date.parse(job.finished_at) < DAY_MS;
}

/** Frames of a map that wait for a worker, or are being signed. */
export function waiting(map) {
  return (map.frames.received ?? 0) + (map.frames.signing ?? 0) + (map.reencoding?.left ?? 0);
}

/**
 * @param {Object<string, any>[]} jobs that failed, other than those that sign frames
 * @returns {{kind: "good" | "bad" | "neutral", text: string, href: string | null}} href: of what failed
 */
export function conditionOf(maps, jobs) {
  const failed = maps.filter((one) => lost(one) > 0), frames = failed.reduce((n, one) => n + lost(one), 0);
  const left = maps.reduce((n, one) => n + waiting(one), 0);
  const queue = left === 0 ? "nothing waits" : `${some(left, "frame").toLowerCase()} ${left === 1 ? "waits" : "wait"}`;
  if (frames > 0) {
    const [{ name }] = failed, many = failed.length > 1;
    return { kind: "bad", text: `${some(frames, "frame")} of ${many ? `${failed.length} maps` : `\`${name}\``} failed permanently; ${queue}.`,
      href: many ? link("operations", { tab: "jobs", state: "dead" }) : link("maps", name, { state: "failed" }) };
  }
  if (jobs.length > 0) {
    const [{ kind, map, job_id: id }] = jobs, many = jobs.length > 1;
    return { kind: "bad", text: many ? `${some(jobs.length, "job")} failed; ${queue}.` : `The \`${kind}\` job${map === null ? "" : ` of \`${map}\``} failed; ${queue}.`,
      href: many ? link("operations", { tab: "jobs", state: "dead" }) : link("operations", "jobs", id) };
  }
  if (left > 0) return { kind: "neutral", text: `${some(left, "frame")} ${left === 1 ? "waits" : "wait"} for a signature; no job failed.`, href: null };
  return { kind: "good", text: "Everything is signed; no job failed.", href: null };
}

/** Frames of a map that have no signature for good. */
function lost(map) {
  return (map.frames.failed ?? 0) + (map.reencoding?.dead ?? 0);
}

const some = (n, name) => (n === 1 ? `One ${name}` : things(n, name));
