// The fleet: whether all is well, and a card for each map, whose robots and counts move by events.
import { at, get, watch } from "../lib/api.js";
import { h, inView, once, put } from "../lib/dom.js";
import { things } from "../lib/format.js";
import { may, me } from "../lib/session.js";
import { coded } from "../lib/prose.js";
import { empty } from "../lib/states.js";
import { edit, mapCard } from "./card.js";
import { conditionOf, isNews } from "./condition.js";

export const styles = ["maps/maps.css"];

const SOON_MS = 600; // events come in bursts: one look is enough for all of them
const AGAIN_MS = 4000;
const FAILURES = 50; // jobs that are looked through
const MANY = 6; // from here on one list costs less than each map for itself
const FILTER_FROM = 9;
const AT_ONCE = 3; // cards that are filled
const RENEW_MS = 60_000; // the last hour moves on without an event

/** See lib/router.js. */
export async function render(root, { signal, go, actions }) {
  const cards = new Map();
  const dirty = new Set();
  const viewed = inView(signal, AT_ONCE);
  const summary = h("p", { class: "muted number", id: "summary" });
  const health = h("p", { class: "fleet-health", role: "status" });
  /** @type {Object<string, any>[]} */
  let failures = [];
  const wanted = h("input", { id: "find", type: "search", placeholder: "Find a map", "aria-label": "Find a map", onInput: narrow });
  const grid = h("div", { class: "grid maps" });
  const nothing = h("p", { class: "muted", role: "status" });
  /** @type {Timer} */
  let timer = null;

  function draw(items) {
    const names = new Set(items.map((one) => one.name));
    for (const [name, card] of cards) if (!names.has(name)) { card.element.remove(); cards.delete(name); }
    for (const one of items) {
      const known = cards.get(one.name);
      if (known) { known.update(one); continue; }
      const card = mapCard(one, { signal, changed: reload });
      cards.set(one.name, card);
      viewed(card.element, card.fill);
    }
    items.forEach(({ name }, i) => { // those that stand right stay: moving takes the focus from what is in a card
      const { element } = cards.get(name);
      if (grid.children[i] !== element) grid.insertBefore(element, grid.children[i] ?? null);
    });
    if (items.length === 0) { put(root, begin()); return; }
    if (!grid.isConnected) put(root, h("div", { class: "toolbar spread" }, health, summary, wanted), nothing, grid);
    wanted.hidden = items.length < FILTER_FROM;
    narrow();
    sum();
  }

  function sum() {
    const all = [...cards.values()].map((card) => card.map);
    const indexed = all.reduce((n, one) => n + (one.frames.indexed ?? 0), 0);
    put(summary, `${things(all.length, "map")} · ${things(indexed, "frame")} indexed`);
    const { kind, text, href } = conditionOf(all, failures);
    if (health.dataset.text === text) return; // it is told to screen readers
    Object.assign(health.dataset, { kind, text });
    put(health, href ? h("a", { href }, coded(text)) : coded(text));
  }

  function narrow() {
    const text = wanted.hidden ? "" : wanted.value.trim().toLowerCase();
    let left = 0;
    for (const { map, element } of cards.values()) {
      element.hidden = !`${map.name} ${map.title ?? ""}`.toLowerCase().includes(text);
      left += element.hidden ? 0 : 1;
    }
    put(nothing, left === 0 && `No map matches “${wanted.value}”.`);
  }

  async function reload() {
    const [found, ...failed] = await Promise.all([get("maps", { signal }), ...["dead", "failed"].map((state) => get("jobs", { params: { state, limit: FAILURES }, signal }))]);
    failures = failed.flatMap((page) => page.items.filter(isNews));
    draw(found.items);
  }

  // one look at a time: an older answer must not come after a newer one
  async function look() {
    const [...asked] = dirty;
    let rest = SOON_MS;
    try {
      await lookAt();
    } catch (error) {
      if (error.name === "AbortError" || !(error.status === 0 || error.status === 429 || error.status >= 500)) throw error;
      for (const one of asked) dirty.add(one);
      rest = AGAIN_MS;
    } finally {
      timer = dirty.size && !signal.aborted ? setTimeout(look, rest) : null;
    }
  }

  async function lookAt() {
    const names = [...dirty].filter((name) => cards.has(name));
    const all = dirty.has(null) || names.length > MANY;
    dirty.clear();
    if (all) { await reload(); return; }
    await Promise.all(names.map(async (name) => {
      try {
        cards.get(name)?.update(await get(at("maps", name), { signal }));
      } catch (error) {
        if (error.status !== 404) throw error; // it was removed; the event of that follows
      }
    }));
    sum();
  }

  /** @param {any} event */
  function heard({ kind, map, ...event }) {
    if (signal.aborted) return;
    if (kind === "query.answered") { cards.get(map)?.answered(event); return; }
    if (kind === "surface.updated") { cards.get(map)?.draw(); return; }
    if (kind === "events.missed") for (const one of cards.values()) one.read();
    // of no map, of another set of maps, or of what was missed: look at all
    dirty.add(kind.startsWith("map.") || kind === "events.missed" ? null : map);
    timer ??= setTimeout(look, SOON_MS);
  }

  let began = false;
  function begun(state) { // what happened between the list and the stream was told by neither
    if (state === "live" && !began) { began = true; heard({ kind: "events.missed" }); }
  }

  const mayMake = may("admin") || Object.values(me()?.grants ?? {}).includes("admin");
  const make = once(async () => (await edit()).createMap(go, signal));
  const button = (id) => h("button", { class: "button primary", type: "button", id, onClick: make }, "New map");
  const begin = () => empty({
    title: "No maps yet",
    text: mayMake
      ? "A map holds the frames of one place, signed with one model. Create one, then upload depth images or point clouds. Workers sign them, and you can query the map with any frame."
      : "Your key cannot read any map and cannot create one. Ask the operator of this service for another key.",
    actions: mayMake ? button("first-map") : null,
  });

  await reload();
  if (mayMake) actions(button("new-map"));
  watch({ kinds: ["map.", "frame.", "query.answered", "surface.updated"], onevent: heard, onstate: begun, signal });
  const renewal = setInterval(() => { dirty.add(null); timer ??= setTimeout(look, 0); }, RENEW_MS);
  signal.addEventListener("abort", () => { clearTimeout(timer); clearInterval(renewal); });
}
