// The frames nearest to one, by signature alone: what a query would begin with.
import { at, send } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { count, frameLabel, frameTitle, percent } from "../lib/format.js";
import { link } from "../lib/router.js";
import { fill } from "../lib/states.js";
import { preview, who } from "./tile.js";

const K = 8;

/**
 * A card with the nearest frames of the same map.
 * @param {Object<string, any>} frame indexed
 * @param {AbortSignal} signal @returns {HTMLElement} it fills itself
 */
export function neighbours(frame, signal) {
  const place = h("div", {});
  const card = h("section", { class: "card", "aria-labelledby": "neighbours-title" },
    h("h2", { id: "neighbours-title" }, "Neighbours"),
    h("p", { class: "muted" }, "The nearest signatures in this map. They are not validated: run a query for that."), place);
  fill(place, async () => {
    const { data } = await send("POST", `${at("maps", frame.map)}/queries`, {
      json: { frame_id: frame.frame_id, k: K, stages: "retrieve", keep: false, record: false }, signal,
    });
    return data.matches.length ? h("ol", { class: "neighbours" }, data.matches.map((one) => tileOf(one, signal)))
      : h("p", { class: "muted" }, "This is the only searchable frame of the map.");
  }, "Loading neighbours");
  return card;
}

function tileOf(match, signal) {
  const told = { frame_id: match.frame_id, name: match.name, map: match.map, state: "indexed" };
  return h("li", { class: "tile", dataset: { frame: match.frame_id } }, h("div", { class: "tile-top" }, preview(told, { width: 192, signal })),
    h("div", { class: "tile-words" },
      h("div", { class: "tile-name" }, h("a", { class: "mono", href: link("maps", match.map, "frames", match.frame_id), title: frameTitle(match) }, frameLabel(match)),
        h("strong", { class: "number" }, percent(match.similarity))),
      h("div", { class: "tile-who" }, who(match)),
      h("div", { class: "tile-when muted number" }, `distance ${count(match.distance)}`)));
}
