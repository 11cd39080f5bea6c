// A map as a card: its plan with the robots on it, its last answers, and what is in it.
import { get } from "../lib/api.js";
import { h, once, put, svg } from "../lib/dom.js";
import { count, things, time } from "../lib/format.js";
import { link } from "../lib/router.js";
import { may } from "../lib/session.js";
import { LOST, STATUSES } from "../lib/statuses.js";
import { waiting } from "./condition.js";
import { thumbnail } from "./thumbnail.js";

const PENCIL = "M4 20h4L19 9l-4-4L4 16zM13 7l4 4";
const COPY = "M9 9h11v11H9zM15 9V4H4v11h5";
const BIN = "M5 7h14M10 7V4h4v3M7 7l1 13h8l1-13M10 11v5M14 11v5";
const ANSWERS = 3;
/** Queries that the robots on the plan are known by, and how old they may be. */
const QUERIES = 100, HOUR_MS = 3_600_000;

/** The dialogs, when they are asked for: the first page does without them. */
export const edit = () => import("./edit.js");

/**
 * The card of a map.
 * @param {Object<string, any>} map as the API tells it
 * @param {{signal: AbortSignal, changed: () => Promise<void>}} how changed: called after an edit
 * @returns {{element: HTMLElement, map: Object<string, any>, update: (map: any) => void, fill: () => Promise<void>,
 *   read: () => Promise<void>, draw: () => Promise<void>, answered: (event: Object<string, any>) => void}}
 *   fill: fetch plan and queries, once; read, draw: fetch the queries or the plan again, if they were fetched;
 *   answered: a query was answered
 */
