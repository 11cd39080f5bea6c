// Frames of the gallery that are ticked, or all that pass its filters: deleted, tagged or moved.
import { h, put } from "../lib/dom.js";
import { count, things } from "../lib/format.js";
import { saveFrom } from "../lib/form.js";
import { confirm, sheet } from "../lib/states.js";
import { deleteFrames, editFrames } from "./changes.js";

/**
 * The bar over the gallery, and the boxes of its tiles.
 * @param {string} map
 * @param {{filter: () => Object<string, any> | null, total: () => number | null, changed: () => any}} how
 *   filter: what the gallery shows, as the API takes it; null where it shows all frames; total: how
 *   many that are, as far as is known
 * @returns {HTMLElement & {box: (frame: Object<string, any>) => HTMLElement, keep: (ids: Set<string>) => void}}
 *   box: that ticks a frame; keep: forget those that are ticked and not among these
 */
export function selectionBar(map, { filter, total, changed }) {
  const ticked = new Set();
  const boxes = new Map(); // by frame
  let all = false; // all that pass the filters, and not the ticked ones alone
  const words = h("strong", { role: "status" });
  const busy = h("span", { class: "muted", role: "status" });
  const every = h("button", { class: "button quiet", type: "button", onClick: () => { all = true; draw(); } });
  const button = (text, act, kind = "") => h("button", { class: `button ${kind}`, type: "button", onClick: act }, text);
  const bar = h("div", { class: "toolbar selection", role: "group", "aria-label": "Selected frames", hidden: true },
    words, every, button("Tag", tag), button("Move to session", move), button("Delete", remove, "danger"), button("Clear selection", clear, "quiet"), busy);

  function box(frame) {
    const id = frame.frame_id;
    const input = h("input", { type: "checkbox", "aria-label": `Select frame ${frame.name ?? id}`, checked: ticked.has(id), onChange: () => {
      if (input.checked) ticked.add(id); else ticked.delete(id);
      all = false;
      draw();
    } });
    boxes.set(id, input);
    return h("label", { class: "tile-tick" }, input);
  }

  function draw() {
    for (const [id, input] of boxes) input.checked = all || ticked.has(id);
    const n = all ? total() : ticked.size;
    bar.hidden = !all && ticked.size === 0;
    put(words, all ? `All ${n === null ? "frames" : things(n, "frame")} that match` : `${count(ticked.size)} selected`);
    every.hidden = all || filter() === null;
    put(every, "Select all that match the filters");
  }

  function clear() {
    ticked.clear();
    all = false;
    draw();
    document.getElementById("title")?.focus({ preventScroll: true }); // the bar is gone
  }

  /** What is selected, as the API takes it. */
  const chosen = () => (all ? { filter: filter() ?? {} } : { frame_ids: [...ticked] });
  const shown = () => (all ? (total() === null ? "all frames that match the filters" : things(total() ?? 0, "frame")) : things(ticked.size, "frame"));
  const how = { say: (text) => put(busy, text), changed: async () => { clear(); await changed(); } };

  async function remove() {
    const what = shown();
    const text = h("p", {}, "Queries no longer find them. You can undo this for a while: the message that follows says until when.");
    if (await confirm({ title: `Delete ${what}?`, text, action: "Delete" })) await deleteFrames(map, chosen(), how);
  }

  function tag() {
    const [add, drop] = [field("Add tags", "selection-add"), field("Remove tags", "selection-drop")];
    form("Tags", [add.row, drop.row], () => {
      const [added, dropped] = [add, drop].map((one) => one.value().split(",").map((text) => text.trim()).filter(Boolean));
      return added.length + dropped.length > 0 && { add_tags: added, remove_tags: dropped };
    });
  }

  function move() {
    const session = field("Session", "selection-session");
    form("Move to a session", [session.row], () => session.value() !== "" && { session: session.value() });
  }

  /** A dialog that edits what is selected, and stays while that is refused. */
  function form(title, rows, edit) {
    const dialog = sheet({ title, buttons: h("button", { class: "button primary" }, "Save"),
      children: [h("p", { class: "dialog-text muted" }, `Of ${shown()}.`), rows, h("p", { class: "field-error", role: "alert" })] });
    saveFrom(dialog, async () => {
      const json = edit();
      return json && editFrames(map, { ...chosen(), ...json }, how).then(() => true);
    });
  }

  function field(label, id) {
    const input = h("input", { id, autocomplete: "off", spellcheck: "false" });
    return { row: h("div", { class: "field" }, h("label", { for: id }, label), input), value: () => input.value.trim() };
  }

  function keep(ids) {
    for (const id of boxes.keys()) if (!ids.has(id)) boxes.delete(id);
    for (const id of ticked) if (!ids.has(id)) ticked.delete(id);
    draw();
  }
  return Object.assign(bar, { box, keep });
}
