// Binary points of the API, read where they lie: nothing is copied, the GPU takes the bytes.
// Byte by byte in docs/reference.md, "Points".

export const OUTSIDE = 253, VIOLATION = 254, NOT_COMPARED = 255, TOLERANCE = 250, NO_PATCH = 65535;
const MAGIC = 0x54505053; // "SPPT", little-endian
const HEADER = 48, STRIDE = 12;

/**
 * @typedef {object} Points
 * @property {number} count points that follow
 * @property {number} total points there were before thinning
 * @property {[number, number, number]} origin metres
 * @property {[number, number, number]} extent metres; a position is origin + value / 65535 * extent
 * @property {ArrayBuffer} data
 * @property {number} offset of the first point in data
 * @property {number} stride bytes of a point
 * @property {boolean} hasNormals
 * @property {boolean} hasPatches
 * @property {boolean} hasResiduals
 * @property {number} scale metres that a residual of 250 stands for; 0 where none is told
 */

/**
 * @param {ArrayBuffer} data as the API sent it
 * @returns {Points}
 * @throws {RangeError} it is not what this page can read
 */
export function parsePoints(data) {
  const view = new DataView(data);
  if (data.byteLength < HEADER || view.getUint32(0, true) !== MAGIC) {
    throw new RangeError("This is not point data of sceneprint.");
  }
  const version = view.getUint16(4, true), flags = view.getUint16(6, true);
  const count = view.getUint32(8, true), stride = view.getUint32(12, true);
  if (version !== 1 || stride !== STRIDE) {
    throw new RangeError(`This page does not support point data of version ${version}: reload it.`);
  }
  if (data.byteLength !== HEADER + count * stride) {
    throw new RangeError("The point data is incomplete: load it again.");
  }
  /** @returns {[number, number, number]} */
  const three = (at) => [view.getFloat32(at, true), view.getFloat32(at + 4, true), view.getFloat32(at + 8, true)];
  return {
    count, stride, data, offset: HEADER, total: view.getUint32(40, true),
    origin: three(16), extent: three(28), scale: view.getFloat32(44, true),
    hasNormals: (flags & 1) > 0, hasPatches: (flags & 2) > 0, hasResiduals: (flags & 4) > 0,
  };
}

/** One point, for counting and for tests; drawing never asks. @param {Points} points @param {number} i */
export function pointAt(points, i) {
  const at = points.offset + i * points.stride;
  const view = new DataView(points.data, at, points.stride);
  return {
    position: [0, 1, 2].map(
      (k) => points.origin[k] + (view.getUint16(2 * k, true) / 65535) * points.extent[k]),
    patch: view.getUint16(6, true),
    normal: [8, 9, 10].map((k) => Math.max(view.getInt8(k) / 127, -1)),
    residual: view.getUint8(11),
  };
}

/** How many points have each residual. @param {Points} points @returns {Uint32Array} 256 counts */
export function residualCounts(points) {
  const counts = new Uint32Array(256), bytes = new Uint8Array(points.data, points.offset);
  for (let at = 11; at < bytes.length; at += points.stride) counts[bytes[at]] += 1;
  return counts;
}

/**
 * The box that holds all but the outermost points along each axis: a stray return far out must not
 * make the rest a dot.
 * @param {Points} points @param {number} share left out on either side
 * @returns {{low: number[], high: number[]}} in the points' own coordinates
 */
export function boxOf(points, share = 0.05) {
  const step = Math.max(1, Math.floor(points.count / 2000));
  const words = new Uint16Array(points.data, points.offset);
  const low = [...points.origin], high = [...points.origin];
  for (let k = 0; k < 3 && points.count > 0; k += 1) {
    const values = [];
    for (let i = 0; i < points.count; i += step) values.push(words[i * (points.stride / 2) + k]);
    values.sort((a, b) => a - b);
    const cut = Math.floor(values.length * share);
    low[k] += (values[cut] / 65535) * points.extent[k];
    high[k] += (values[values.length - 1 - cut] / 65535) * points.extent[k];
  }
  return { low, high };
}

/** Some points, spread over all of them. @param {Points} points @param {number} most @returns {number[][]} */
export function someOf(points, most = 400) {
  const step = Math.max(1, Math.ceil(points.count / most)), out = [];
  for (let i = 0; i < points.count; i += step) out.push(pointAt(points, i).position);
  return out;
}
