// What an answer says, in one line a lost person understands, and in figures.
import { confidence, count, degrees, frameLabel, metres, percent, shortId, things } from "../lib/format.js";
import { sentence } from "../lib/prose.js";

const STATUS = {
  accepted: { kind: "good", text: "accepted" },
  ambiguous: { kind: "warn", text: "ambiguous" },
  rejected: { kind: "bad", text: "rejected" },
  skipped: { kind: "neutral", text: "skipped" },
};

/** Kind of badge and word. @param {Object<string, any>} validation of a match */
export function statusOf(validation) {
  const known = STATUS[validation.status] ?? STATUS.skipped;
  if (validation.status !== "accepted") return known;
  const weak = validation.strength === "weak";
  return { kind: weak ? "warn" : "good", text: `accepted, ${validation.strength ?? "strong"}` };
}

/** Confidence of a pose that is `found` by default. */
const SURE = 0.99;

/** A frame of one of several maps, as the rows know it. */
export function keyOf(one) {
  return `${one.map}/${one.frame_id}`;
}

/** The likeliest causes of `not_found`. */
const CAUSES = {
  no_frames: "Nothing to compare",
  too_little_in_view: "Too little in view",
  one_plane: "Too few planes in view",
  gravity: "Tilted against gravity",
  other_sensor: "Another kind of sensor",
  scale: "Scale does not fit",
  nothing_alike: "Nothing like it in the map",
};

/**
 * Which of the maps of an answer its poses lie in.
 * @param {Object<string, any>} answer
 * @returns {string}
 */
export function mapOf({ location, alternatives, maps }) {
  return location?.map ?? alternatives[0]?.map ?? maps[0];
}

/** The parent frame that the poses of an answer lie in; null without any. @param {Object<string, any>} answer */
export function parentOf({ location, alternatives, matches }) {
  return (location ?? alternatives[0])?.pose.parent_frame ?? matches.find((one) => one.pose_in_map)?.pose_in_map.parent_frame ?? null;
}

/**
 * The verdict of an answer.
 * @param {Object<string, any>} answer
 * @returns {{kind: string, title: string, cause: string | null, text: string, next: string | null, details: string[]}}
 *   cause: of not found, in a few words; next: what to do
 */
export function verdict(answer) {
  const { why, next } = parts(answer.reason);
  const told = { cause: null, next, details: [] };
  if (answer.status === "found") return { ...told, ...found(answer), title: titled("Found", answer.location), next: null };
  if (answer.status === "ambiguous") {
    const { length, 0: best } = answer.alternatives;
    const these = length === 0 ? "" : length === 1 ? "Do not act on this pose. " : "Do not act on any of these poses. ";
    return { ...told, kind: "warn", title: titled("Ambiguous", best, length > 1 ? "best pose " : ""), text: why,
      next: `${these}Move on and query again, or query with a prior.`,
      details: [...rivalry(answer.alternatives), `${count(answer.counts.accepted)} of ${count(answer.counts.validated)} validated frames accepted`] };
  }
  if (answer.status === "unvalidated") return { ...told, ...unvalidated(answer), kind: "neutral", title: "Not validated" };
  return { ...told, kind: "bad", title: "Not found", cause: CAUSES[answer.cause] ?? null, text: why, details: reasons(answer.matches) };
}

/** How well the second place of an ambiguous answer fits. @param {Object<string, any>[]} alternatives @returns {string[]} */
function rivalry([a, b]) {
  if (!a?.evidence || !b?.evidence || a.evidence.score <= 0) return [];
  const [p, q] = [a, b].map((one) => one.pose.translation);
  return [`pose B, ${metres(Math.hypot(p.x - q.x, p.y - q.y, p.z - q.z))} from A, fits ${percent(b.evidence.score / a.evidence.score)} as well`];
}

/** A verdict with the confidence of a pose. @param {string} word @param {Object<string, any> | null | undefined} place */
function titled(word, place, which = "") {
  return typeof place?.confidence === "number" ? `${word}, ${which}${confidence(place.confidence)} sure` : word;
}

/** @param {Object<string, any>} answer */
function found({ matches, counts, location, maps }) {
  if (location === null) {
    const [best] = matches, { strength } = best.validation;
    return { kind: strength === "weak" ? "warn" : "good",
      text: `The query shows the same place as frame ${frameLabel(best)} in map ${best.map}. Its position is unknown, as no match has a pose.`,
      details: [`${strength ?? "strong"} match`, `${counts.accepted} of ${counts.validated} validated frames accepted`] };
  }
  const p = location.pose.translation, spread = deviation(location.uncertainty?.covariance);
  return { kind: sureness(location),
    text: `In map ${location.map ?? maps[0]}, at x ${number(p.x)}, y ${number(p.y)}, z ${number(p.z)} m in ${location.pose.parent_frame}.`,
    details: [evidenceOf(location), ...grounds(location),
      ...(spread ? [`± ${metres(spread.m)}, ± ${degrees(spread.deg)} (one standard deviation, worst axis)`] : [])] };
}

/** @param {Object<string, any>} answer */
function unvalidated({ matches, counts, deadline_reached: late }) {
  const why = late ? "The deadline passed before a match was accepted." : "Validation was not requested.";
  const [near] = matches.filter((one) => one.validation.status === "skipped").sort((a, b) => a.rank - b.rank);
  const nearest = counts.validated ? "The nearest frame that was not tried" : "The nearest frame";
  return {
    text: near ? `${why} ${nearest} is ${frameLabel(near)} of map ${near.map}, ${percent(near.similarity)} similar; it may or may not show the same place.` : why,
    next: late ? "Allow more time." : null,
  };
}

