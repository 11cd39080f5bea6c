// What is drawn, as segments: paths, frustums, edges, the grid, an ellipsoid. Numbers in, numbers
// out; all of them about an origin near the paths, since those that are drawn have 32 bits.

import { add, dot, scale, transformed } from "../viewer/matrix.js";

/** Half an axis of the ellipsoid that holds 95 % of a normal error in space, in deviations. */
export const SIGMAS = Math.sqrt(7.8147);

/** @param {number[]} m a pose, 16 column-major @returns {number[]} where it is */
export const placeOf = (m) => [m[12], m[13], m[14]];

/** A segment from each place to the next. @param {number[][]} places */
export function polyline(places) {
  const out = new Float32Array(6 * Math.max(places.length - 1, 0));
  for (let i = 1; i < places.length; i += 1) {
    out.set(places[i - 1], 6 * (i - 1));
    out.set(places[i], 6 * (i - 1) + 3);
  }
  return out;
}

/** One shape at many poses. @param {Float32Array} shape segments @param {number[][]} poses */
export function copies(shape, poses) {
  const out = new Float32Array(shape.length * poses.length);
  poses.forEach((pose, i) => {
    for (let k = 0; k < shape.length; k += 3) {
      const [x, y, z] = transformed(pose, [shape[k], shape[k + 1], shape[k + 2]]);
      out.set([x, y, z], i * shape.length + k);
    }
  });
  return out;
}

/**
 * Segments as dashes, so that what they stand for does not show by colour alone.
 * @param {[number[], number[]][]} pairs ends
 * @param {number} dash @param {number} gap metres
 * @param {number} [most] dashes of one segment: a long one has longer dashes
 */
export function dashes(pairs, dash, gap, most = 40) {
  const out = [];
  for (const [a, b] of pairs) {
    const length = Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]);
    const times = Math.max(length / ((dash + gap) * most), 1);
    const on = dash * times, period = (dash + gap) * times;
    const at = (s) => a.map((x, k) => x + (b[k] - x) * Math.min(s / length, 1));
    for (let s = 0; s < length; s += period) out.push(...at(s), ...at(s + on));
  }
  return new Float32Array(out);
}

/**
 * A shape whose every line is broken: it marks what may be, beside what is.
 * @param {Float32Array} shape segments @param {number} dash metres
 */
export function hollow(shape, dash) {
  const out = [];
  for (let k = 0; k < shape.length; k += 6) {
    const [a, b] = [[...shape.slice(k, k + 3)], [...shape.slice(k + 3, k + 6)]];
    const on = Math.min(dash, Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]) / 2); // a ring's are short
    if (on > 0) out.push(...dashes([[a, b]], on, on));
  }
  return new Float32Array(out);
}

/** Every so-manieth, with the first and the last. @param {number} count @param {number} most */
export function evenly(count, most) {
  if (count <= most) return Array.from({ length: count }, (_, i) => i);
  if (most < 2) return count ? [0] : [];
  return Array.from({ length: most }, (_, i) => Math.round((i * (count - 1)) / (most - 1)));
}

/**
 * Places along a way that lie so far apart that what is drawn at them does not hide each other; the
 * first and the last are among them.
 * @param {number[][]} places @param {number} apart metres @param {number} most
 * @returns {number[]} their numbers
 */
export function spaced(places, apart, most) {
  const found = [];
  places.forEach((p, i) => {
    const before = places[found.at(-1)];
    if (!before || Math.hypot(p[0] - before[0], p[1] - before[1], p[2] - before[2]) >= apart) found.push(i);
  });
  if (places.length && found.at(-1) !== places.length - 1) found.push(places.length - 1);
  return evenly(found.length, most).map((i) => found[i]);
}

/** The least of 1, 2, 5, 10, 20... times a power of ten that is not below. @param {number} x */
export function nice(x) {
  const power = 10 ** Math.floor(Math.log10(x));
  return power * ([1, 2, 5, 10].find((step) => step * power >= x * (1 - 1e-9)) ?? 10);
}

/** From where to where a box reaches along a direction. @param {{low: number[], high: number[]}} box
 * @param {number[]} axis of unit length */
