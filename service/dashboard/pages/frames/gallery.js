// Frames of a map, 24 at a time, by whatever the address says; their states change as they happen.
import { at, get } from "../lib/api.js";
import { h, put, throttle } from "../lib/dom.js";
import { count, things } from "../lib/format.js";
import { link } from "../lib/router.js";
import { may } from "../lib/session.js";
import { empty, failed, toast } from "../lib/states.js";
import { isPending } from "./badge.js";
import { countOf, filterBar, FILTERS } from "./filters.js";
import { follow } from "./following.js";
import { selectionBar } from "./selection.js";
import { tile } from "./tile.js";
import { viewSwitch } from "./views.js";

export const styles = ["frames/frames.css"];

const PAGE = 24;
const FILL_MS = 300; // frames come in bursts
const MOST_COME = 1000;

/** The page: #/maps/NAME?view=&find=&robot=&session=&state=&tag=&captured_after=&captured_before=&order=&cursor=&page= */
export async function render(root, { params, search, signal, go, actions }) {
  const path = at("maps", params.map);
  const canWrite = may("write", params.map);
  actions(canWrite && h("a", { class: "button primary", href: link("maps", params.map, "upload") }, "Upload frames"));

  let wanted = search;
  /** @type {(string | null)[]} cursors of the pages before this one, as far as the history knows them */
  let earlier = history.state?.earlier ?? [];
  /** @type {any} null until they have come */
  let runs = null; // of the map's sessions: 100,000 frames are counted for them, and the list need not wait
  /** @type {AbortController | null} */
  let list = null;
  /** @type {Object<string, any> | null} */
  let last = null; // the page that is shown
  /** @type {string | null} */
  let offered = null; // robots and sessions that the filters offer
  const tiles = new Map(); // by frame
  const come = new Set(); // frames that came since the list was asked for
  const grid = h("ul", { class: "gallery", id: "frames" });
  const place = h("div", { class: "gallery-place" });
  const news = h("div", { class: "gallery-news", role: "status" });
  const [over, under] = [h("div", { class: "pager" }), h("nav", { class: "pager", "aria-label": "Pages" })];
  const views = viewSwitch(viewOf(wanted), (view) => change({ view: view === "depth" ? null : view }, earlier, true));
  const order = h("select", { id: "order", "aria-label": "Order", onChange: () => turn({ order: order.value || null }) },
    h("option", { value: "" }, "Newest first"), h("option", { value: "asc" }, "Oldest first"));
  let bar = filterBar(wanted, [], turn);
  const fold = h("details", { class: "filters-fold", open: FILTERS.some((one) => wanted.has(one)) }, h("summary", {}, "Filters"), bar);
  const clear = h("button", { class: "button quiet", type: "button", onClick: () => turn(Object.fromEntries(FILTERS.map((one) => [one, null]))) }, "Clear filters");
  // the tabs of the page and the filters are many steps of the keyboard before the first frame
  const past = h("a", { class: "skip", href: "#frames", onClick: (event) => {
    event.preventDefault(); // its `#frames` would be taken for an address
    grid.querySelector("a")?.focus();
  } }, "Skip to the frames");
  const selected = canWrite ? selectionBar(params.map, {
    filter: () => filterOf(wanted), total: () => countOf(wanted, runs && !runs.next_cursor ? runs.items : null),
    changed: () => Promise.all([fetchList(), fetchRuns()]),
  }) : null;
  put(root, past, h("div", { class: "gallery-head" }, views, order, fold, clear, over), selected, news, place, under);

  /** Another list begins at its first page. */
  function turn(asked) {
    change({ ...asked, cursor: null, page: null });
  }

  function change(asked, before = [], sameList = false) {
    const next = new URLSearchParams(wanted);
    for (const [name, value] of Object.entries(asked)) if (value === null) next.delete(name); else next.set(name, value);
    [wanted, earlier] = [next, before];
    go(link("maps", params.map, wanted), { quiet: true, state: { earlier } });
    show();
    if (!sameList) { fetchList().catch(shownFault); return; }
    for (const one of tiles.values()) one.show(one.frame, viewOf(wanted));
  }

  function shownFault(error) {
    if (error.name === "AbortError") return;
    if (error.status === 401 || error.status === 0) throw error;
    put(place, failed(error, () => fetchList().catch(shownFault)),
      // an address that was cut off, or is too old: what it asks for is refused each time
      error.status === 422 && h("div", { class: "toolbar gallery-news" }, wanted.has("cursor") && first("First page"), !clear.hidden && h("button", { class: "button", type: "button", onClick: () => clear.click() }, "Clear filters")));
    grid.removeAttribute("aria-busy");
    put(over); put(under);
  }

  function show() {
    bar.refill(wanted);
    views.show(viewOf(wanted));
    order.value = wanted.get("order") === "asc" ? "asc" : "";
    clear.hidden = !FILTERS.some((one) => wanted.has(one));
  }

  async function fetchList() {
    list?.abort();
    const turnOf = list = new AbortController(); // of this list: what of the last one has not come is not wanted
    const both = AbortSignal.any([signal, turnOf.signal]);
    const asked = { limit: PAGE, order: wanted.get("order") === "asc" ? "asc" : "desc", cursor: wanted.get("cursor") };
    for (const name of FILTERS) asked[name] = wanted.getAll(name);
    grid.setAttribute("aria-busy", "true");
    const page = await get(`${path}/frames`, { params: asked, signal: both });
    put(news);
    come.clear();
    tiles.clear();
    for (const frame of page.items) {
      const tick = frame.state === "deleted" ? null : selected?.box(frame);
      tiles.set(frame.frame_id, tile(frame, { view: viewOf(wanted), signal: both, tick }));
    }
    selected?.keep(new Set(tiles.keys()));
    put(grid, [...tiles.values()]);
    put(place, page.items.length ? grid : nothing());
    grid.removeAttribute("aria-busy");
    last = page;
    drawPager(page);
  }

  async function fetchRuns() {
    runs = await get(`${path}/sessions`, { params: { limit: 1000 }, signal });
    if (last) drawPager(last);
    // what is being typed or chosen in it stays; only other choices are worth another bar
    const names = JSON.stringify(runs.items.map((one) => [one.robot, one.session]));
    const at = document.activeElement;
    if (at === null || !bar.contains(at)) { offer(names); return; }
    at.addEventListener("focusout", () => setTimeout(() => { if (!signal.aborted) offer(names); }), { once: true });
  }

  function offer(names) {
    if (names === offered) return;
    offered = names;
    const before = bar;
    const focused = before.contains(document.activeElement) ? document.activeElement?.id : null;
    bar = filterBar(wanted, runs.items, turn);
    before.replaceWith(bar);
    if (focused) document.getElementById(focused)?.focus();
  }

  function nothing() {
    if (wanted.has("cursor")) return empty({ title: "No more frames", text: "There is no such page.", actions: first("First page") });
    if (!clear.hidden) return empty({ title: "No frame matches", text: "No frame of this map matches all filters.", actions: h("button", { class: "button", type: "button", onClick: () => clear.click() }, "Clear filters") });
    return empty({
      title: "No frames yet",
      text: "Uploaded frames become searchable within moments. This page shows their state live.",
      actions: canWrite && h("a", { class: "button primary", href: link("maps", params.map, "upload") }, "Upload frames"),
    });
  }

  function first(text) {
    return h("button", { class: "button", type: "button", onClick: () => turn({}) }, text);
  }

  function drawPager(page) {
    const number = Math.max(Number.parseInt(wanted.get("page") ?? "1", 10) || 1, 1);
    const from = PAGE * (number - 1);
    const total = countOf(wanted, runs && !runs.next_cursor ? runs.items : null);
    const until = from + page.items.length;
    const of = total !== null && total >= until ? ` of ${count(total)}` : page.next_cursor ? " and more" : ` of ${count(until)}`;
    const words = page.items.length ? [h("strong", {}, `${count(from + 1)}–${count(until)}`), of] : [];
    const back = number > 1 && earlier.length === 0
      ? first("First page")
      : button("Previous", number > 1, () => change({ cursor: earlier.at(-1) ?? null, page: number > 2 ? String(number - 1) : null }, earlier.slice(0, -1)));
    const forth = button("Next", Boolean(page.next_cursor), () => change({ cursor: page.next_cursor, page: String(number + 1) }, [...earlier, wanted.get("cursor")]));
    put(over, h("span", { class: "pager-count" }, words));
    put(under, page.items.length > 0 && (number > 1 || page.next_cursor) && [back, h("span", { class: "muted" }, `Page ${count(number)}`), forth]);
  }

  function button(text, enabled, step) {
    const onClick = async () => {
      await step();
      window.scrollTo({ top: 0 });
      document.getElementById("title").focus({ preventScroll: true });
    };
    return h("button", { class: "button", type: "button", disabled: !enabled, onClick }, text);
  }

  show();
  const counted = fetchRuns(); // begun before 24 pictures queue up for the browser's few connections
  counted.catch(() => {}); // told below, if the list is there to be filtered
  await fetchList().catch((error) => {
    // another list may have been asked for meanwhile
    if (error.status === 422) shownFault(error);
    else if (error.name !== "AbortError" || signal.aborted) throw error;
  });
  counted.catch((error) => { if (error.name !== "AbortError") toast(error.message, { kind: "bad" }); });
  const isFirst = () => !wanted.has("cursor") && wanted.get("order") !== "asc";
  const look = () => { Promise.all([fetchList(), fetchRuns()]).catch(shownFault); };
  const fill = throttle(look, FILL_MS, signal);
  const more = h("button", { class: "button", type: "button", onClick: look });

  function arrived(id) {
    if (!isFirst()) return;
    // a page that is not full fills by itself; a full one is not pulled away under the reader
    if (tiles.size < PAGE && clear.hidden) { fill(); return; }
    if (come.size < MOST_COME) come.add(id);
    put(more, `${come.size < MOST_COME ? things(come.size, "new frame") : `${count(come.size)} or more new frames`}: show`);
    if (!more.isConnected) put(news, more);
  }

  follow({
    map: params.map, signal,
    shown: (id) => tiles.has(id),
    pending: () => [...tiles.values()].filter((one) => isPending(one.frame.state)).map((one) => one.frame.frame_id),
    changed: (frame) => {
      const one = tiles.get(frame.frame_id);
      one?.show({ ...one.frame, ...frame }, viewOf(wanted));
    },
    missed: () => fetchList().catch(shownFault),
    arrived,
    begins: async () => { // what came between the list and the stream was told to nobody
      if (!isFirst() || !clear.hidden) return;
      const { items: [newest] } = await get(`${path}/frames`, { params: { limit: 1, order: "desc" }, signal });
      if (newest && !tiles.has(newest.frame_id)) arrived(newest.frame_id);
    },
  });
}

/** The filters of an address as the API takes them in a body; null where there are none. */
function filterOf(search) {
  const several = ["robot", "session", "tag"];
  const given = FILTERS.filter((name) => search.has(name));
  return given.length ? Object.fromEntries(given.map((name) => [name, several.includes(name) ? search.getAll(name) : search.get(name)])) : null;
}

function viewOf(search) {
  const view = search.get("view");
  return view === "normals" || view === "patches" ? view : "depth";
}
