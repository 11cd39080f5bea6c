// The figures of this moment, large: what waits, who works, what was refused, how full the disk is.
import { h, put } from "../lib/dom.js";
import { bytes, count, percent, seconds } from "../lib/format.js";
import { sparkline } from "../lib/sparkline.js";
import { gauge } from "./machines.js";

const REMEMBERED = 60; // polls of the queue that the little line shows
const OLD_S = 300; // a frame that waits longer than this needs attention

/**
 * Tiles for the whole service, or for one map where `whole` is false.
 * @param {boolean} whole
 * @returns {{element: HTMLElement, update: (stats: Object<string, any>) => void}}
 */
export function tiles(whole) {
  const waited = [];
  const queue = tile("Waiting jobs", "waiting");
  const oldest = tile("Oldest frame not signed", "oldest");
  const frames = tile("Indexed frames", "indexed");
  const workers = tile("Workers", "workers");
  const requests = tile("Requests, last hour", "requests");
  const disk = tile("Disk", "disk");
  const all = whole ? [queue, oldest, frames, workers, requests, disk] : [queue, oldest, frames];
  const element = h("section", { class: "tiles", "aria-label": "Now" }, all.map((one) => one.element));
  return {
    element,
    update(stats) {
      element.dataset.at = stats.at; // of which answer these figures are
      waited.push(stats.waiting);
      if (waited.length > REMEMBERED) waited.shift();
      const line = waited.length > 1 && Math.max(...waited) > 0
        && sparkline(waited, { label: `Waiting jobs since this page was opened: now ${stats.waiting}, at most ${Math.max(...waited)}`, width: 88 });
      queue.set(count(stats.waiting), [`${count(stats.jobs.running ?? 0)} running`, line]);
      const old = stats.oldest_waiting_s.sign ?? null;
      oldest.set(old === null ? "–" : seconds(old), old === null ? "up to date" : "since its upload", old > OLD_S ? "warn" : null);
      frames.set(count(stats.frames.indexed ?? 0), others(stats.frames));
      if (!whole) return;
      const busy = stats.workers.filter((one) => one.job_id !== null).length;
      const idle = stats.workers.length === 0;
      workers.set(count(stats.workers.length), idle ? "idle" : `${count(busy)} busy`, idle ? "bad" : null);
      const { requests: asked, refused, busy: later, broken } = stats.total;
      requests.set(count(asked), [part(refused, "refused"), part(later, "busy"), part(broken, "broken", "bad")], null);
      const { free, disk: room } = stats.bytes;
      const full = room > 0 ? 1 - free / room : null, bar = full !== null && gauge(full);
      disk.set(full === null ? "–" : `${percent(full)} full`, [`${bytes(free)} free of ${bytes(room)}`, bar], bar ? bar.dataset.kind ?? null : null);
    },
  };
}

function part(n, text, kind) {
  return h("span", { class: "tile-part", dataset: { figure: text, kind: kind && n > 0 ? kind : null } }, `${count(n)} ${text}`);
}

function others(frames) {
  const rest = Object.entries(frames).filter(([state, n]) => state !== "indexed" && state !== "deleted" && n > 0);
  return rest.length === 0 ? "no others" : rest.map(([state, n]) => `${count(n)} ${state}`).join(", ");
}

function tile(label, figure) {
  const value = h("span", { class: "tile-value number", dataset: { figure } }, "–");
  const note = h("div", { class: "tile-note muted" });
  const element = h("div", { class: "card tile" }, h("span", { class: "tile-label" }, label), value, note);
  return {
    element,
    /** @param {any} text @param {any} more @param {string | null} [kind] */
    set(text, more, kind = null) {
      put(value, text);
      put(note, more);
      if (kind === null) delete element.dataset.kind; else element.dataset.kind = kind;
    },
  };
}
