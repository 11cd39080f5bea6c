// 4 x 4 matrices as WebGL takes them, column by column, and the little else the viewer computes.

/** @typedef {number[]} Matrix 16 numbers, column-major */

export const identity = () => [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

/** @param {number[][]} rows as the API tells matrices @returns {Matrix} */
export const ofRows = (rows) => [0, 1, 2, 3].flatMap((c) => rows.map((row) => row[c]));

/** @returns {Matrix} a b */
export function multiply(a, b) {
  const out = new Array(16).fill(0);
  for (let c = 0; c < 4; c += 1) {
    for (let r = 0; r < 4; r += 1) {
      for (let k = 0; k < 4; k += 1) out[c * 4 + r] += a[k * 4 + r] * b[c * 4 + k];
    }
  }
  return out;
}

/** The inverse of a rotation and a translation. @param {Matrix} m @returns {Matrix} */
export function inverseRigid(m) {
  const t = [0, 1, 2].map((k) => -(m[k * 4] * m[12] + m[k * 4 + 1] * m[13] + m[k * 4 + 2] * m[14]));
  return [m[0], m[4], m[8], 0, m[1], m[5], m[9], 0, m[2], m[6], m[10], 0, ...t, 1];
}

/** @param {Matrix} m @param {number[]} p @returns {number[]} x, y, z, w */
export const transformed = (m, [x, y, z]) =>
  [0, 1, 2, 3].map((r) => m[r] * x + m[4 + r] * y + m[8 + r] * z + m[12 + r]);

export const add = (a, b) => a.map((x, k) => x + b[k]);
export const subtract = (a, b) => a.map((x, k) => x - b[k]);
export const scale = (a, s) => a.map((x) => x * s);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];

/** The box about places; null about none. @param {ArrayLike<number>[]} places */
export function boxAbout(places) {
  if (!places.length) return null;
  const low = [Infinity, Infinity, Infinity], high = low.map((x) => -x);
  for (const p of places) {
    for (let k = 0; k < 3; k += 1) {
      low[k] = Math.min(low[k], p[k]);
      high[k] = Math.max(high[k], p[k]);
    }
  }
  return { low, high };
}

/** The eight corners of a box. @param {{low: number[], high: number[]}} box */
export const cornersOf = ({ low, high }) => Array.from({ length: 8 }, (_, i) => low.map((x, k) => ((i >> k) & 1 ? high[k] : x)));

/**
 * World to an eye that looks along -z with y up, as WebGL has it.
 * @param {number[]} eye @param {number[]} right @param {number[]} above @param {number[]} ahead
 *   three directions of unit length, at right angles
 * @returns {Matrix}
 */
export const viewOf = (eye, right, above, ahead) => [
  right[0], above[0], -ahead[0], 0, right[1], above[1], -ahead[1], 0,
  right[2], above[2], -ahead[2], 0, -dot(right, eye), -dot(above, eye), dot(ahead, eye), 1,
];

/**
 * @param {number} height angle of view from top to bottom, rad
 * @param {number} aspect width / height
 * @returns {Matrix}
 */
export function perspective(height, aspect, near, far) {
  const f = 1 / Math.tan(height / 2), d = 1 / (near - far);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) * d, -1, 0, 0, 2 * near * far * d, 0];
}

/**
 * As `perspective`, but all is as large as it would be at a distance; w is that distance everywhere.
 * @param {number} height @param {number} aspect @param {number} distance
 * @param {number} near @param {number} far metres before the eye; they may be behind it
 * @returns {Matrix}
 */
export function parallel(height, aspect, distance, near, far) {
  const f = 1 / Math.tan(height / 2), d = distance / (near - far);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, 2 * d, 0, 0, 0, (near + far) * d, distance];
}

/** Unit quaternion x, y, z, w of a rotation. @param {Matrix} m */
export function quaternionOf(m) {
  const [a, b, c] = [m[0], m[5], m[10]];
  const squares = [1 + a - b - c, 1 - a + b - c, 1 - a - b + c, 1 + a + b + c];
  const k = squares.indexOf(Math.max(...squares)); // the largest: no division by next to nothing
  const s = 2 * Math.sqrt(squares[k]);
  const [x, y, z] = [m[6] - m[9], m[8] - m[2], m[1] - m[4]];
  const [xy, xz, yz] = [m[1] + m[4], m[2] + m[8], m[6] + m[9]];
  return [[s / 4, xy / s, xz / s, x / s], [xy / s, s / 4, yz / s, y / s],
    [xz / s, yz / s, s / 4, z / s], [x / s, y / s, z / s, s / 4]][k];
}

/** @param {number[]} q unit quaternion @param {number[]} t @returns {Matrix} */
export function ofQuaternion([x, y, z, w], t) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w), 0,
    2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w), 0,
    2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y), 0, ...t, 1,
  ];
}

/**
 * A rigid motion part of the way from one to another: it turns at one speed about one axis.
 * @param {Matrix} a @param {Matrix} b @param {number} share 0 is a, 1 is b
 * @returns {Matrix}
 */
export function between(a, b, share) {
  if (share <= 0) return [...a];
  if (share >= 1) return [...b];
  const p = quaternionOf(a);
  let q = quaternionOf(b);
  let cosine = p.reduce((sum, x, k) => sum + x * q[k], 0);
  if (cosine < 0) [q, cosine] = [q.map((x) => -x), -cosine]; // the shorter way round
  const angle = Math.acos(Math.min(cosine, 1));
  const [u, v] = angle < 1e-6 ? [1 - share, share]
    : [Math.sin((1 - share) * angle) / Math.sin(angle), Math.sin(share * angle) / Math.sin(angle)];
  const r = p.map((x, k) => u * x + v * q[k]), norm = Math.hypot(...r);
  const t = [12, 13, 14].map((k) => a[k] + (b[k] - a[k]) * share);
  return ofQuaternion(r.map((x) => x / norm), t);
}
