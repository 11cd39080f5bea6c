// The query of an answer that is kept: where it is among the paths, how surely, and what it matched.
import { at, get } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { confidence, count, metres, shortId } from "../lib/format.js";
import { coded } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { STATUSES } from "../lib/statuses.js";
import { alternativesList } from "../query/alternatives.js";
import { evidenceOf, grounds, mapOf, verdict } from "../query/words.js";
import { inverseRigid, multiply, ofRows } from "../viewer/matrix.js";
import { axesOf, SIGMAS } from "./shapes.js";

/**
 * @typedef {{id: string, status: string, kind: "depth" | "cloud", parent: string | null, pose: number[] | null,
 *   axes: {deviation: number, axis: number[]}[] | null, alternatives: Object<string, any>[],
 *   matches: {frame: string, parent: string, pose: number[], voted: number[]}[],
 *   voting: number, location: Object<string, any> | null, said: ReturnType<typeof verdict>, elsewhere: string | null}} Asked
 *   pose: of the query's sensor in `parent`, where it is found; matches: those that vote for a pose,
 *   accepted or ambiguous, and whose place is known; voted: the query's pose by one of them
 */

/**
 * @param {string} query its id
 * @param {string} map that is looked at
 * @returns {Promise<Asked>}
 */
export async function answerOf(query, map, signal) {
  const answer = await get(at("queries", query), { signal });
  const voting = answer.matches.filter((one) => ["accepted", answer.status].includes(one.validation.status));
  const here = voting.filter((one) => one.map === map && one.pose_in_map && one.transform);
  const isHere = mapOf(answer) === map;
  const location = isHere ? answer.location : null, alternatives = isHere ? answer.alternatives : [];
  return {
    id: query, status: answer.status, kind: answer.kind, voting: voting.length, location, alternatives,
    said: verdict(answer), parent: (location ?? alternatives[0])?.pose.parent_frame ?? null,
    pose: location && ofRows(location.pose.matrix),
    axes: location?.uncertainty ? axesOf(block(location.uncertainty.covariance)) : null,
    // T_parent_match = T_parent_query T_query_match
    matches: here.map((one) => ({
      frame: one.frame_id, parent: one.pose_in_map.parent_frame, voted: ofRows(one.pose_in_map.matrix),
      pose: multiply(ofRows(one.pose_in_map.matrix), inverseRigid(ofRows(one.transform.matrix))),
    })),
    elsewhere: !isHere && (answer.location || answer.alternatives.length) ? mapOf(answer) : null,
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
  const { location, alternatives, said, status } = asked;
  return h("section", { class: "card paths-section", "aria-labelledby": "paths-asked" },
    h("div", { class: "paths-row" },
      h("h2", { id: "paths-asked" }, h("span", { class: "paths-key", dataset: { kind: "query" } }), "Query"),
      h("span", { class: "badge", dataset: { kind: said.kind } }, STATUSES[status][1])),
    location && foundFacts(asked),
    status !== "found" && [h("p", {}, coded(said.text)), said.next && h("p", { class: "muted" }, coded(said.next))],
    alternatives.length > 0 && alternativesList(alternatives),
    asked.elsewhere !== null && h("p", { class: "muted" }, `Its poses lie in another map, ${asked.elsewhere}.`),
    status === "found" && !location && asked.elsewhere === null && h("p", { class: "muted" }, "Its matches have no poses, so its position is unknown."),
    asked.matches.length > 0 && h("p", { class: "muted" },
      `${count(asked.matches.length)} of ${count(asked.voting)} ${status === "ambiguous" ? "matches" : "accepted matches"} have a position here; `,
      "a line leads from each to the pose that it gives the query."),
    asked.parent !== null && !drawn && h("p", { class: "paths-note" }, "Its coordinate frame is not shown. ",
      h("button", { class: "button", type: "button", onClick: onshow }, `Draw ${asked.parent}`)),
    h("div", { class: "toolbar" },
      h("a", { class: "button", href: link("queries", asked.id) }, "The answer"),
      h("button", { class: "button quiet", type: "button", onClick: onclose }, "Hide it")),
    h("span", { class: "visually-hidden" }, `Query ${shortId(asked.id)}`));
}

function foundFacts({ location, parent, axes }) {
  const sure = axes?.map((one) => metres(one.deviation * SIGMAS)).join(" × ");
  return h("dl", { class: "paths-facts" },
    fact("In frame", h("span", { class: "mono" }, parent)),
    fact("Confidence", confidence(location.confidence)),
    fact("Evidence", evidenceOf(location)),
    fact("Rests on", grounds(location).join("; ")),
    sure && fact("95 % ellipsoid", `± ${sure}`));
}

const fact = (name, value) => [h("dt", {}, name), h("dd", {}, value)];
