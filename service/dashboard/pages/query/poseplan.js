// Where the answer lies: its pose with heading and uncertainty, alternatives and voting matches,
// on a plan of the map.
import { h, put, svg } from "../lib/dom.js";
import { confidence, count, degrees, metres } from "../lib/format.js";
import { spread } from "../lib/labels.js";
import { coded } from "../lib/prose.js";
import { axesFor, ellipseOf, flat, nameOf, uprightOf } from "../plan/axes.js";
import { cornersOf, drawBackdrop } from "../plan/backdrop.js";
import { Plan } from "../plan/plan.js";
import { inverseRigid, multiply, ofRows } from "../viewer/matrix.js";
import { letterOf } from "./alternatives.js";
import { keyOf, mapOf, parentOf } from "./words.js";

const ARROW = "M0 -10L7 8L0 4L-7 8Z", SMALL = "M0 -7L5 6L0 3L-5 6Z";
const REACH_PX = 14; // of a click, about a match
const SURE_PX = { width: 44, height: 12 }; // of a confidence on the plan
const LEVEL = 0.2; // of a direction that lies in the plan: less is no heading

/**
 * @typedef {{at: import("../plan/plan.js").Place, heading: number | null}} Spot heading: rad from the right of the plan
 *   towards its top
 */

/**
 * @param {Object<string, any>} answer
 * @param {{backdrops: ReturnType<typeof import("../plan/backdrop.js").backdrops>, choice: any, signal: AbortSignal}} how
 * @returns {HTMLElement & {ready: Promise<void>}}
 */
export function posePlan(answer, { backdrops, choice, signal }) {
  const body = h("div", { class: "query-plan-body" });
  const element = h("section", { class: "card query-plan", "aria-labelledby": "query-plan-title" },
    h("h2", { id: "query-plan-title" }, "On the plan"), body);
  const ready = backdrops(mapOf(answer), parentOf(answer)).then((backdrop) => {
    if (!signal.aborted) draw(body, answer, backdrop, choice, signal);
  }, (error) => {
    if (error.name === "AbortError") return;
    if (error.status === 401) throw error;
    put(body, h("p", { class: "muted" }, coded(`The plan could not be loaded: ${error.message}`)));
  });
  return Object.assign(element, { ready });
}

function draw(body, answer, backdrop, choice, signal) {
  const parent = parentOf(answer) ?? backdrop?.parent ?? null;
  const poses = [answer.location, ...answer.alternatives].filter(Boolean).map((one) => ofRows(one.pose.matrix));
  const axes = backdrop?.axes ?? (poses.length ? axesFor(uprightOf([{ poses, isCloud: answer.kind === "cloud" }])) : null);
  if (axes === null) {
    put(body, h("p", { class: "muted" }, "The frames of this map have no poses, so there is no plan."));
    return;
  }
  const spots = spotsOf(answer, axes, backdrop, parent);
  const plan = new Plan({ label: labelOf(answer, parent), signal, onpick: (at, view) => {
    const apart = (one) => Math.hypot(one.at[0] - at[0], one.at[1] - at[1]) * view.scale;
    const near = spots.frames.filter((one) => apart(one) <= REACH_PX).sort((a, b) => apart(a) - apart(b))[0];
    if (near) choice.toggle(near.key);
  } });
  if (backdrop) drawBackdrop(plan, backdrop, signal);
  marks(plan, answer, axes, spots, choice);
  const [right, top] = [nameOf(axes.x), nameOf(axes.y)];
  put(plan.about, `${parent}${right && top ? ` · ${right} → ${top} ↑` : ""}`);
  const all = [...(backdrop?.runs ?? []).flatMap((one) => one.places), ...spots.frames.map((one) => one.at), ...spots.poses.map((one) => one.at), ...(spots.taken ? [spots.taken.at] : [])];
  plan.bounds([...all, ...cornersOf(backdrop?.surface ?? null, all)]);
  put(body, plan.element, legend(answer, axes, spots, backdrop),
    backdrop && backdrop.left > 0 && h("p", { class: "muted query-plan-note" }, `The newest ${count(backdrop.runs.length)} of ${count(backdrop.runs.length + backdrop.left)} runs are drawn.`));
}

