// The runs beside the picture: which colour and number, how many poses, drawn or not; and which
// runs are not in it, and why.

import { h } from "../lib/dom.js";
import { count, things } from "../lib/format.js";
import { tintOf } from "./scene.js";

/**
 * @param {import("./data.js").Path[]} paths that are drawn
 * @param {Set<number>} hidden their places, changed here
 * @param {() => void} onchange
 */
export function legend(paths, hidden, onchange) {
  const boxes = paths.map((_, i) => h("input", {
    type: "checkbox", checked: !hidden.has(i), onChange: (event) => {
      if (event.target.checked) hidden.delete(i); else hidden.add(i);
      onchange();
    },
  }));
  const all = (shown) => {
    boxes.forEach((box, i) => { box.checked = shown; if (shown) hidden.delete(i); else hidden.add(i); });
    onchange();
  };
  const rows = paths.map((one, i) => h("li", {}, h("label", { class: "paths-run" },
    boxes[i],
    h("span", { class: "paths-label", style: { borderColor: `var(--${tintOf(one)})` }, "aria-hidden": "true" }, String(i + 1)),
    h("span", { class: "paths-name" }, nameOf(one), one.robot !== null && one.robot !== one.session && h("span", { class: "muted" }, ` ${one.robot}`)),
    h("span", { class: "number muted" }, poses(one)))));
  return [
    h("ul", { class: "paths-legend" }, rows),
    paths.length > 2 && h("div", { class: "toolbar" },
      h("button", { class: "button quiet", type: "button", onClick: () => all(true) }, "All"),
      h("button", { class: "button quiet", type: "button", onClick: () => all(false) }, "None")),
  ];
}

/** @param {import("./data.js").Run} run */
export const nameOf = (run) => run.session;

const poses = ({ ids, posed }) => (ids.length < posed ? `${count(ids.length)} of ${count(posed)} poses` : things(posed, "pose"));

/** What of the map is not in the picture, in words. @param {{name: string, frames: number, why: string}[]} without */
export function leftOut(without) {
  if (!without.length) return null;
  return h("details", { class: "paths-left", open: without.length <= 4 },
    h("summary", {}, `Not shown: ${things(without.length, "run")}`),
    h("ul", {}, without.slice(0, 50).map((one) => h("li", {},
      h("strong", {}, one.name), h("span", { class: "muted" }, ` · ${things(one.frames, "frame")}: ${one.why}`)))),
    without.length > 50 && h("p", { class: "muted" }, `and ${count(without.length - 50)} more`));
}
