// The maps: a card each, with what is in them; they are made here, and their counts move by events.
import { at, get, watch } from "../lib/api.js";
import { h, once, put } from "../lib/dom.js";
import { count } from "../lib/format.js";
import { may, me } from "../lib/session.js";
import { empty } from "../lib/states.js";
import { edit, mapCard, waiting } from "./card.js";
import { inView } from "./turns.js";

export const styles = ["maps/maps.css"];

const SOON_MS = 600; // events come in bursts: one look is enough for all of them
const AGAIN_MS = 4000;
const MANY = 6; // from here on one list costs less than each map for itself
const FILTER_FROM = 9;

/** See lib/router.js. */
export async function render(root, { signal, go, title, actions }) {
  title("Maps");
  const cards = new Map();
  const dirty = new Set();
  const view = inView(signal);
  const summary = h("p", { class: "muted number", id: "summary" });
  const wanted = h("input", { id: "find", type: "search", placeholder: "Find a map", "aria-label": "Find a map", onInput: narrow });
  const grid = h("div", { class: "grid maps" });
  const nothing = h("p", { class: "muted", role: "status" });
  /** @type {Timer} */
  let timer = null;

  function draw(items) {
    const names = new Set(items.map((one) => one.name));
    for (const [name, card] of cards) if (!names.has(name)) { view.leave(card.element); card.element.remove(); cards.delete(name); }
    for (const one of items) {
      const known = cards.get(one.name);
      if (known) { known.update(one); continue; }
      const card = mapCard(one, { signal, changed: reload });
      cards.set(one.name, card);
      view.join(card.element, card.fill);
    }
    items.forEach(({ name }, i) => { // those that stand right stay: moving takes the focus from what is in a card
      const { element } = cards.get(name);
      if (grid.children[i] !== element) grid.insertBefore(element, grid.children[i] ?? null);
    });
    if (items.length === 0) { put(root, begin()); return; }
    if (!grid.isConnected) put(root, h("div", { class: "toolbar spread" }, summary, wanted), nothing, grid);
    wanted.hidden = items.length < FILTER_FROM;
    narrow();
    sum();
  }

  function sum() {
    const all = [...cards.values()].map((card) => card.map);
    const of = (state) => all.reduce((n, one) => n + (one.frames[state] ?? 0), 0);
    const parts = [`${count(all.length)} ${all.length === 1 ? "map" : "maps"}`, `${count(of("indexed"))} frames indexed`];
    const rest = all.reduce((n, one) => n + waiting(one), 0);
    if (rest) parts.push(`${count(rest)} waiting`);
    if (of("failed")) parts.push(`${count(of("failed"))} failed`);
    put(summary, parts.join(" · "));
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
    draw((await get(at("maps"), { signal })).items);
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
  function heard({ kind, map }) {
    if (signal.aborted) return;
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
  watch({ kinds: ["map.", "frame."], onevent: heard, onstate: begun, signal });
  signal.addEventListener("abort", () => clearTimeout(timer));
}
