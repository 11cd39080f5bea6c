// What an overlay needs is asked for at once, all of it side by side and beside the code that draws
// it: the service validates the match meanwhile, which takes longest.
import { at, bytes, get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { frameLabel, shortId } from "../lib/format.js";
import { link } from "../lib/router.js";
import { empty } from "../lib/states.js";
import { parsePoints } from "../viewer/points.js";

export const styles = ["overlay/overlay.css"];

const POINTS = "application/vnd.sceneprint.points";
/** The API's word for a pose. */
export const TRANSFORM = { before: "none", aligned: "aligned", rival: "rival" };

/** @param {HTMLElement} root @param {Object<string, any>} context of the router */
export async function render(root, context) {
  const { params, search, signal, title } = context;
  const query = at("queries", params.query), match = at("queries", params.query, "matches", params.frame);
  const map = search.get("map") ?? undefined;
  title(`Overlay of ${shortId(params.frame)}`);
  const load = async (pose) => {
    const side = async (one) => parsePoints(await bytes(`${match}/points`, {
      params: { map, side: one, transform: TRANSFORM[pose] }, signal, accept: POINTS,
    }));
    const [a, b] = await Promise.all([side("query"), side("match")]);
    return { query: a, match: b };
  };
  // cameras and names are for the eye alone: the page does without where a frame has gone
  const frame = (one) => get(at("maps", one.map, "frames", one.frame_id), { signal }).catch((error) => {
    if (error.name === "AbortError" || error.status === 401) throw error;
    return null;
  });
  const found = async () => {
    const answer = await get(query, { signal });
    const one = answer.matches.find(({ frame_id: id, map: own }) => id === params.frame && (!map || own === map));
    const [asked, matched] = await Promise.all([answer.frame && frame(answer.frame), one ? frame(one) : null]);
    return { answer, asked, matched };
  };
  let told;
  try {
    const [known, details, aligned, { show }] = await Promise.all([
      found(), get(match, { params: { map }, signal }), load("aligned"), import("./page.js"),
    ]);
    told = { ...known, details, aligned, show };
  } catch (error) {
    const why = missing(error, params.query);
    if (!why) throw error;
    put(root, why);
    return;
  }
  title(`Overlay of ${frameLabel(told.details)}`);
  if (!signal.aborted) told.show(root, context, { ...told, query, match, map, load });
}

/** What stands in place of the page where what it shows is not kept; null for other faults. */
function missing(error, id) {
  if (error.status === 404 && error.type?.endsWith("unknown-query")) {
    return empty({ title: "This answer has expired", text: error.detail,
      actions: h("a", { class: "button primary", href: "#/" }, "To the maps") });
  }
  if (error.status === 404 || (error.status === 409 && error.type?.endsWith("not-indexed"))) {
    return empty({ title: "There is nothing to overlay", text: error.detail,
      actions: h("a", { class: "button primary", href: link("queries", id) }, "To the answer") });
  }
  return null;
}
