// The queries of a map: who sent them, their outcome, where, and why they failed. Nothing is queried
// again.
import { get, watch } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { confidence, count, ms, shortId, things, time } from "../lib/format.js";
import { coded, sentence } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { empty, soon } from "../lib/states.js";
import { LOST, STATUSES } from "../lib/statuses.js";
import { rows } from "../operations/poll.js";

export const styles = ["operations/operations.css", "history/queries.css"];

const CHOICES = [["", "All outcomes"], ["lost", "Without a pose"], ...Object.entries(STATUSES).map(([name, [, text]]) => [name, text])];
const PERIODS = [["", "Any time"], ["1", "Last hour"], ["24", "Last 24 hours"], ["168", "Last 7 days"]];
const KEPT = [["", "All queries"], ["true", "Kept answers"]];
const HOUR_MS = 3_600_000;
const AT_ONCE = 50;
const TOGETHER_MS = 500; // events of a burst are one look

/** @param {HTMLElement} root @param {Object<string, any>} context see main.js */
export async function render(root, { params, search, signal, go }) {
  const { map } = params;
  const come = soon(root, "Loading the queries");
  /** @type {any} */
  const asked = Object.fromEntries(["status", "robot", "last", "since", "until", "kept"].map((name) => [name, search.get(name)]));
  const to = (change) => go(link("maps", map, "queries", { ...asked, ...change }));

  const body = h("tbody", { role: "rowgroup" });
  const columns = ["When", "Robot", "Outcome", "Pose", "Views", "Took", "Why", "Answer"];
  const numbers = new Set(["Views", "Took"]);
  const table = h("table", { class: "table queries", role: "table" }, h("caption", { class: "visually-hidden" }, `Queries of ${map}, the newest first`),
    h("thead", { role: "rowgroup" }, h("tr", { role: "row" }, columns.map((text) => h("th", { scope: "col", role: "columnheader", class: numbers.has(text) && "number" }, text)))), body);
  const card = h("div", { class: "card scroll" }, table);
  const none = h("div", { hidden: true });
  const more = h("button", { class: "button", type: "button", onClick: () => older() }, "Show older queries");
  const news = h("button", { class: "button primary", type: "button", hidden: true, onClick: () => newest() });
  const show = rows(body, (one) => one.query_id, row);
  let found = [];
  /** @type {Set<string>} ids of queries that came and are not shown */
  const fresh = new Set();
  /** @type {string | null} */
  let cursor = null;

  const page = (from) => get("queries", { params: { map, ...wanted(asked), cursor: from, limit: AT_ONCE }, signal });

  function tell() {
    show(found);
    more.hidden = cursor === null;
    card.hidden = found.length === 0;
    none.hidden = found.length > 0;
    news.hidden = fresh.size === 0;
    put(news, `Show ${things(fresh.size, "new query", "new queries")}`);
  }
  async function newest() {
    const told = await page(null);
    [found, cursor] = [told.items, told.next_cursor];
    fresh.clear();
    tell();
  }
  async function older() {
    const told = await page(cursor);
    const known = new Set(found.map((one) => one.query_id));
    found = [...found, ...told.items.filter((one) => !known.has(one.query_id))];
    cursor = told.next_cursor;
    tell();
  }

  await newest();
  come();
  const isFiltered = Object.values(asked).some((value) => value !== null);
  put(none, isFiltered
    ? empty({ title: "No queries match", text: "Choose other filters, or none.", actions: h("a", { class: "button", href: link("maps", map, "queries") }, "Show all queries") })
    : empty({ title: "No queries yet", text: "Each query of a robot leaves a record here within a second: who asked, what came of it, and where." }));
  put(root, h("div", { class: "toolbar spread" },
    h("div", { class: "toolbar", role: "group", "aria-label": "Filters" },
      select("queries-status", "Outcome", CHOICES, asked.status, (status) => to({ status })),
      select("queries-last", "Period", periods(asked), asked.last ?? (isPeriod(asked) ? "chosen" : null), (last) => to({ last, since: null, until: null })),
      select("queries-kept", "Answers", KEPT, asked.kept, (kept) => to({ kept })),
      robotField(asked.robot, (robot) => to({ robot }))),
    news), card, none, more);
  /** Announce queries of the newest page that are not shown. */
  async function look() {
    const told = await page(null), newest = Date.parse(found[0]?.at ?? 0);
    came(told.items.filter((one) => Date.parse(one.at) >= newest).map((one) => one.query_id));
  }
  function came(ids) {
    const known = new Set(found.map((one) => one.query_id));
    for (const id of ids) if (!known.has(id)) fresh.add(id);
    tell();
  }
  follow(map, asked, signal, came, look);
}

