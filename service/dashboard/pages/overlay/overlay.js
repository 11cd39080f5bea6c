// What an overlay needs is asked for at once, all of it side by side and beside the code that draws
// it: the service validates the match meanwhile, which takes longest.
import { at, get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { frameLabel, shortId } from "../lib/format.js";
import { coded } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { empty } from "../lib/states.js";
import { overlayParts } from "./parts.js";

export const styles = ["overlay/overlay.css"];

/** @param {HTMLElement} root @param {Object<string, any>} context of the router */
export async function render(root, context) {
  const { params, search, signal, title, home } = context;
  const query = at("queries", params.query), map = search.get("map") ?? undefined;
  title(`Overlay of ${shortId(params.frame)}`);
  const { match, details: detailsOf, points: load, frame } = overlayParts(params.query, params.frame, map, signal);
  const found = async () => {
    const answer = await get(query, { signal });
    const one = answer.matches.find(({ frame_id: id, map: own }) => id === params.frame && (!map || own === map));
    const [asked, matched] = await Promise.all([answer.frame && frame(answer.frame), one ? frame(one) : null]);
    return { answer, asked, matched };
  };
  let told;
  try {
    const [known, details, aligned, { show }] = await Promise.all([
      found(), detailsOf(), load("aligned"), import("./page.js"),
    ]);
    told = { ...known, details, aligned, show };
  } catch (error) {
    const why = missing(error, params.query);
    if (!why) throw error;
    put(root, why);
    return;
  }
  home(map ?? told.answer.maps[0]);
  title(`Overlay of ${frameLabel(told.details)}`);
  if (!signal.aborted) told.show(root, context, { ...told, query, match, map, load });
}

/** What stands in place of the page where what it shows is not kept; null for other faults. */
function missing(error, id) {
  if (error.status === 404 && error.type?.endsWith("unknown-query")) {
    return empty({ title: "This answer has expired", text: coded(error.detail),
      actions: h("a", { class: "button primary", href: "#/" }, "To the maps") });
  }
  if (error.status === 404 || (error.status === 409 && error.type?.endsWith("not-indexed"))) {
    return empty({ title: "There is nothing to overlay", text: coded(error.detail),
      actions: h("a", { class: "button primary", href: link("queries", id) }, "To the answer") });
  }
  return null;
}
