// What an answer says, in one line a lost person understands, and in figures.
import { count, degrees, metres, percent, shortId } from "../lib/format.js";

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

/** A frame of one of several maps, as the rows know it. */
export function keyOf(one) {
  return `${one.map}/${one.frame_id}`;
}

/**
 * The verdict of an answer.
 * @param {Object<string, any>} answer
 * @returns {{kind: string, shape: string, title: string, text: string, details: any[]}}
 */
export function verdict(answer) {
  const { counts, matches, location } = answer;
  const where = answer.maps.length > 1 ? `${answer.maps.length} maps` : `map ${answer.maps[0]}`;
  if (answer.status === "found") {
    const best = matches[0];
    const sure = best.validation.strength === "weak" ? "weak" : "strong";
    const kind = sure === "weak" ? "warn" : "good";
    if (location === null) {
      return { kind, shape: "✓", title: "Found",
        text: `The query shows the same place as frame ${shortId(best.frame_id)} in map ${best.map}. Its position is unknown, as no match has a pose.`,
        details: [`${sure} match`, `${counts.accepted} of ${counts.validated} validated frames accepted`] };
    }
    const p = location.pose.translation;
    const spread = deviation(location.uncertainty?.covariance);
    return { kind, shape: "✓", title: "Found",
      text: `In map ${location.map ?? best.map}, at x ${number(p.x)}, y ${number(p.y)}, z ${number(p.z)} m in ${location.pose.parent_frame}.`,
      details: [`${location.support} of ${location.votes} matches agree`, `best match ${sure}`,
        spread && `± ${metres(spread.m)}, ± ${degrees(spread.deg)} (one standard deviation, worst axis)`,
        location.votes > 1 && `they lie ${metres(location.spread_m)}, ${degrees(location.spread_deg)} apart`].filter(Boolean) };
  }
  if (answer.status === "ambiguous") {
    const fits = matches.filter((one) => one.validation.status === "ambiguous");
    return { kind: "warn", shape: "≈", title: "Ambiguous, so not found",
      text: `${fits.length === 1 ? `Frame ${shortId(fits[0].frame_id)} fits` : `${fits.length} frames fit`} the query, but in more than one way: the shared view does not determine the place.`,
      details: [fits[0]?.validation.reason].filter(Boolean) };
  }
  if (answer.status === "unvalidated") {
    const why = answer.deadline_reached ? "The deadline passed before a match was accepted." : "Validation was not requested.";
    const [near] = matches.filter((one) => one.validation.status === "skipped").sort((a, b) => a.rank - b.rank);
    const nearest = counts.validated ? "The nearest frame that was not tried" : "The nearest frame";
    return { kind: "neutral", shape: "?", title: "Not validated",
      text: near ? `${why} ${nearest} is ${shortId(near.frame_id)} of map ${near.map}, ${percent(near.similarity)} similar; it may or may not show the same place.` : why,
      details: [] };
  }
  return { kind: "bad", shape: "✕", title: "Not found", text: notFound(answer, where), details: reasons(matches) };
}

/** @param {Object<string, any>} answer @param {string} where */
function notFound({ counts }, where) {
  if (counts.map === 0) return `No frame of ${where} is searchable yet: none is indexed, or the query itself is the only one.`;
  if (counts.passed === 0) return `None of the ${count(counts.map)} frames of ${where} passes the filter.`;
  const tried = counts.validated === 1 ? "One frame was" : `${count(counts.validated)} frames were`;
  return `${tried} aligned with the query, and ${counts.validated === 1 ? "it does not fit" : "none fits"}: the place is not in ${where}, or too little of it is in view.`;
}

// the same reason of ten candidates is one reason
function reasons(matches) {
  const tally = new Map();
  for (const { validation } of matches) {
    if (validation.status === "skipped") continue;
    const text = validation.reason.replace(/-?\d+(\.\d+)?( ?%| m| deg)/g, "…$2");
    tally.set(text, (tally.get(text) ?? 0) + 1);
  }
  return [...tally].sort((a, b) => b[1] - a[1]).slice(0, 3).map(([text, n]) => `${n} ×: ${text}`);
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
  const { residual, overlap, plane_overlap: planes, inliers, free_space_violations: through, ambiguity } = validation;
  if (overlap === null || overlap === undefined) return [];
  return [
    ["Residual", residual ? `${metres(residual.translation_m)}, ${degrees(residual.rotation_deg)}` : "none"],
    ["Overlap", percent(overlap)],
    ["Plane overlap", percent(planes)],
    ["Inliers", count(inliers)],
    ["Violations", through === null ? "unknown" : percent(through)],
    // rivals are looked for only where nothing else speaks against it
    ["Ambiguity", ambiguity === 0 && validation.status !== "accepted" ? "–" : percent(ambiguity)],
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
