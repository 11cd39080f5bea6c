// A small gallery of a map's frames to pick one from, on the page or in a dialog.
import { at, get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { frameLabel, frameTitle } from "../lib/format.js";
import { failed, loading, sheet } from "../lib/states.js";

const A_PAGE = 12;

/**
 * Indexed frames, the newest first, a few at a time.
 * @param {string} map @param {{pictures: any, signal: AbortSignal, onpick: (id: string) => void}} how
 */
export function gallery(map, { pictures, signal, onpick }) {
  const grid = h("ol", { class: "query-picker-grid" });
  /** @type {(string | null)[]} */
  const cursors = [null];
  const typed = h("input", { type: "text", class: "mono", autocomplete: "off", spellcheck: "false", placeholder: "frame id",
    onkeydown: (event) => { if (event.key === "Enter") { event.preventDefault(); take(); } } });
  const session = h("select", { onchange: () => { cursors.length = 1; load(); } }, h("option", { value: "" }, "all sessions"));
  const back = h("button", { type: "button", class: "button", disabled: true, onclick: () => { cursors.pop(); load(); } }, "Newer");
  const next = h("button", { type: "button", class: "button", disabled: true, onclick: () => { cursors.push(next.value); load(); } }, "Older");
  let turn = 0;
  const take = () => { if (typed.value.trim()) onpick(typed.value.trim()); };

  async function load() {
    const own = ++turn;
    put(grid, h("li", { class: "query-picker-wait" }, loading("Frames")));
    try {
      const params = { limit: A_PAGE, order: "desc", state: "indexed", session: session.value, cursor: cursors.at(-1) };
      const page = await get(`${at("maps", map)}/frames`, { params, signal });
      if (own !== turn) return;
      back.disabled = cursors.length === 1;
      next.disabled = page.next_cursor === null;
      next.value = page.next_cursor ?? "";
      put(grid, page.items.length === 0 && h("li", { class: "muted" }, "No indexed frame."), page.items.map((one) => h("li", {},
        h("button", { type: "button", class: "query-pick", title: frameTitle(one), "aria-label": `Use frame ${frameTitle(one)}`, onclick: () => onpick(one.frame_id) },
          pictures.frame(map, one.frame_id, "depth", `Preview of frame ${frameLabel(one)}`),
          h("span", { class: "mono" }, frameLabel(one)), h("small", { class: "muted" }, one.session ?? "")))));
    } catch (error) {
      if (own === turn && error.name !== "AbortError") put(grid, h("li", { class: "query-picker-wait" }, failed(error, load)));
    }
  }

  load();
  get(`${at("maps", map)}/sessions`, { params: { limit: 100 }, signal }).then((page) => {
    const names = new Set(page.items.map((one) => one.session).filter(Boolean));
    session.append(...[...names].map((value) => h("option", { value }, value)));
  }, () => {}); // the gallery itself tells what is wrong
  return h("div", { class: "query-gallery" },
    h("div", { class: "toolbar query-gallery-bar" }, h("label", { class: "field" }, h("span", {}, "Session"), session),
      h("label", { class: "field" }, h("span", {}, "By id"), typed), h("button", { type: "button", class: "button", onclick: take }, "Use this id"),
      h("span", { class: "toolbar query-gallery-pages" }, back, next)), grid);
}

/**
 * The same in a dialog.
 * @param {string} map @param {{pictures: any, signal: AbortSignal, title?: string}} how
 * @returns {Promise<string | null>} the id of a frame; null where none was picked
 */
export function pickFrame(map, { pictures, signal, title = "Pick a frame" }) {
  return new Promise((resolve) => {
    const shown = gallery(map, { pictures, signal, onpick: (id) => dialog.close(id) });
    const dialog = sheet({ title, children: [shown], buttons: [] });
    dialog.classList.add("query-picker");
    dialog.querySelector("form").addEventListener("submit", (event) => event.preventDefault());
    dialog.addEventListener("close", () => resolve(dialog.returnValue || null));
    signal.addEventListener("abort", () => dialog.close(), { once: true });
  });
}
