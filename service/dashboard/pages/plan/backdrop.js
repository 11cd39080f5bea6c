// What stands behind a plan: the surface of a map, and where its runs went, seen from above.
import { at, get } from "../lib/api.js";
import { h, svg } from "../lib/dom.js";
import { bitmapOf } from "../lib/picture.js";
import { linePath } from "../lib/scales.js";
import { commonest, pathOf, runsOf, sessionsOf } from "../paths/data.js";
import { placeOf } from "../paths/shapes.js";
import { dot } from "../viewer/matrix.js";
import { axesFor, flat, uprightOf } from "./axes.js";

const MOST_RUNS = 20; // the newest; more of them hide each other
const LEAST_M = 4; // that places lie apart, for what is shown about them
const SAME = 0.999; // cosine of two axes that are one

/**
 * @typedef {import("../paths/data.js").Path & {places: import("./plan.js").Place[]}} Run
 * @typedef {{map: string, parent: string, axes: import("./axes.js").Axes, runs: Run[], left: number, surface: Object<string, any> | null}} Backdrop
 *   left: runs in this parent frame that are not among them; surface: of this parent frame, as the API tells it
 */

/**
 * Backdrops of a page, each fetched once.
 * @param {AbortSignal} signal of the page
 * @returns {(map: string, parent: string | null) => Promise<Backdrop | null>} parent: a parent frame, null for the
 *   one of most frames; null where no frame has a pose in it
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
  const [told, sessions, surface] = await Promise.all([get(at("maps", map), { signal }), sessionsOf(map, signal), surfaceOf(map, signal)]);
  const { runs } = runsOf(sessions.items);
  const parent = wanted ?? commonest(runs) ?? surface.parents[0]?.parent_frame ?? null;
  const own = runs.filter((one) => one.parent === parent), fused = surface.parents.find((one) => one.parent_frame === parent) ?? null;
  const shown = own.toSorted((a, b) => (b.last ?? "").localeCompare(a.last ?? "")).slice(0, MOST_RUNS);
  const found = await Promise.all(shown.map((run) => pathOf(map, run, shown.length, signal).catch(without)));
  const paths = found.flatMap((one) => (one !== null && one.poses.length > 0 ? [one] : []));
  if (parent === null || (paths.length === 0 && fused === null)) return null;
  const axes = fused ? { x: fused.x_axis, y: fused.y_axis } : axesFor(told.up ? [told.up.x, told.up.y, told.up.z] : uprightOf(paths));
  return { map, parent, axes, left: own.length - paths.length, surface: fused,
    runs: paths.map((run) => ({ ...run, places: run.poses.map((m) => flat(axes, placeOf(m))) })) };
}

/** The surface of a map, as the API tells it. @param {string} map @param {AbortSignal} signal */
export const surfaceOf = (map, signal) => get(at("maps", map, "surface"), { signal });

/**
 * Lay the picture of a surface under a plan, if both are seen from the same side.
 * @param {import("./plan.js").Plan} plan @param {import("./axes.js").Axes} axes of the plan
 * @param {string} map @param {Object<string, any>} surface of a parent frame @param {AbortSignal} signal
 */
export async function laySurface(plan, axes, map, surface, signal) {
  if (dot(axes.x, surface.x_axis) < SAME || dot(axes.y, surface.y_axis) < SAME) return;
  const bitmap = await bitmapOf(`${at("maps", map, "surface")}/plan.png`, { parent: surface.parent_frame }, signal);
  const { left, top, m_per_pixel: step, width } = surface.plan;
  const canvas = h("canvas", { width: bitmap.width, height: bitmap.height });
  canvas.getContext("2d")?.drawImage(bitmap, 0, 0);
  const scaled = (step * width) / bitmap.width; // of as many pixels as came
  bitmap.close();
  if (!signal.aborted) plan.picture(canvas, { left, top, m_per_pixel: scaled });
}

/** A run whose poses cannot be told is not drawn. */
function without(error) {
  if (error.status !== 422) throw error;
  return null;
}

/**
 * What of a surface is shown with places on a plan: its corners, no farther from the places than these lie apart.
 * @param {Object<string, any> | null} surface of a parent frame @param {import("./plan.js").Place[]} places
 * @returns {import("./plan.js").Place[]}
 */
export function cornersOf(surface, places) {
  if (!surface) return [];
  const { left, top, width, height, m_per_pixel: step } = surface.plan;
  const corners = [[left, top - height * step], [left + width * step, top]];
  if (places.length === 0) return /** @type {any} */ (corners);
  const low = [0, 1].map((k) => places.reduce((x, one) => Math.min(x, one[k]), Infinity));
  const high = [0, 1].map((k) => places.reduce((x, one) => Math.max(x, one[k]), -Infinity));
  const reach = Math.max(high[0] - low[0], high[1] - low[1], LEAST_M);
  return /** @type {any} */ (corners.map((corner) => corner.map((x, k) => Math.min(Math.max(x, low[k] - reach / 2), high[k] + reach / 2))));
}

/** A surface that went or changed meanwhile leaves a plan without a picture. */
export function unseen(error) {
  if (error.status === 401) throw error;
}

/**
 * Draw it; the picture of the surface follows, as a plan is of use without.
 * @param {import("./plan.js").Plan} plan @param {Backdrop} backdrop @param {AbortSignal} signal
 */
export function drawBackdrop(plan, { map, axes, runs, surface }, signal) {
  if (surface) laySurface(plan, axes, map, surface, signal).catch(unseen);
  plan.mark("runs", ({ x, y }) => runs.filter((one) => !one.isVirtual).map(({ places }) =>
    svg("path", { class: "plan-run", d: linePath(places.map((_, i) => i), (i) => x(places[i][0]), (i) => y(places[i][1])) })));
  plan.mark("frames", ({ x, y }) => svg("path", { class: "plan-frames", d: dots(runs.flatMap((one) => one.places), x, y) }));
}

/** A path of no length at each place: with round ends dots. */
export function dots(places, x, y) {
  return places.map(([u, v]) => `M${x(u).toFixed(1)} ${y(v).toFixed(1)}h0`).join("");
}
