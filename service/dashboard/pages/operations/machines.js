// Indexes map by map, the workers, and what takes the room on the disk.
import { h, put } from "../lib/dom.js";
import { bytes, count, percent } from "../lib/format.js";
import { link } from "../lib/router.js";
import { rows } from "./poll.js";

/**
 * Search indexes: generation, tail, and what share of the nearest they find.
 * @returns {{element: HTMLElement, update: (stats: Object<string, any>) => void}}
 */
export function indexes() {
  const body = h("tbody", {});
  const none = h("p", { class: "muted" }, "There is no map yet.");
  const show = rows(body, (one) => one.map, (one) => h("tr", {},
    h("th", { scope: "row" }, h("a", { href: link("maps", one.map), dataset: { part: "map" } }, one.map)),
    h("td", { class: "number" }, one.generation === null ? "none" : count(one.generation)),
    h("td", { class: "number" }, count(one.tail)),
    h("td", { class: "number" }, recall(one))));
  const table = h("table", { class: "table" }, h("thead", {}, h("tr", {},
    h("th", { scope: "col" }, "Map"), h("th", { scope: "col", class: "number" }, "Generation"),
    h("th", { scope: "col", class: "number", title: "Indexed frames that the generation lacks; queries compare them one by one" }, "Tail"),
    h("th", { scope: "col", class: "number", title: "Share of the 10 nearest by the exact scan that the shortlist finds" }, "Recall@10"))), body);
  return {
    element: h("section", { class: "card", "aria-labelledby": "indexes" }, h("h2", { id: "indexes" }, "Search indexes"), none,
      h("div", { class: "scroll" }, table),
      h("p", { class: "note muted" }, "Recall is measured when a generation is published, on a sample of its own frames, against the exact scan.")),
    update({ indexes: found }) {
      none.hidden = found.length > 0;
      table.hidden = found.length === 0;
      show(found);
    },
  };
}

/** What is known of the share that an index finds, in words where there is no number. */
function recall({ generation, recall: found }) {
  if (generation === null) return h("span", { class: "muted", title: "Every frame is compared" }, "compared whole");
  if (found === null) return h("span", { class: "muted", title: "An earlier version published it" }, "not measured");
  if (found.sample === 0) return h("span", { class: "muted", title: `Up to ${count(found.shortlist + 1)} frames the shortlist leaves nothing out` }, "compared whole");
  return h("span", { title: `${count(found.sample)} frames looked up, a shortlist of ${count(found.shortlist)}` }, percent(found.share));
}

/**
 * Processes that sign frames, and what each is at.
 * @returns {{element: HTMLElement, update: (stats: Object<string, any>) => void}}
 */
export function workers() {
  const list = h("ul", { class: "list" });
  const none = h("p", {}, h("span", { class: "badge", dataset: { kind: "bad" } }, "none"), " Frames wait until a worker runs: ", h("code", {}, "sceneprint work"), ".");
  const show = rows(list, (one) => one.name, (one) => h("li", { class: "worker" },
    h("span", { class: "badge", dataset: { kind: one.job_id === null ? "neutral" : "good" } }, one.job_id === null ? "waits" : "works"),
    h("span", { class: "mono" }, one.name),
    one.job_id !== null && h("a", { href: link("operations", "jobs", one.job_id), dataset: { part: "job" } }, "its job")));
  return {
    element: h("section", { class: "card", "aria-labelledby": "workers" }, h("h2", { id: "workers" }, "Workers"), none, list),
    update({ workers: found }) {
      none.hidden = found.length > 0;
      show(found);
    },
  };
}

/**
 * The room that the store takes, or one map of it.
 * @returns {{element: HTMLElement, update: (stats: Object<string, any>) => void}}
 */
export function room() {
  const list = h("dl", { class: "facts" });
  return {
    element: h("section", { class: "card", "aria-labelledby": "room" }, h("h2", { id: "room" }, "Room on the disk"), list),
    update({ bytes: found }) {
      const ofMap = found.free === null; // the disk is nobody's in particular
      const parts = [["Uploads and artifacts", found.blobs], [ofMap ? "Signatures" : "Database", found.database], ["Search index", found.index]];
      put(list, (ofMap ? parts : [...parts, ["Free", found.free], ["Disk", found.disk]]).map(([name, size]) => h("div", {}, h("dt", {}, name), h("dd", { class: "number" }, size === null ? "elsewhere" : bytes(size)))));
    },
  };
}

const TIGHT = [[0.95, "bad"], [0.85, "warn"]];

/**
 * What one map has of what it may have, and for how long.
 * @returns {{element: HTMLElement, update: (stats: Object<string, any>) => void}}
 */
export function limits() {
  const list = h("dl", { class: "facts" });
  return {
    element: h("section", { class: "card", "aria-labelledby": "limits" }, h("h2", { id: "limits" }, "Quota and retention"), list),
    update({ use }) {
      const days = use.retention_days;
      put(list, [
        ["Frames", share(use.frames, use.quota_frames, count)],
        ["Uploads", share(use.bytes, use.quota_bytes, bytes)],
        ["Frames are kept", days === null ? "for ever" : days === 1 ? "1 day" : `${+days.toPrecision(4)} days`],
      ].map(([name, told]) => h("div", {}, h("dt", {}, name), h("dd", { class: "number" }, told))));
    },
  };
}

/** So much, of so much where there is a quota. */
function share(used, quota, told) {
  if (quota === null) return `${told(used)}, no quota`;
  const full = quota > 0 ? Math.min(used / quota, 1) : 1;
  const kind = TIGHT.find(([least]) => full >= least)?.[1] ?? null;
  return [`${told(used)} of ${told(quota)}`, h("span", { class: "gauge", dataset: { kind } }, h("span", { style: { width: `${100 * full}%` } }))];
}