function labelOf({ status, alternatives }, parent) {
  const what = status === "found" ? "the pose that was found" : alternatives.length ? `${count(alternatives.length)} possible poses` : "no pose";
  return `Plan of ${parent}, seen from above, with ${what}`;
}

/** Where all of it stands. */
function spotsOf(answer, axes, backdrop, parent) {
  const isCloud = answer.kind === "cloud";
  const own = [answer.location, ...answer.alternatives].filter((one) => one?.pose.parent_frame === parent);
  const known = new Map((backdrop?.runs ?? []).flatMap((run) => run.ids.map((id, i) => [id, run.poses[i]])));
  const map = mapOf(answer); // parent frames of two maps may have one name
  const frames = answer.matches.filter((match) => match.map === map).flatMap((match) => {
    const votes = match.pose_in_map?.parent_frame === parent && match.transform && ["accepted", "ambiguous"].includes(match.validation.status);
    // T_parent_match = T_parent_query T_query_match
    const pose = votes ? multiply(ofRows(match.pose_in_map.matrix), inverseRigid(ofRows(match.transform.matrix))) : known.get(match.frame_id);
    if (!pose || match.validation.status === "skipped") return [];
    const voted = votes ? flat(axes, match.pose_in_map.matrix.slice(0, 3).map((row) => row[3])) : null;
    return [{ key: keyOf(match), votes: Boolean(votes), voted, ...spotOf(pose, axes, isCloud) }];
  });
  const taken = answer.frame?.map === map ? known.get(answer.frame.frame_id) : undefined; // by a stored frame's own pose
  return { frames, taken: taken ? spotOf(taken, axes, isCloud) : null, poses: own.map((one) => ({ sure: one.confidence, ...spotOf(ofRows(one.pose.matrix), axes, isCloud) })) };
}

/** @param {number[]} m a pose, 16 column-major @param {import("../plan/axes.js").Axes} axes @param {boolean} isCloud @returns {Spot} */
function spotOf(m, axes, isCloud) {
  const ahead = flat(axes, isCloud ? m.slice(0, 3) : m.slice(8, 11)); // a camera looks along z; x of a scanner is ahead
  return { at: flat(axes, m.slice(12, 15)), heading: Math.hypot(...ahead) > LEVEL ? Math.atan2(ahead[1], ahead[0]) : null };
}

const turned = (x, y, heading) => `translate(${x.toFixed(1)} ${y.toFixed(1)}) rotate(${(90 - (heading * 180) / Math.PI).toFixed(1)})`;