export function mapCard(map, { signal, changed }) {
  const id = `map-${map.name}`, { name } = map;
  const parts = {
    title: h("a", { href: link("maps", name, "place") }), name: h("p", { class: "muted mono map-name" }),
    count: h("a", { class: "map-count", href: link("maps", name) }), badges: h("div", { class: "toolbar badges" }),
    share: h("p", { class: "map-share" }), answers: h("ul", { class: "map-answers", "aria-label": `Last answers of ${name}` }), model: h("p", { class: "map-model muted" }),
  };
  const plan = thumbnail(name, signal);
  const tools = h("div", { class: "map-tools" }, tool(COPY, `Back up or copy ${name}`, async () => (await edit()).copyMap(name)), may("admin", name) && [
    tool(PENCIL, `Rename ${name}`, async () => (await edit()).retitleMap(card.map, changed)),
    tool(BIN, `Delete ${name}`, async () => (await edit()).deleteMap(card.map, changed))]);
  const element = h("article", { class: "card map", "aria-labelledby": id, dataset: { map: name } }, plan.element,
    h("div", { class: "map-head" }, h("div", {}, h("h2", { id }, parts.title), parts.name), tools),
    h("div", { class: "map-figures" }, parts.count, parts.badges),
    h("div", {}, parts.share, parts.answers), parts.model);
  let isFilled = false;
  /** @type {Object<string, any>[]} queries of the last hour in the order of time */
  let records = [];
  const card = { element, map, update, fill, answered,
    read: async () => { if (isFilled) await read(); }, draw: async () => { if (isFilled) await plan.load().catch(passed); } };

  function update(next) {
    card.map = next;
    const { title, frames, model, reencoding, posed_frames: posed, parent_frames: parents } = next;
    put(parts.title, title ?? name); // the link itself stays, and with it the focus
    put(parts.name, title === null || title === name ? "" : name);
    put(parts.count, h("strong", { class: "map-number" }, count(frames.indexed ?? 0)), h("span", { class: "muted" }, frames.indexed === 1 ? " indexed frame" : " indexed frames"));
    const badges = [
      badge(name, "neutral", waiting(next), "waiting", "received"),
      badge(name, "bad", frames.failed, "failed", "failed"),
      badge(name, "warn", frames.rejected, "rejected", "rejected"),
      badge(name, "neutral", frames.redundant, "redundant", "redundant"),
      Boolean(frames.indexed) && posed === 0 && h("span", { class: "badge", dataset: { kind: "warn" }, title: "Queries find frames, and no coordinates. Send `pose` with frames." }, "no poses"),
    ].filter(Boolean);
    put(parts.badges, badges, parents > 1 && parted(name, parents));
    put(parts.model, h("span", { class: "mono" }, model), reencoding && progress(reencoding));
    plan.say(frames.indexed ? (posed ? "The plan is not built yet" : "No poses, so no plan")
      : [h("span", {}, "This map is empty"), may("write", name) && h("a", { class: "button", href: link("maps", name, "upload") }, "Upload frames")]);
    share();
  }

  function share() {
    const { recent_queries: counts } = card.map, of = (states) => states.reduce((n, one) => n + (counts[one] ?? 0), 0);
    const all = of(["found", ...LOST]), others = of(["unvalidated"]);
    const queries = (n) => (n === 0 ? "No queries" : things(n, "query", "queries"));
    put(parts.share, all === 0 ? h("span", { class: "muted" }, queries(others), others > 0 && " without validation", " in the last hour")
      : [h("strong", { class: "number" }, `${Math.floor((100 * of(["found"])) / all)} %`), ` of ${queries(all)} found in the last hour`]);
  }

  function show() {
    put(parts.answers, records.slice(-ANSWERS).reverse().map((one) => {
      const [kind, text] = STATUSES[one.status] ?? ["neutral", one.status];
      return h("li", {}, h("a", { class: "badge", dataset: { kind }, href: one.stored ? link("queries", one.query_id) : link("maps", name, "queries") }, text),
        h("span", { class: "map-who" }, one.robot ?? h("span", { class: "muted" }, one.key ? `key ${one.key}` : "not named")), h("span", { class: "muted" }, time(one.at)));
    }));
    plan.show(records);
  }

  async function fill() {
    isFilled = true;
    const come = read();
    await Promise.all([come, plan.load(come).catch(passed)]);
  }

  async function read() {
    const since = new Date(Date.now() - HOUR_MS).toISOString();
    const page = await get("queries", { params: { map: name, since, limit: QUERIES }, signal }).catch(passed);
    if (!page) return;
    const known = new Set(page.items.map((one) => one.query_id));
    // an answer that came meanwhile may be in neither
    records = [...page.items, ...records.filter((one) => !known.has(one.query_id))].sort((a, b) => Date.parse(a.at) - Date.parse(b.at)).slice(-QUERIES);
    show();
  }

  /** @param {any} event */
  function answered({ at, data }) {
    if (records.some((one) => one.query_id === data.query_id)) return;
    const { recent_queries: counts } = card.map;
    counts[data.status] = (counts[data.status] ?? 0) + 1;
    share();
    records = [...records, { robot: null, pose: null, key: null, at, stored: data.status !== "failed", ...data }].slice(-QUERIES);
    if (isFilled) show();
  }

  update(map);
  return card;
}

/** A map that was left or removed meanwhile has no plan and no queries. */
function passed(error) {
  if (error.status === 401) throw error;
  return null;
}

function badge(map, kind, n, text, state) {
  return Boolean(n) && h("a", { class: "badge", dataset: { kind }, href: link("maps", map, { state }) }, `${count(n)} ${text}`);
}

/** Poses of a map that are not in one frame of reference. */
function parted(map, n) {
  return h("a", { class: "badge", dataset: { kind: "neutral" }, href: link("maps", map, "place"), title: "Each answer is in the frame of reference of its matches, until an association joins them." }, `${count(n)} frames of reference`);
}

function progress({ model, done, left, failed, dead }) {
  const all = done + left + failed + dead;
  const text = `to ${model}: ${count(done)} of ${count(all)}`;
  return h("span", { class: "reencoding" }, text, dead > 0 && h("span", { class: "badge", dataset: { kind: "bad" } }, `${count(dead)} failed`),
    h("progress", { max: Math.max(all, 1), value: done, "aria-label": `Signing again ${text}` }));
}

function tool(path, label, act) {
  return h("button", { class: "button quiet", type: "button", "aria-label": label, title: label, onClick: once(act) },
    svg("svg", { class: "icon", viewBox: "0 0 24 24", "aria-hidden": "true" }, svg("path", { d: path })));
}
