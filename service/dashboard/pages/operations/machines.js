// Indexes map by map, the workers, and what takes the room on the disk.
import { h, put } from "../lib/dom.js";
import { bytes, count, percent } from "../lib/format.js";
import { link } from "../lib/router.js";
import { rows } from "./poll.js";

/**
 * Search indexes: version, tail, and the share of the nearest frames that a query finds.
 * @returns {{element: HTMLElement, update: (stats: Object<string, any>) => void}}
 */
export function indexes() {
  const body = h("tbody", {});
  const none = h("p", { class: "muted" }, "No maps yet.");
  const show = rows(body, (one) => one.map, (one) => h("tr", {},
    h("th", { scope: "row" }, h("a", { href: link("maps", one.map), dataset: { part: "map" } }, one.map)),
    h("td", { class: "number" }, one.version === null ? "none" : count(one.version)),
    h("td", { class: "number" }, count(one.tail)),
    h("td", { class: "number" }, recall(one))));
  const table = h("table", { class: "table" }, h("thead", {}, h("tr", {},
    h("th", { scope: "col" }, "Map"), h("th", { scope: "col", class: "number" }, "Version"),
    h("th", { scope: "col", class: "number", title: "Indexed frames that are not in this version yet; queries compare them one by one" }, "Tail"),
    h("th", { scope: "col", class: "number", title: "Share of the 10 nearest frames that a query finds" }, "Recall@10"))), body);
  return {
    element: h("section", { class: "card", "aria-labelledby": "indexes" }, h("h2", { id: "indexes" }, "Search indexes"), none,
      h("div", { class: "scroll" }, table),
      h("p", { class: "note muted" }, "A query compares every frame, except in large maps. For these, recall is measured when a version is published, on a sample of its frames.")),
    update({ indexes: found }) {
      none.hidden = found.length > 0;
      table.hidden = found.length === 0;
      show(found);
    },
  };
}

/** The share of the nearest frames that a query finds, in words where it compares every frame. */
function recall({ recall: found }) {
  if (found === null || found.sample === 0) return h("span", { class: "muted", title: "A query compares every frame of this map" }, "exact search");
  return h("span", { title: `Measured with ${count(found.sample)} frames; a query compares at least ${count(found.probes)} frames, those whose sketches are nearest` }, percent(found.share));
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
    element: h("section", { class: "card", "aria-labelledby": "room" }, h("h2", { id: "room" }, "Disk space"), list),
    update({ bytes: found }) {
      const ofMap = found.free === null; // the disk is nobody's in particular
      const parts = [["Uploads and artifacts", found.blobs], [ofMap ? "Signatures" : "Database", found.database], ["Search index", found.index]];
      put(list, (ofMap ? parts : [...parts, ["Free", found.free], ["Disk", found.disk]]).map(([name, size]) => h("div", {}, h("dt", {}, name), h("dd", { class: "number" }, size === null ? "elsewhere" : bytes(size)))));
    },
  };
}

/** A bar of how full something is; its `data-kind` tells when little room is left. @param {number} full share */
export function gauge(full) {
  const kind = full >= 0.95 ? "bad" : full >= 0.85 ? "warn" : null;
  return h("span", { class: "gauge", dataset: { kind } }, h("span", { style: { width: `${100 * full}%` } }));
}

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
        ["Frames are kept", days === null ? "forever" : days === 1 ? "1 day" : `${+days.toPrecision(4)} days`],
      ].map(([name, told]) => h("div", {}, h("dt", {}, name), h("dd", { class: "number" }, told))));
    },
  };
}

/** So much, of so much where there is a quota. */
function share(used, quota, told) {
  if (quota === null) return `${told(used)}, no quota`;
  return [`${told(used)} of ${told(quota)}`, gauge(quota > 0 ? Math.min(used / quota, 1) : 1)];
}
