// Indexes map by map, the workers, and what takes the room on the disk.
import { h } from "../lib/dom.js";
import { bytes, count, percent } from "../lib/format.js";
import { link } from "../lib/router.js";

/** A card. @param {string} id @param {string} title @param {...any} children */
const card = (id, title, ...children) => h("section", { class: "card", "aria-labelledby": id }, h("h2", { id }, title), children);

/** Names and values of a card. @param {[string, any][]} entries */
const facts = (entries) => h("dl", { class: "facts" }, entries.map(([name, told]) => h("div", {}, h("dt", {}, name), h("dd", { class: "number" }, told))));

/** Search indexes: version, tail, and the share of the nearest frames that a query finds. */
function indexes({ indexes: found }) {
  const row = (one) => h("tr", {},
    h("th", { scope: "row" }, h("a", { href: link("maps", one.map), dataset: { part: `map ${one.map}` } }, one.map)),
    h("td", { class: "number" }, one.version === null ? "none" : count(one.version)),
    h("td", { class: "number" }, count(one.tail)),
    h("td", { class: "number" }, recall(one)));
  return card("indexes", "Search indexes", found.length === 0 ? h("p", { class: "muted" }, "No maps yet.") : h("div", { class: "scroll" }, h("table", { class: "table" },
    h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Map"), h("th", { scope: "col", class: "number" }, "Version"),
      h("th", { scope: "col", class: "number", title: "Indexed frames that are not in this version yet; queries compare them one by one" }, "Newer frames"),
      h("th", { scope: "col", class: "number", title: "Share of the 10 nearest frames that a query finds" }, "Recall@10"))), h("tbody", {}, found.map(row)))),
  h("p", { class: "note muted" }, "A query compares every frame, except in large maps. For these, recall is measured when a version is published, on a sample of its frames."));
}

/** The share of the nearest frames that a query finds, in words where it compares every frame. */
function recall({ recall: found }) {
  if (found === null || found.sample === 0) return h("span", { class: "muted", title: "A query compares every frame of this map" }, "exact search");
  return h("span", { title: `Measured with ${count(found.sample)} frames; a query compares at least ${count(found.probes)} frames, those whose sketches are nearest` }, percent(found.share));
}

/** Processes that sign frames, and what each is at. */
function workers({ workers: found }) {
  return card("workers", "Workers",
    found.length === 0 && h("p", {}, h("span", { class: "badge", dataset: { kind: "bad" } }, "none"), " Frames wait until a worker runs: ", h("code", {}, "sceneprint work"), "."),
    h("ul", { class: "list" }, found.map((one) => h("li", { class: "worker" },
      h("span", { class: "badge", dataset: { kind: one.job_id === null ? "neutral" : "good" } }, one.job_id === null ? "idle" : "busy"),
      h("span", { class: "mono" }, one.name),
      one.job_id !== null && h("a", { href: link("operations", "jobs", one.job_id), dataset: { part: `job ${one.name}` } }, "its job")))));
}

/** The room that the store takes, or one map of it. */
function room({ bytes: found }) {
  const ofMap = found.free === null; // the disk is nobody's in particular
  const parts = [["Uploads and artifacts", found.blobs], [ofMap ? "Signatures" : "Database", found.database], ["Search index", found.index]];
  return card("room", "Disk space", facts((ofMap ? parts : [...parts, ["Free", found.free], ["Disk", found.disk]]).map(([name, size]) => [name, size === null ? "elsewhere" : bytes(size)])));
}

/** What one map has of what it may have, and for how long. */
function limits({ use }) {
  const days = use.retention_days;
  return card("limits", "Quota and retention", facts([
    ["Frames", share(use.frames, use.quota_frames, count)],
    ["Uploads", share(use.bytes, use.quota_bytes, bytes)],
    ["Frames are kept", days === null ? "forever" : days === 1 ? "1 day" : `${+days.toPrecision(4)} days`],
  ]));
}

/** So much, of so much where there is a quota. */
function share(used, quota, told) {
  return quota === null ? `${told(used)}, no quota` : [`${told(used)} of ${told(quota)}`, gauge(quota > 0 ? Math.min(used / quota, 1) : 1)];
}

/** A bar of how full something is; its `data-kind` tells when little room is left. @param {number} full share */
export function gauge(full) {
  const kind = full >= 0.95 ? "bad" : full >= 0.85 ? "warn" : null;
  return h("span", { class: "gauge", dataset: { kind } }, h("span", { style: { width: `${100 * full}%` } }));
}

/** Cards by the part of the figures that each is drawn from. */
export const CARDS = { indexes, workers, use: limits, bytes: room };