/** Kind of badge of a pose that is found: look twice at one found with less confidence than the default. @param {Object<string, any>} location */
function sureness({ confidence: sure }) {
  return sure !== null && sure >= SURE ? "good" : "warn";
}

/**
 * What a pose that is found rests on.
 * @param {Object<string, any>} location of an answer
 * @returns {string[]}
 */
export function grounds({ support, guided, votes, strength, verified_by: by, spread_m: shift, spread_deg: turn }) {
  const told = [];
  if (by === "map") told.push("confirmed by the map’s frames");
  if (by === "prior") told.push("several poses fit, and the prior decided");
  if (support === 0) told.push("no accepted match");
  else told.push(support === 1 ? "one view" : `${count(support)} of ${count(votes)} accepted matches agree on this pose${guided > 0 ? `, ${count(guided)} of them guided by the others` : ""}, within ${metres(shift)}, ${degrees(turn)}`);
  if (support > 0) told.push(`${strength} match${support === 1 ? "" : "es"}`);
  const apart = votes - support;
  if (apart > 0) told.push(`${things(apart, "accepted match votes", "accepted matches vote")} for another pose`);
  return told;
}

/** What the confidence of a pose was computed from. @param {Object<string, any>} place location or alternative of an answer */
export function evidenceOf({ evidence, verified_by: by }) {
  if (evidence === null) return "not compared with other places";
  const { planes, frames, excess, rival } = evidence;
  const missing = excess < 0.005 ? "nothing" : percent(excess);
  const place = by === "prior" ? "place that the prior expects" : "place";
  const next = rival < 0.05 ? `no other ${place} fits` : rival > 1.005 ? `another ${place} fits better` : `the next best ${place} fits ${percent(rival)} as well`;
  return `${things(Math.round(planes), "plane")} and ${things(frames, "frame")} of the map agree, ${missing} is missing, ${next}`;
}

/**
 * The sentences of a reason.
 * @param {string} reason
 * @returns {{why: string, next: string | null}} next: what to do, where it is told
 */
export function parts(reason) {
  const end = reason.search(/\. (?=[A-Z])/);
  return end < 0 ? { why: sentence(reason), next: null }
    : { why: sentence(reason.slice(0, end)), next: sentence(reason.slice(end + 2)) };
}

// the same reason of ten candidates is one reason
function reasons(matches) {
  const tally = new Map();
  for (const { validation } of matches) {
    if (validation.status === "skipped") continue;
    const text = validation.reason.replace(/-?\d+(\.\d+)?( ?%| m| deg)/g, "…$2");
    tally.set(text, (tally.get(text) ?? 0) + 1);
  }
  return [...tally].sort((a, b) => b[1] - a[1]).slice(0, 3).map(([text, n]) => `${things(n, "candidate")}: ${text}`);
}

/** Standard deviations of the worst axes of a covariance in the order of ROS. */
export function deviation(covariance) {
  if (!covariance) return null;
  const at = (i) => covariance[7 * i];
  const m = Math.sqrt(Math.max(at(0), at(1), at(2)));
  const deg = Math.sqrt(Math.max(at(3), at(4), at(5))) * 180 / Math.PI;
  return { m, deg };
}

/** What a validation measured: names and texts. @returns {[string, string][]} */
export function figures(validation) {
  const { residual, overlap, plane_overlap: planes, inliers, free_space_violations: through, ambiguity, tilt_deg: tilt } = validation;
  if (overlap === null || overlap === undefined) return [];
  return [
    ["Residual", residual ? `${metres(residual.translation_m)}, ${degrees(residual.rotation_deg)}` : "none"],
    ["Overlap", percent(overlap)],
    ["Plane overlap", percent(planes)],
    ["Inliers", count(inliers)],
    ["Violations", through === null ? "unknown" : percent(through)],
    // rivals are looked for only where nothing else speaks against it, and not of a guided match
    ["Ambiguity", ambiguity === 0 && (validation.status !== "accepted" || validation.search === "guided") ? "–" : percent(ambiguity)],
    ...(tilt === null || tilt === undefined ? [] : [/** @type {[string, string]} */ (["Tilt", degrees(tilt)])]),
  ];
}

/** What differs between two answers, each as a sentence. @returns {string[]} */
export function differences(before, after) {
  const found = [];
  const plain = (status) => status.replace("_", " ");
  if (before.status !== after.status) found.push(`${plain(after.status)} (was ${plain(before.status)})`);
  for (const name of ["passed", "ranked", "selected", "validated", "accepted"]) {
    const [a, b] = [before.counts[name], after.counts[name]];
    if (a !== b) found.push(`${name} ${count(a)} → ${count(b)}`);
  }
  const taken = (answer) => new Set(answer.matches.filter((one) => one.validation.status === "accepted").map(keyOf));
  const [was, now] = [taken(before), taken(after)];
  const short = (key) => shortId(key.slice(key.indexOf("/") + 1));
  const gained = [...now].filter((key) => !was.has(key));
  const lost = [...was].filter((key) => !now.has(key));
  if (gained.length) found.push(`newly accepted: ${gained.map(short).join(", ")}`);
  if (lost.length) found.push(`no longer accepted: ${lost.map(short).join(", ")}`);
  return found;
}

/** A figure without a unit. @param {number | null | undefined} x */
export function number(x) {
  return x === null || x === undefined ? "–" : Number(x.toFixed(2)).toString();
}
