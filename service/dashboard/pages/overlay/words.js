// Transforms in words: which way, how far, and along what they are free.
import { degrees, metres } from "../lib/format.js";

const OPTICAL = ["right", "down", "ahead"];
const AXES = ["x", "y", "z"];
const ALONG = 0.9; // a direction this near to an axis is called by it

/** Whether a frame of coordinates is a camera's. @param {string} name as transforms tell it */
export const isOptical = (name) => name.endsWith(".optical");

/** What an axis is called. @param {number} k @param {boolean} optical */
export const axisName = (k, optical) => (optical ? `${AXES[k]} (${OPTICAL[k]})` : AXES[k]);

/** Angle of the rotation of a matrix told row by row. @param {number[][]} m @returns {number} degrees */
export function turnOf(m) {
  const sine = Math.hypot(m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]);
  return (Math.atan2(sine, m[0][0] + m[1][1] + m[2][2] - 1) * 180) / Math.PI;
}

/** Length of a transform's translation, metres. */
export const shiftOf = ({ x, y, z }) => Math.hypot(x, y, z);

/** How far one pose of the query is from another, in metres and degrees. */
export function apart(a, b) {
  const [p, q] = [a.matrix, b.matrix];
  const turned = [0, 1, 2].map((i) => [0, 1, 2].map(
    (j) => [0, 1, 2].reduce((sum, k) => sum + p[i][k] * q[j][k], 0)));
  return {
    metres: Math.hypot(...[0, 1, 2].map((i) => p[i][3] - q[i][3])), degrees: turnOf(turned),
  };
}

/**
 * A direction in which the transform is hardly held.
 * @param {Object<string, any>} free with translation, rotation and deviation
 * @param {boolean} optical
 */
export function freedom({ translation, rotation, deviation }, optical) {
  const parts = [];
  /** @type {[string, Object<string, number>, (x: number) => string][]} */
  const moves = [["slides along", translation, metres], ["turns about", rotation, (x) => degrees((x * 180) / Math.PI)]];
  for (const [what, vector, told] of moves) {
    const v = [vector.x, vector.y, vector.z], size = Math.hypot(...v);
    if (size < 0.2) continue; // next to nothing of it
    const way = v.map((x) => x / size), k = way.findIndex((x) => Math.abs(x) > ALONG);
    const name = k >= 0 ? axisName(k, optical) : `(${way.map((x) => x.toFixed(2)).join(", ")})`;
    parts.push(`${what} ${name}, ± ${told(deviation * size)}`);
  }
  return parts.join(", and ");
}

/** Standard deviations along the axes. @param {number[]} covariance 36 numbers */
export const deviations = (covariance) =>
  [0, 1, 2, 3, 4, 5].map((k) => Math.sqrt(Math.max(covariance[7 * k], 0)));
