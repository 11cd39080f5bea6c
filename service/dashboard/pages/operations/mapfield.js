// Which map a page of operations tells of.
import { get } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { may } from "../lib/session.js";

/**
 * A field with the maps of this key; "All maps" where it may read them all, or `all` says so.
 * @param {string | null} chosen @param {AbortSignal} signal @param {(map: string | null) => void} change
 * @param {boolean} [all]
 */
export async function mapField(chosen, signal, change, all = true) {
  const names = (await get("maps", { signal })).items.map((one) => one.name);
  if (chosen !== null && !names.includes(chosen)) names.unshift(chosen);
  const select = h("select", { id: "operations-map", onChange: () => change(select.value || null) },
    all && h("option", { value: "" }, may("read") ? "All maps" : "All your maps"),
    names.map((name) => h("option", { value: name, selected: name === chosen }, name)));
  return h("label", { class: "inline-field" }, h("span", { class: "visually-hidden" }, "Map"), select);
}