/** Parameters of the list, by what the address says. */
function wanted({ status, robot, last, since, until, kept }) {
  const hours = Number(last);
  return {
    status: status === "lost" ? LOST : status, robot, until, kept,
    since: last && Number.isFinite(hours) ? new Date(Date.now() - hours * HOUR_MS).toISOString() : since,
  };
}

/**
 * Hear of queries that came, where they would be in the list; of many at once only once.
 * @param {(ids: string[]) => void} came @param {() => Promise<void>} look for those of which no event may have come
 */
function follow(map, asked, signal, came, look) {
  if (asked.until !== null || asked.kept !== null) return;
  /** @type {string[]} */
  let waiting = [];
  const fits = ({ status, robot }) => (!asked.robot || asked.robot === robot)
    && (!asked.status || asked.status === status || (asked.status === "lost" && LOST.includes(status)));
  const tell = () => { if (!signal.aborted) came(waiting); waiting = []; };
  watch({ map, kinds: ["query.answered"], signal, onstate: (state) => { if (state === "live") look(); }, onevent: ({ kind, data }) => {
    if (kind === "events.missed") { look(); return; }
    if (!fits(data)) return;
    waiting.push(data.query_id);
    if (waiting.length === 1) setTimeout(tell, TOGETHER_MS);
  } });
}

function row(one) {
  const [kind, text] = STATUSES[one.status] ?? ["neutral", one.status];
  // roles: on a phone a row is no row of a table to the browser, as each is laid out by itself
  const cell = (name, ...children) => h("td", { class: `queries-${name}`, role: "cell" }, children);
  return h("tr", { role: "row", dataset: { query: one.query_id, status: one.status } },
    cell("when", time(one.at)),
    h("th", { class: "queries-who", scope: "row", role: "rowheader" }, one.robot ?? h("span", { class: "muted", title: "The query did not say who asked." }, one.key ? `key ${one.key}` : "not named"),
      one.session && h("span", { class: "queries-more muted" }, one.session)),
    cell("outcome", h("span", { class: "badge", dataset: { kind } }, text),
      one.confidence !== null && h("span", { class: "queries-more muted", title: "Confidence of its best pose" }, confidence(one.confidence))),
    cell("pose", pose(one)),
    cell("views number", one.pose ? count(one.support) : "–"),
    cell("took number", ms(one.milliseconds)),
    cell("why", why(one)),
    cell("answer", answer(one)));
}

/** Where it was found. */
function pose({ pose: found, alternatives }) {
  if (!found) return alternatives ? `${count(alternatives)} possible` : "–";
  const { x, y, z } = found.translation;
  const told = [x, y, z].map((one) => one.toFixed(2)).join(", ");
  return h("span", { title: `In ${found.parent_frame}` }, h("span", { class: "number" }, told), h("span", { class: "queries-more muted" }, `m in ${found.parent_frame}`));
}

function why({ reason, frame }) {
  return [coded(sentence(reason)), frame && [" ", h("a", { class: "mono", href: link("maps", frame.map, "frames", frame.frame_id), title: frame.frame_id }, `frame ${shortId(frame.frame_id)}`)]];
}

/** The answer while it is there, and afterwards that it is not. */
function answer({ query_id: id, stored, kept_at: kept, title, status }) {
  if (stored) {
    return [h("a", { class: "mono", href: link("queries", id), "aria-label": `Answer ${shortId(id)}` }, shortId(id)),
      kept && h("span", { class: "queries-more muted" }, title ? `kept: ${title}` : "kept")];
  }
  const text = status === "failed" ? ["no answer", "The query failed."] : ["expired", "The oldest answers go first where space runs out; their records stay longer."];
  return h("span", { class: "muted", title: `${text[1]} Query ${id}.` }, text[0]);
}

function select(id, label, choices, value, choose) {
  const field = h("select", { id, onChange: () => choose(field.value || null) },
    choices.map(([name, text]) => h("option", { value: name, selected: name === (value ?? "") }, text)));
  return h("label", { class: "inline-field", for: id }, h("span", { class: "visually-hidden" }, label), field);
}

function isPeriod({ since, until }) {
  return since !== null || until !== null;
}

function periods(asked) {
  return isPeriod(asked) ? [...PERIODS, ["chosen", "As in the address"]] : PERIODS;
}

function robotField(value, choose) {
  const field = h("input", { id: "queries-robot", type: "search", value: value ?? "", placeholder: "Any robot", "aria-label": "Robot", onChange: () => choose(field.value.trim() || null) });
  return h("span", { class: "inline-field" }, field);
}