function marks(plan, answer, axes, { frames, poses, taken }, choice) {
  /** @type {string | null} */
  let looked = null;
  const { location } = answer, isFound = location !== null && poses.length > 0;
  const sure = isFound && location.uncertainty ? ellipseOf(axes, location.uncertainty.covariance) : null;
  if (sure) {
    const [[u, v]] = poses.map((one) => one.at);
    plan.ground("ellipse", svg("ellipse", { class: "query-ellipse", rx: sure.long, ry: sure.short,
      transform: `translate(${u} ${v}) rotate(${(sure.angle * 180) / Math.PI})` }));
  }
  const arrow = (spot, x, y, path, props) => (spot.heading === null ? svg("circle", { cx: x, cy: y, r: 5, ...props })
    : svg("path", { d: path, transform: turned(x, y, spot.heading), ...props }));
  plan.mark("votes", ({ x, y }) => frames.filter((one) => one.voted).map((one) =>
    svg("path", { class: "query-vote-line", d: `M${x(one.at[0])} ${y(one.at[1])}L${x(one.voted[0])} ${y(one.voted[1])}` })));
  plan.mark("matches", ({ x, y }) => frames.map((one) => arrow(one, x(one.at[0]), y(one.at[1]), SMALL, {
    class: one.votes ? "query-spot-match" : "query-spot-out", "data-key": one.key, "data-marked": looked === one.key ? "true" : null })));
  plan.mark("taken", ({ x, y }) => taken && svg("circle", { class: "query-spot-taken", cx: x(taken.at[0]), cy: y(taken.at[1]), r: 13 }));
  plan.mark("answer", ({ x, y }) => poses.map((one, i) => {
    const [px, py] = [x(one.at[0]), y(one.at[1])];
    if (isFound) return arrow(one, px, py, ARROW, { class: "query-spot-found" });
    return svg("g", { class: "query-spot-letter", "data-letter": letterOf(i) },
      one.heading !== null && svg("path", { d: "M0 -11V-19", transform: turned(px, py, one.heading) }),
      svg("circle", { cx: px, cy: py, r: 11 }), svg("text", { x: px, y: py + 4, "text-anchor": "middle" }, letterOf(i)));
  }));
  plan.mark("confidence", ({ x, y }) => {
    const told = poses.filter((one) => one.sure !== null).map((one) => ({ text: confidence(one.sure), x: x(one.at[0]), y: y(one.at[1]) }));
    return spread(told.map((one) => ({ ...one, ...SURE_PX }))).map((spot, i) => spot && svg("text", { class: "query-spot-sure", x: told[i].x + spot[0], y: told[i].y + spot[1] + SURE_PX.height }, told[i].text));
  });
  choice.hear((key) => { looked = key; plan.redraw(); });
}

function legend(answer, axes, { frames, poses, taken }, backdrop) {
  const item = (shape, text, more) => h("li", {}, svg("svg", { viewBox: "-10 -10 20 20", "aria-hidden": "true" }, shape), h("span", {}, text, more && h("span", { class: "muted" }, ` ${more}`)));
  const { location, status } = answer, voting = frames.filter((one) => one.votes).length, out = frames.length - voting;
  const sure = location?.uncertainty ? ellipseOf(axes, location.uncertainty.covariance) : null;
  return h("ul", { class: "plan-key", "aria-label": "Legend" },
    location && poses.length > 0 && item(svg("path", { d: ARROW, class: "query-spot-found" }), "Pose found", headingOf(poses[0], axes)),
    sure && item(svg("ellipse", { rx: 9, ry: 5, class: "query-ellipse" }), "95 %", `± ${metres(sure.long)} × ${metres(sure.short)}`),
    !location && poses.length > 0 && item(svg("g", { class: "query-spot-letter" }, svg("circle", { r: 8 })), poses.length === 1 ? "Possible pose" : "Possible poses", status === "ambiguous" && "none is the answer"),
    taken && item(svg("circle", { r: 8, class: "query-spot-taken" }), "Where the queried frame was taken"),
    voting > 0 && item(svg("path", { d: SMALL, class: "query-spot-match" }), voting === 1 ? "Match, with its vote" : `${count(voting)} matches, with their votes`),
    out > 0 && item(svg("path", { d: SMALL, class: "query-spot-out" }), out === 1 ? "Candidate, not accepted" : `${count(out)} candidates, not accepted`),
    backdrop && backdrop.runs.length > 0 && item(svg("path", { d: "M-8 0h0M0 0h0M8 0h0", class: "plan-frames" }), "Frames of the map"),
    backdrop?.surface && item(svg("path", { d: "M-8 -6h16v12h-16z", class: "plan-surface" }), "Surfaces seen"));
}

/** @param {Spot} spot @param {import("../plan/axes.js").Axes} axes */
function headingOf({ heading }, axes) {
  if (heading === null) return "looking up or down";
  const right = nameOf(axes.x), top = nameOf(axes.y), told = degrees((heading * 180) / Math.PI);
  return right && top ? `heading ${told} from ${right} towards ${top}` : `heading ${told}`;
}

