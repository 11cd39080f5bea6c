// Depth, normals or patches: three buttons of which one is pressed.
import { h } from "../lib/dom.js";

/** What a picture of a frame can show. */
export const VIEWS = [["depth", "Depth"], ["normals", "Normals"], ["patches", "Patches"]];

/**
 * A switch between views; `show(view)` presses the button of one.
 * @param {string} view @param {(view: string) => void} choose @param {string[][]} [views] value and words of each
 * @param {string} [label] @returns {HTMLElement & {show: (view: string) => void}}
 */
export function viewSwitch(view, choose, views = VIEWS, label = "View") {
  const buttons = views.map(([value, text]) => h("button", {
    type: "button", dataset: { value }, onClick: () => { show(value); choose(value); },
  }, text));
  function show(wanted) {
    for (const one of buttons) one.setAttribute("aria-pressed", String(one.dataset.value === wanted));
  }
  show(view);
  return Object.assign(h("div", { class: "switch", role: "group", "aria-label": label }, buttons), { show });
}
