// The places of an ambiguous answer side by side: the query, and the map as its frames saw it near each pose.
import { h, put } from "../lib/dom.js";
import { degrees, frameLabel, metres } from "../lib/format.js";
import { link } from "../lib/router.js";
import { ofRows } from "../viewer/matrix.js";
import { alternativesList, letterOf, voteOf } from "./alternatives.js";
import { mapOf, parentOf } from "./words.js";

const TURN_DEG = 45; // of two views, as far apart as a metre

/**
 * @param {Object<string, any>} answer
 * @param {{backdrops: ReturnType<typeof import("../plan/backdrop.js").backdrops>, pictures: any, signal: AbortSignal}} how
 * @returns {HTMLElement | null} null without alternatives
 */
export function placesPanel(answer, { backdrops, pictures, signal }) {
  const { alternatives, frame, query_id: id } = answer;
  if (alternatives.length === 0) return null;
  const alt = "Picture of the query";
  const body = h("div", {});
  const draw = (backdrop) => {
    if (!signal.aborted) put(body, alternativesList(alternatives, (i) => view(answer, i, backdrop, pictures)));
  };
  backdrops(mapOf(answer), parentOf(answer)).then(draw, () => draw(null)); // the plan says why there is none
  return h("section", { class: "card query-places", "aria-labelledby": "query-places" },
    h("h2", { id: "query-places" }, alternatives.length > 1 ? "The possible places, side by side" : "The possible place"),
    h("div", { class: "query-places-body" },
      h("figure", { class: "query-places-asked" }, frame ? pictures.frame(frame.map, frame.frame_id, "depth", alt) : pictures.query(id, "depth", alt),
        h("figcaption", {}, h("strong", {}, "The query"))), body));
}

/** What the map looks like from an alternative: the frame taken nearest to it, else one that votes for it. */
function view(answer, i, backdrop, pictures) {
  const { pose } = answer.alternatives[i], map = mapOf(answer), letter = letterOf(i);
  const near = backdrop?.parent === pose.parent_frame ? nearest(ofRows(pose.matrix), backdrop.runs) : null;
  const voter = answer.matches.find((one) => one.map === map && voteOf(answer, one) === `for pose ${letter}`);
  const id = near?.id ?? voter?.frame_id;
  if (!id) return null;
  return h("figure", { class: "alternatives-view" }, pictures.frame(map, id, "depth", `The map near pose ${letter}`),
    h("figcaption", { class: "muted" }, h("a", { class: "mono", href: link("maps", map, "frames", id) }, frameLabel(voter?.frame_id === id ? voter : { frame_id: id })),
      near ? `, taken ${metres(near.metres)}, ${degrees(near.degrees)} away` : ", which votes for it"));
}

/**
 * The frame that was taken nearest to a pose, and looks the same way.
 * @param {number[]} pose 16 column-major @param {import("../plan/backdrop.js").Run[]} runs
 * @returns {{id: string, metres: number, degrees: number} | null}
 */
export function nearest(pose, runs) {
  /** @type {{id: string, metres: number, degrees: number} | null} */
  let best = null;
  let least = Infinity;
  for (const { ids, poses } of runs) {
    poses.forEach((own, k) => {
      const away = Math.hypot(own[12] - pose[12], own[13] - pose[13], own[14] - pose[14]);
      const trace = [0, 1, 2, 4, 5, 6, 8, 9, 10].reduce((sum, at) => sum + own[at] * pose[at], 0);
      const turn = (Math.acos(Math.min(Math.max((trace - 1) / 2, -1), 1)) * 180) / Math.PI;
      if (away + turn / TURN_DEG >= least) return;
      least = away + turn / TURN_DEG;
      best = { id: ids[k], metres: away, degrees: turn };
    });
  }
  return best;
}
