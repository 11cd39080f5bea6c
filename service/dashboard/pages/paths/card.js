// The frame that was chosen: by a click near its frustum, or along a run with the keyboard.

import { at } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { count, metres, shortId, time } from "../lib/format.js";
import { picture } from "../lib/picture.js";
import { link } from "../lib/router.js";
import { placeOf } from "./shapes.js";

/**
 * @param {{map: string, signal: AbortSignal, onchoose: (one: {path: number, place: number} | null) => void,
 *   onapproach: () => void}} how
 * @returns {{element: HTMLElement, paths: (paths: any[]) => void,
 *   show: (one: {path: number, place: number} | null) => void,
 *   readonly chosen: {path: number, place: number} | null}}
 */
export function chooser({ map, signal, onchoose, onapproach }) {
  let drawn = [], chosen = null;
  const runs = h("select", { id: "paths-run", onChange: () => onchoose({ path: Number(runs.value), place: 0 }) });
  const along = h("input", {
    type: "range", id: "paths-along", min: 0, max: 0, value: 0,
    onInput: () => onchoose({ path: Number(runs.value), place: Number(along.value) }),
  });
  const where = h("span", { class: "number muted" });
  const card = h("div", { class: "paths-chosen", role: "status" });
  const element = h("section", { class: "card paths-section", "aria-labelledby": "paths-frame" },
    h("h2", { id: "paths-frame" }, "Frame"),
    h("div", { class: "paths-along" },
      h("label", { class: "field" }, h("span", {}, "Run"), runs),
      h("label", { class: "field" }, h("span", { class: "paths-row" }, "Position in the run", where), along)),
    card);

  function show(one) {
    chosen = one;
    const path = one && drawn[one.path];
    put(where, path ? `${count(one.place + 1)} of ${count(path.ids.length)}` : "");
    if (!path) {
      put(card, h("p", { class: "muted" }, "Select a frame in the picture, or step along a run here."));
      return;
    }
    runs.value = String(one.path);
    along.max = String(path.ids.length - 1);
    along.value = String(one.place);
    along.setAttribute("aria-valuetext", `frame ${one.place + 1} of ${path.ids.length}`);
    const id = path.ids[one.place];
    const [x, y, z] = placeOf(path.poses[one.place]);
    put(card,
      h("div", { class: "paths-preview" }, picture(at("maps", map, "frames", id, "preview.png"), { view: "depth", width: 160 },
        { alt: `Depth image of frame ${id}`, width: 160, height: 120, signal })),
      h("div", { class: "paths-told" },
        h("a", { class: "mono", href: link("maps", map, "frames", id), title: id }, shortId(id)),
        h("span", {}, path.session, path.robot !== null && path.robot !== path.session && h("span", { class: "muted" }, ` ${path.robot}`)),
        h("span", { class: "muted" }, whenOf(path, one.place)),
        h("span", { class: "muted number" }, `${[x, y, z].map((v) => v.toFixed(2)).join(", ")} m in ${path.parent}`),
        h("div", { class: "toolbar" },
          h("button", { class: "button", type: "button", onClick: onapproach }, "Go to it"),
          h("a", { class: "button", href: link("maps", map, "query", { frame: id }) }, "Query with it"),
          h("button", { class: "button quiet", type: "button", onClick: () => onchoose(null) }, "Done"))));
  }

  return {
    element, show,
    paths(paths) {
      drawn = paths;
      put(runs, paths.map((one, i) => h("option", { value: i }, `${i + 1} · ${one.session}${one.robot === null || one.robot === one.session ? "" : ` (${one.robot})`}`)));
      along.disabled = runs.disabled = paths.length === 0;
      along.max = String(Math.max((paths[0]?.ids.length ?? 1) - 1, 0));
      show(null);
    },
    get chosen() { return chosen; },
  };
}

/** How long a way is, over the poses that are drawn. @param {number[][]} poses */
export function wayOf(poses) {
  let sum = 0;
  for (let i = 1; i < poses.length; i += 1) {
    const [a, b] = [placeOf(poses[i - 1]), placeOf(poses[i])];
    sum += Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
  }
  return metres(sum);
}

/** When a frame of a path was taken or came, or its place in the session. @param {import("./data.js").Path} path @param {number} i */
function whenOf({ stamps, times }, i) {
  if (stamps === "sequence") return `Number ${times[i]} of the session`;
  return [stamps === "captured" ? "Taken " : "Received ", time(new Date(1000 * times[i]).toISOString())];
}
