// What stands behind a plan: where the runs of a map went, seen from above.
import { at, get } from "../lib/api.js";
import { svg } from "../lib/dom.js";
import { linePath } from "../lib/scales.js";
import { pathOf, runsOf, sessionsOf } from "../paths/data.js";
import { placeOf } from "../paths/shapes.js";
import { axesFor, flat, uprightOf } from "./axes.js";

const MOST_RUNS = 20; // the newest; more of them hide each other

/**
 * @typedef {{session: string, robot: string | null, ids: string[], poses: number[][], places: import("./plan.js").Place[]}} Run
 * @typedef {{parent: string, axes: import("./axes.js").Axes, runs: Run[], left: number}} Backdrop
 *   left: runs in this parent frame that are not among them
 */

/**
 * Backdrops of a page, each fetched once.
 * @param {AbortSignal} signal of the page
 * @returns {(map: string, parent: string | null) => Promise<Backdrop | null>} parent: a parent frame, null for the
 *   one of most frames; null where no run has poses in it
 */
export function backdrops(signal) {
  const known = new Map();
  return (map, parent) => {
    const name = JSON.stringify([map, parent]);
    if (!known.has(name)) {
      const found = backdropOf(map, parent, signal);
      found.catch(() => known.delete(name)); // asked for again with the next answer
      known.set(name, found);
    }
    return known.get(name);
  };
}

/** @returns {Promise<Backdrop | null>} */
async function backdropOf(map, wanted, signal) {
  const [told, sessions] = await Promise.all([get(at("maps", map), { signal }), sessionsOf(map, signal)]);
  const { runs } = runsOf(sessions.items);
  const parent = wanted ?? commonest(runs);
  const own = runs.filter((one) => one.parent === parent);
  if (parent === null || own.length === 0) return null;
  const shown = own.toSorted((a, b) => (b.last ?? "").localeCompare(a.last ?? "")).slice(0, MOST_RUNS);
  const found = await Promise.all(shown.map((run) => pathOf(map, run, shown.length, signal).catch(without)));
  const paths = found.flatMap((one) => (one !== null && one.poses.length > 0 ? [one] : []));
  if (paths.length === 0) return null;
  const axes = axesFor(told.up ? [told.up.x, told.up.y, told.up.z] : uprightOf(paths));
  return { parent, axes, left: own.length - paths.length,
    runs: paths.map(({ session, robot, ids, poses }) => ({ session, robot, ids, poses, places: poses.map((m) => flat(axes, placeOf(m))) })) };
}

/** A run whose poses cannot be told is not drawn. */
function without(error) {
  if (error.status !== 422) throw error;
  return null;
}

/** The frame that most frames have poses in. @param {import("../paths/data.js").Run[]} runs @returns {string | null} */
export function commonest(runs) {
  const counts = new Map();
  for (const one of runs) counts.set(one.parent, (counts.get(one.parent) ?? 0) + one.frames);
  return [...counts].sort((a, b) => b[1] - a[1] || a[0].localeCompare(b[0]))[0]?.[0] ?? null;
}

/** Draw it. @param {import("./plan.js").Plan} plan @param {Backdrop} backdrop */
export function drawBackdrop(plan, { runs }) {
  plan.mark("runs", ({ x, y }) => runs.map(({ places }) =>
    svg("path", { class: "plan-run", d: linePath(places.map((_, i) => i), (i) => x(places[i][0]), (i) => y(places[i][1])) })));
  plan.mark("frames", ({ x, y }) => svg("path", { class: "plan-frames", d: dots(runs.flatMap((one) => one.places), x, y) }));
}

/** A path of no length at each place: with round ends dots. */
export function dots(places, x, y) {
  return places.map(([u, v]) => `M${x(u).toFixed(1)} ${y(v).toFixed(1)}h0`).join("");
}
