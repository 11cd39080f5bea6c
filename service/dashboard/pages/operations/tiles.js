// The figures of this moment, large: what waits, who works, what was refused, how full the disk is.
import { h } from "../lib/dom.js";
import { bytes, count, percent, seconds } from "../lib/format.js";
import { gauge } from "./machines.js";

const OLD_S = 300; // a frame that waits longer than this needs attention

/** Tiles for the whole service, or for one map where `whole` is false. @param {boolean} whole */
export function tiles(whole, stats) {
  const old = stats.oldest_waiting_s.sign ?? null;
  const shown = [
    tile("Waiting jobs", "waiting", count(stats.waiting), `${count(stats.jobs.running ?? 0)} running`),
    tile("Oldest frame not signed", "oldest", old === null ? "–" : seconds(old), old === null ? "up to date" : "since its upload", old > OLD_S ? "warn" : null),
    tile("Indexed frames", "indexed", count(stats.frames.indexed ?? 0), others(stats.frames)),
  ];
  // of which answer these figures are
  return h("section", { class: "tiles", "aria-label": "Now", dataset: { at: stats.at } }, shown, whole && ofService(stats));
}

/** @param {Object<string, any>} stats */
function ofService({ workers, total, bytes: { free, disk } }) {
  const busy = workers.filter((one) => one.job_id !== null).length, isIdle = workers.length === 0;
  const full = disk > 0 ? 1 - free / disk : null, bar = full === null ? null : gauge(full);
  return [
    tile("Workers", "workers", count(workers.length), isIdle ? "none running" : `${count(busy)} busy`, isIdle ? "bad" : null),
    tile("Requests, last hour", "requests", count(total.requests), [part(total.refused, "refused", "Requests that ask for what is not there or not allowed"),
      part(total.busy, "busy", "Requests that the service had no capacity for"), part(total.broken, "failed", "Requests that failed through an error of the service", "bad")]),
    tile("Disk", "disk", full === null ? "–" : `${percent(full)} full`, [`${bytes(free)} free of ${bytes(disk)}`, bar], bar?.dataset.kind),
  ];
}

/** @param {number} n @param {string} text @param {string} title @param {string} [kind] */
function part(n, text, title, kind) {
  return h("span", { class: "tile-part", title, dataset: { figure: text, kind: kind && n > 0 ? kind : null } }, `${count(n)} ${text}`);
}

function others(frames) {
  const rest = Object.entries(frames).filter(([state, n]) => state !== "indexed" && state !== "deleted" && n > 0);
  return rest.length === 0 ? "no others" : rest.map(([state, n]) => `${count(n)} ${state}`).join(", ");
}

/** @param {string} label @param {string} figure @param {string} value @param {any} note @param {string | null} [kind] */
function tile(label, figure, value, note, kind = null) {
  return h("div", { class: "card tile", dataset: { kind } }, h("span", { class: "tile-label" }, label),
    h("span", { class: "tile-value number", dataset: { figure } }, value), h("div", { class: "tile-note muted" }, note));
}
