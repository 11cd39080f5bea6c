// The poses of an ambiguous answer: of one rank, each with what speaks for it; none is the answer.
import { h } from "../lib/dom.js";
import { confidence, degrees, metres, percent, things } from "../lib/format.js";
import { apart } from "../overlay/words.js";
import { evidenceOf, number } from "./words.js";

/** What an alternative is called, in lists and on the map: A, B, C. @param {number} i from 0 */
export const letterOf = (i) => String.fromCharCode(65 + i);

const SAME = { metres: 0.25, degrees: 15 }; // votes so near each other are for one place

/** Which pose a match speaks for, where that is not the answer's. @param {Object<string, any>} match one of it */
export function voteOf({ location, alternatives }, { pose_in_map: own, validation }) {
  if (!own || !["accepted", "ambiguous"].includes(validation.status)) return null;
  const isFor = (pose) => {
    const away = apart(pose, own);
    return pose.parent_frame === own.parent_frame && away.metres <= SAME.metres && away.degrees <= SAME.degrees;
  };
  const i = alternatives.findIndex((one) => isFor(one.pose));
  if (i >= 0) return `for pose ${letterOf(i)}`;
  return (location === null && alternatives.length === 0) || (location && isFor(location.pose)) ? null : "for another pose";
}

/**
 * The list, for a wide card and a narrow one.
 * @param {Object<string, any>[]} alternatives of an answer
 * @param {(i: number) => any} [view] of the map near an alternative
 */
export function alternativesList(alternatives, view = () => null) {
  const [first] = alternatives;
  return h("div", { class: "alternatives" },
    h("p", { class: "muted" }, "In ", h("span", { class: "mono" }, first.pose.parent_frame), ", metres.", alternatives.length > 1 && " At most one is right."),
    h("ol", { "aria-label": "Alternatives" }, alternatives.map((one, i) => alternative(one, i, first, view(i)))));
}

/** @param {Object<string, any>} one @param {number} i @param {Object<string, any>} first @param {any} view */
function alternative(one, i, first, view) {
  const { pose, confidence: sure, support, evidence } = one;
  const { x, y, z } = pose.translation, away = apart(pose, first.pose);
  return h("li", {}, view,
    h("span", { class: "alternatives-letter" }, letterOf(i)),
    h("span", { class: "alternatives-place number" }, `x ${number(x)}, y ${number(y)}, z ${number(z)}`,
      i > 0 && h("span", { class: "muted" }, ` · ${metres(away.metres)}, ${degrees(away.degrees)} from A`)),
    h("dl", {},
      figure("Confidence", confidence(sure), sure),
      evidence && figure("Score", percent(evidence.score), evidence.score),
      figure("Support", support === 0 ? "the map alone" : things(support, "match", "matches"))),
    h("p", { class: "alternatives-why muted" }, evidenceOf(one)));
}

/** A figure with a bar. @param {number | null} [share] none: without */
function figure(term, value, share = null) {
  return h("div", {}, h("dt", {}, term), h("dd", { class: "number" }, value),
    share !== null && h("span", { class: "alternatives-bar", "aria-hidden": "true" },
      h("span", { style: { width: `${(100 * Math.min(1, Math.max(0, share))).toFixed(1)}%` } })));
}
