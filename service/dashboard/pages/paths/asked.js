// The query of an answer that is kept: where it is among the paths, how surely, and what it matched.

import { at, get } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { count, degrees, metres, shortId } from "../lib/format.js";
import { link } from "../lib/router.js";
import { inverseRigid, multiply, ofRows } from "../viewer/matrix.js";
import { axesOf, SIGMAS } from "./shapes.js";

/**
 * @typedef {{id: string, status: string, kind: "depth" | "cloud", parent: string | null, pose: number[] | null,
 *   axes: {deviation: number, axis: number[]}[] | null,
 *   matches: {frame: string, parent: string, pose: number[], strength: string}[],
 *   accepted: number, location: Object<string, any> | null, elsewhere: string | null}} Asked
 *   pose: of the query's sensor in `parent`; matches: accepted ones whose place is known
 */

/**
 * @param {string} query its id
 * @param {string} map that is looked at
 * @returns {Promise<Asked>}
 */
export async function answerOf(query, map, signal) {
  const answer = await get(at("queries", query), { signal });
  const accepted = answer.matches.filter((one) => one.validation.status === "accepted");
  const here = accepted.filter((one) => one.map === map && one.pose_in_map && one.transform);
  const location = answer.location && (answer.location.map ?? map) === map ? answer.location : null;
  return {
    id: query, status: answer.status, kind: answer.kind, accepted: accepted.length, location,
    parent: location?.pose.parent_frame ?? null,
    pose: location && ofRows(location.pose.matrix),
    axes: location?.uncertainty ? axesOf(block(location.uncertainty.covariance)) : null,
    // T_parent_match = T_parent_query T_query_match
    matches: here.map((one) => ({
      frame: one.frame_id, parent: one.pose_in_map.parent_frame, strength: one.validation.strength,
      pose: multiply(ofRows(one.pose_in_map.matrix), inverseRigid(ofRows(one.transform.matrix))),
    })),
    elsewhere: answer.location && !location ? answer.location.map : null,
  };
}

/** Covariance of the place: the upper left of 6 x 6. @param {number[]} numbers row by row */
function block(numbers) {
  return [0, 1, 2].map((i) => [0, 1, 2].map((j) => numbers[6 * i + j]));
}

/**
 * What is said of the query beside the picture.
 * @param {Asked} asked
 * @param {{drawn: boolean, onshow: () => void, onclose: () => void}} how drawn: whether its frame of
 *   reference is that of the picture, or joined to it
 */
export function askedPanel(asked, { drawn, onshow, onclose }) {
  const { location } = asked;
  const sure = asked.axes?.map((one) => metres(one.deviation * SIGMAS)).join(" × ");
  return h("section", { class: "card paths-section", "aria-labelledby": "paths-asked" },
    h("div", { class: "paths-row" },
      h("h2", { id: "paths-asked" }, h("span", { class: "paths-key", dataset: { kind: "query" } }), "Query"),
      h("span", { class: "badge", dataset: { kind: asked.status === "found" ? "good" : "warn" } }, asked.status.replace("_", " "))),
    location ? h("dl", { class: "paths-facts" },
      fact("In frame", h("span", { class: "mono" }, asked.parent)),
      fact("Agreeing", `${count(location.support)} of ${count(location.votes)} matches, ${metres(location.spread_m)}, ${degrees(location.spread_deg)} apart`),
      sure && fact("95 % ellipsoid", `± ${sure}`))
      : h("p", { class: "muted" }, asked.elsewhere
        ? `It was found in another map, ${asked.elsewhere}.`
        : asked.accepted ? "Its matches have no poses, so its position is unknown." : "No match was accepted, so it has no position."),
    asked.accepted > 0 && h("p", { class: "muted" },
      `${count(asked.matches.length)} of ${count(asked.accepted)} accepted matches have a position here; `,
      "a line leads to each."),
    location && !drawn && h("p", { class: "paths-note" }, "It lies in a coordinate frame that is not shown. ",
      h("button", { class: "button", type: "button", onClick: onshow }, `Draw ${asked.parent}`)),
    h("div", { class: "toolbar" },
      h("a", { class: "button", href: link("queries", asked.id) }, "The answer"),
      h("button", { class: "button quiet", type: "button", onClick: onclose }, "Hide it")),
    h("span", { class: "visually-hidden" }, `Query ${shortId(asked.id)}`));
}

const fact = (name, value) => [h("dt", {}, name), h("dd", {}, value)];
