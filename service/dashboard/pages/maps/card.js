// A map as a card: what is in it, what it is signed with, how far its index is.
import { get } from "../lib/api.js";
import { h, once, put, svg } from "../lib/dom.js";
import { bytes, count } from "../lib/format.js";
import { link } from "../lib/router.js";
import { may } from "../lib/session.js";

const PENCIL = "M4 20h4L19 9l-4-4L4 16zM13 7l4 4";
const BIN = "M5 7h14M10 7V4h4v3M7 7l1 13h8l1-13M10 11v5M14 11v5";
const REST_MS = 4000; // between two looks at figures that cost the service more than counts

/** The dialogs, when they are asked for: the first page does without them. */
export const edit = () => import("./edit.js");

/** Frames of a map that wait for a worker, or are being signed. */
export function waiting(map) {
  return (map.frames.received ?? 0) + (map.frames.signing ?? 0);
}

/**
 * The card of a map.
 * @param {Object<string, any>} map as the API tells it
 * @param {{signal: AbortSignal, changed: () => Promise<void>}} how changed: called after an edit
 * @returns {{element: HTMLElement, map: Object<string, any>, update: (map: any) => void, fill: () => Promise<void>}}
 */
export function mapCard(map, { signal, changed }) {
  const id = `map-${map.name}`;
  const parts = {
    title: h("a", { href: link("maps", map.name, "place") }), name: h("p", { class: "muted mono map-name" }),
    number: h("strong", { class: "map-number" }), badges: h("div", { class: "toolbar badges" }),
    first: h("div", { class: "map-first" }), model: h("dd", { class: "mono" }),
    index: h("dd", {}, "…"), disk: h("dd", { class: "number" }, "…"),
  };
  const tools = may("admin", map.name) && h("div", { class: "map-tools" },
    tool(PENCIL, `Rename ${map.name}`, async () => (await edit()).retitleMap(card.map, changed)),
    tool(BIN, `Delete ${map.name}`, async () => (await edit()).deleteMap(card.map, changed)));
  const element = h("article", { class: "card map", "aria-labelledby": id, dataset: { map: map.name } },
    h("div", { class: "map-head" }, h("div", {}, h("h2", { id }, parts.title), parts.name), tools),
    h("div", { class: "map-figures" },
      h("a", { class: "map-count", href: link("maps", map.name) }, parts.number, h("span", { class: "muted" }, " indexed frames")), parts.first),
    parts.badges,
    h("dl", { class: "map-facts" },
      h("div", {}, h("dt", {}, "Model"), parts.model),
      h("div", {}, h("dt", {}, "Index"), parts.index),
      h("div", {}, h("dt", {}, "Disk"), parts.disk)));
  /** @type {number | null} */
  let filled = null; // when the figures were asked for; null: never
  /** @type {Timer} */
  let timer = null;
  let looks = 0;
  const card = { element, map, update, fill };

  function update(next) {
    const moved = next.revision !== card.map.revision;
    card.map = next;
    draw();
    if (moved && filled !== null && timer === null) {
      timer = setTimeout(fill, Math.max(0, filled + REST_MS - Date.now()));
    }
  }

  function draw() {
    const { name, title, frames, model, reencoding, posed_frames, parent_frames } = card.map;
    put(parts.title, title ?? name); // the link itself stays, and with it the focus
    put(parts.name, title === null || title === name ? "" : name);
    put(parts.number, count(frames.indexed ?? 0));
    const badges = [
      badge(name, "neutral", waiting(card.map), "waiting", "received"),
      badge(name, "bad", frames.failed, "failed", "failed"),
      badge(name, "warn", frames.rejected, "rejected", "rejected"),
      badge(name, "neutral", frames.redundant, "redundant", "redundant"),
      Boolean(frames.indexed) && posed_frames === 0 && h("span", { class: "badge", dataset: { kind: "warn" }, title: "Queries find frames, and no coordinates. Send `pose` with frames." }, "no poses"),
    ].filter(Boolean);
    put(parts.badges, badges.length ? badges : healthy(frames.indexed), parent_frames > 1 && parted(name, parent_frames));
    put(parts.model, model, reencoding && progress(reencoding));
  }

  async function fill() {
    filled = Date.now();
    timer = null;
    const look = looks += 1;
    const { name } = card.map;
    try {
      const stats = await get("stats", { params: { map: name, minutes: 1 }, signal });
      if (look !== looks) return; // a newer one is under way, or was faster
      put(parts.index, lag(stats.indexes.find((one) => one.map === name), stats.frames.indexed ?? 0));
      const { database, blobs, index } = stats.bytes;
      put(parts.disk, h("span", { title: `${bytes(database ?? 0)} signatures, ${bytes(blobs)} uploads and geometry, ${bytes(index)} index` },
        bytes((database ?? 0) + blobs + index)));
      put(parts.first, !stats.frames.indexed && first(name));
    } catch (error) {
      if (error.name === "AbortError" || error.status === 404) return; // left, or removed meanwhile
      if (error.status === 401) throw error;
      for (const one of [parts.index, parts.disk]) put(one, h("span", { title: error.message }, "not known"));
    }
  }

  signal.addEventListener("abort", () => clearTimeout(timer));
  draw();
  return card;
}

function badge(map, kind, n, text, state) {
  return Boolean(n) && h("a", { class: "badge", dataset: { kind }, href: link("maps", map, { state }) }, `${count(n)} ${text}`);
}

/** Poses of a map that are not in one frame of reference. */
function parted(map, n) {
  return h("a", { class: "badge", dataset: { kind: "neutral" }, href: link("maps", map, "place"), title: "Each answer is in the frame of reference of its matches, until an association joins them." }, `${count(n)} frames of reference`);
}

function healthy(indexed) {
  return indexed ? h("span", { class: "badge", dataset: { kind: "good" } }, "Up to date") : h("span", { class: "badge" }, "empty");
}

function progress({ model, done, left, failed, dead }) {
  const all = done + left + failed + dead;
  const text = `to ${model}: ${count(done)} of ${count(all)}`;
  return h("span", { class: "reencoding" }, text, dead > 0 && h("span", { class: "badge", dataset: { kind: "bad" } }, `${count(dead)} failed`),
    h("progress", { max: Math.max(all, 1), value: done, "aria-label": `Signing again ${text}` }));
}

/** How far the index is behind; a map may do without one. */
function lag(index, indexed) {
  if (!index || index.version === null) {
    return indexed ? h("span", { title: "A query compares every frame of this map." }, "none needed") : "–";
  }
  return `version ${count(index.version)}, ${index.tail ? `${count(index.tail)} behind` : "up to date"}`;
}

/** How an empty map comes by its first frames. */
function first(map) {
  return may("write", map) && h("a", { class: "button", href: link("maps", map, "upload") }, "Upload frames");
}

function tool(path, label, act) {
  return h("button", { class: "button quiet", type: "button", "aria-label": label, title: label, onClick: once(act) },
    svg("svg", { class: "icon", viewBox: "0 0 24 24", "aria-hidden": "true" }, svg("path", { d: path })));
}