export function reachAlong({ low, high }, axis) {
  const ends = axis.map((x, k) => [x * low[k], x * high[k]]);
  return [Math.min, Math.max].map((least) => ends.reduce((sum, pair) => sum + least(...pair), 0));
}

/**
 * A grid on the ground, a square about what stands on it.
 * @param {{low: number[], high: number[]}} box of what stands on it
 * @param {{right: number[], ahead: number[], above: number[]}} axes two on the ground, and up; of unit
 *   length, at right angles
 * @param {number} height of the ground along `above`
 * @param {number[]} origin what was taken off: lines are at whole steps of the true coordinates
 * @returns {{positions: Float32Array, step: number}} step: metres
 */
export function grid(box, { right, ahead, above }, height, origin) {
  const ends = [right, ahead].map((axis) => reachAlong(box, axis));
  const off = [right, ahead].map((axis) => dot(axis, origin));
  const size = Math.max(...ends.map(([from, to]) => to - from), 0.2);
  const step = nice(size / 10), out = [];
  const middle = ends.map(([from, to], k) => (from + to) / 2 + off[k]);
  const low = middle.map((x) => Math.floor((x - 0.55 * size) / step - 1) * step);
  const high = middle.map((x) => Math.ceil((x + 0.55 * size) / step + 1) * step);
  const floor = scale(above, height - dot(above, origin));
  const point = (u, v) => add(floor, add(scale(right, u - off[0]), scale(ahead, v - off[1])));
  for (let u = 0; u <= Math.round((high[0] - low[0]) / step); u += 1) {
    out.push(...point(low[0] + u * step, low[1]), ...point(low[0] + u * step, high[1]));
  }
  for (let v = 0; v <= Math.round((high[1] - low[1]) / step); v += 1) {
    out.push(...point(low[0], low[1] + v * step), ...point(high[0], low[1] + v * step));
  }
  return { positions: new Float32Array(out), step };
}

/**
 * Axes of a normal error: eigenvalues and eigenvectors of a symmetric matrix, by Jacobi's rotations.
 * @param {number[][]} covariance 3 x 3
 * @returns {{deviation: number, axis: number[]}[]} the longest first
 */
export function axesOf(covariance) {
  const a = covariance.map((row) => [...row]);
  const v = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  for (let sweep = 0; sweep < 12; sweep += 1) {
    for (const [p, q] of [[0, 1], [0, 2], [1, 2]]) {
      if (Math.abs(a[p][q]) < 1e-300) continue;
      const angle = 0.5 * Math.atan2(2 * a[p][q], a[q][q] - a[p][p]);
      const [c, s] = [Math.cos(angle), Math.sin(angle)];
      const turn = (m) => {
        for (const row of m) [row[p], row[q]] = [c * row[p] - s * row[q], s * row[p] + c * row[q]];
      };
      turn(a);
      for (let k = 0; k < 3; k += 1) {
        [a[p][k], a[q][k]] = [c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]];
      }
      turn(v);
    }
  }
  return [0, 1, 2]
    .map((k) => ({ deviation: Math.sqrt(Math.max(a[k][k], 0)), axis: v.map((row) => row[k]) }))
    .sort((one, other) => other.deviation - one.deviation);
}

/**
 * The three great circles of an ellipsoid about the origin.
 * @param {{deviation: number, axis: number[]}[]} axes @param {number} sigmas half an axis, in deviations
 */
export function ellipsoid(axes, sigmas = SIGMAS, parts = 48) {
  const out = [];
  for (const [i, j] of [[0, 1], [0, 2], [1, 2]]) {
    const at = (k) => {
      const t = (2 * Math.PI * k) / parts;
      const [c, s] = [Math.cos(t) * axes[i].deviation * sigmas, Math.sin(t) * axes[j].deviation * sigmas];
      return axes[i].axis.map((x, n) => c * x + s * axes[j].axis[n]);
    };
    for (let k = 0; k < parts; k += 1) out.push(...at(k), ...at(k + 1));
  }
  return new Float32Array(out);
}
