// What happened, as it happens: the newest first.
import { get, watch } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { shortId, time } from "../lib/format.js";
import { go, link } from "../lib/router.js";
import { mapField } from "./mapfield.js";
import { rows } from "./poll.js";

const KIND = {
  indexed: "good", created: "good", done: "good", found: "good", reencoded: "good",
  failed: "bad", damaged: "bad", rejected: "warn", missed: "warn", deleted: "warn", revoked: "warn",
};
const KINDS = [["", "All kinds"], ["frame.", "Frames"], ["frame.failed", "Failures"], ["map.", "Maps"], ["query.", "Queries"], ["import.", "Imports"], ["association.", "Associations"], ["coverage.", "Coverage"], ["difference.", "Differences"], ["surface.", "Surfaces"], ["key.", "Keys"]];
const AT_ONCE = 100;
const MOST = 500; // rows: a page that is left open for a day stays light

/** See operations.js. */
export async function renderTab(root, { search, signal }) {
  const asked = { map: search.get("map"), kind: search.get("kind") };
  const to = (change) => link("operations", { tab: "events", ...asked, ...change });
  const live = h("span", { class: "badge", dataset: { kind: "warn" } }, "waiting");
  const kind = h("select", { id: "events-kind", onChange: () => go(to({ kind: kind.value })) },
    KINDS.map(([value, text]) => h("option", { value, selected: value === (asked.kind ?? "") }, text)));
  const feed = await events({ ...asked, limit: AT_ONCE, signal, older: true, onstate: (state) => {
    live.dataset.kind = state === "live" ? "good" : "warn";
    put(live, state);
  } });
  put(root, h("div", { class: "toolbar spread" }, live, h("div", { class: "toolbar" },
    h("label", { class: "inline-field" }, h("span", { class: "visually-hidden" }, "Kind"), kind),
    await mapField(asked.map, signal, (map) => go(to({ map }))))), feed);
}

/**
 * A list of events that grows at the top as they happen.
 * @param {{map?: string | null, kind?: string | string[] | null, limit: number, older?: boolean, signal: AbortSignal,
 *   onstate?: (state: "live" | "waiting") => void, onevent?: (event: Object<string, any>) => void}} what
 *   older: with a button for those before; limit: shown at first, and without `older` at most
 */
export async function events({ map, kind, limit, older = false, signal, onstate, onevent = () => {} }) {
  const list = h("ul", { class: "list events" });
  const none = h("p", { class: "muted" }, "No events yet.");
  const more = h("button", { class: "button", type: "button", hidden: true, onClick: () => before() }, "Show older events");
  const show = rows(list, (one) => one.id, eventRow);
  const most = older ? MOST : limit;
  let found = [];
  let cursor = null;
  let first = true;

  const take = (newer, behind) => {
    const seen = new Set(found.map((one) => one.id));
    const fresh = newer.filter((one) => !seen.has(one.id));
    found = behind ? [...found, ...fresh] : [...fresh, ...found].slice(0, Math.max(most, found.length));
    none.hidden = found.length > 0;
    show(found);
  };
  async function before() {
    const page = await get("events", { params: { map, kind, order: "newest", limit, cursor }, signal });
    cursor = page.next_cursor;
    more.hidden = !older || cursor === null;
    take(page.items, true);
  }

  // the stream first, then what was before: what happens between the two comes twice, not never
  const early = [];
  const heard = watch({
    map: map ?? undefined, kinds: kind ? [kind].flat() : undefined, signal, onstate,
    onevent: (event) => {
      if (first) early.push(event); else take([event], false);
      onevent(event);
    },
  });
  await Promise.race([before(), heard.then(() => new Promise(() => {}))]);
  first = false;
  take(early.reverse(), false);
  return h("div", { class: "feed" }, none, list, more);
}

function eventRow(event) {
  const word = event.kind.split(".").pop();
  return h("li", { class: "event", dataset: { kind: event.kind } },
    h("span", { class: "event-time muted number" }, time(event.at)),
    h("span", { class: "badge", dataset: { kind: KIND[word] ?? "neutral" } }, event.kind),
    h("span", { class: "event-about" },
      event.map && h("a", { href: link("maps", event.map), dataset: { part: "map" } }, event.map),
      event.frame_id && [" / ", h("a", { class: "mono", href: link("maps", event.map, "frames", event.frame_id), title: event.frame_id, dataset: { part: "frame" } }, shortId(event.frame_id))],
      gist(event.data) && h("span", { class: "muted event-data" }, gist(event.data))),
    event.data?.query_id && h("a", { class: "event-job", href: link("queries", event.data.query_id) }, "answer"),
    event.job_id && h("a", { class: "event-job", href: link("operations", "jobs", event.job_id), dataset: { part: "job" } }, "job"));
}

/** What more an event says, in a line. */
function gist(data) {
  const parts = Object.entries(data ?? {}).filter(([name, value]) => name !== "query_id" && value !== null && typeof value !== "object");
  const text = parts.map(([name, value]) => `${name} ${value}`).join(", ");
  return text.length > 120 ? `${text.slice(0, 119)}…` : text;
}
