// A parent frame seen from above: which way is up, and where a point of it lies on the plan.
// As the service has it (sceneprint/engine/search/up_vectors.py), so that pictures of both agree.
import { cross, dot } from "../viewer/matrix.js";

/** Half an axis of the ellipse that holds 95 % of a normal error in a plane, in deviations. */
const SIGMAS = Math.sqrt(5.9915);
const NEAR = 0.95; // a direction this near to an axis is called by it

/**
 * @typedef {{x: number[], y: number[]}} Axes unit vectors to the right and to the top of the plan,
 *   in the parent frame
 */

/** The axes of a plan, by what is up. @param {number[]} up unit vector @returns {Axes} */
export function axesFor(up) {
  const along = Math.abs(up[0]) > 0.9 ? [0, 1, 0] : [1, 0, 0];
  const share = dot(along, up), level = along.map((v, k) => v - share * up[k]);
  const size = Math.hypot(...level), x = level.map((v) => v / size);
  return { x, y: cross(up, x) };
}

/**
 * The axis of a parent frame, or its opposite, nearest to the sensors' own up: robots hold them upright.
 * @param {{poses: number[][], isCloud: boolean}[]} runs poses: 16 column-major
 * @returns {number[]} unit vector
 */
export function uprightOf(runs) {
  const sum = [0, 0, 0];
  for (const { poses, isCloud } of runs) {
    for (const m of poses) for (let k = 0; k < 3; k += 1) sum[k] += isCloud ? m[8 + k] : -m[4 + k];
  }
  const sizes = sum.map(Math.abs), axis = sizes.indexOf(Math.max(...sizes));
  return [0, 1, 2].map((k) => (k === axis ? Math.sign(sum[axis]) || 1 : 0));
}

/** Where a point lies on the plan. @param {Axes} axes @param {number[]} p @returns {[number, number]} metres */
export const flat = ({ x, y }, p) => [dot(x, p), dot(y, p)];

/** What an axis of the plan is called. @param {number[]} axis unit vector @returns {string | null} "x", "−z"; null of a slant one */
export function nameOf(axis) {
  const k = axis.findIndex((v) => Math.abs(v) > NEAR);
  return k < 0 ? null : `${axis[k] < 0 ? "−" : ""}${"xyz"[k]}`;
}

/**
 * The ellipse on the plan that holds 95 % of the errors of a place.
 * @param {Axes} axes @param {number[]} covariance 36 numbers, row by row; of the place: the upper left 3 x 3
 * @returns {{long: number, short: number, angle: number}} half axes, metres; angle of the long one, rad
 */
export function ellipseOf(axes, covariance) {
  const row = (i) => [0, 1, 2].map((j) => covariance[6 * i + j]);
  const spread = (a, b) => [0, 1, 2].reduce((sum, i) => sum + a[i] * dot(row(i), b), 0);
  const [a, b, c] = [spread(axes.x, axes.x), spread(axes.x, axes.y), spread(axes.y, axes.y)];
  const middle = (a + c) / 2, apart = Math.hypot((a - c) / 2, b);
  return {
    long: SIGMAS * Math.sqrt(Math.max(middle + apart, 0)), short: SIGMAS * Math.sqrt(Math.max(middle - apart, 0)),
    angle: 0.5 * Math.atan2(2 * b, a - c),
  };
}
