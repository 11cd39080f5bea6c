// Which frames of reference can be drawn in one picture: those that associations have joined.

import { identity, inverseRigid, multiply, ofRows } from "../viewer/matrix.js";

/**
 * @typedef {{from: string, to: string, matrix: number[], strength: string, support: number,
 *   association: string}} Bridge matrix: 16, column-major, x_to = matrix x_from
 */

/**
 * The joins of associations that came to a transform; the strong ones and those of most edges first.
 * @param {Object<string, any>[]} associations as the API lists them
 * @returns {Bridge[]}
 */
export function bridges(associations) {
  const found = [];
  for (const one of associations) {
    for (const join of one.result?.joins ?? []) {
      if (join.transform === null || join.undone || join.from_parent === join.to_parent) continue;
      found.push({
        from: join.from_parent, to: join.to_parent, matrix: ofRows(join.transform.matrix),
        strength: join.strength, support: join.support, association: one.job_id,
      });
    }
  }
  const strong = (one) => (one.strength === "strong" ? 1 : 0);
  return found.sort((a, b) => strong(b) - strong(a) || b.support - a.support);
}

/**
 * How to bring other frames of reference into one, over as few joins as lead there.
 * @param {string} parent that all is drawn in
 * @param {Bridge[]} joins the better ones first
 * @returns {Map<string, {matrix: number[], over: Bridge[]}>} by the name of the frame; its own too
 */
export function reach(parent, joins) {
  /** @type {Map<string, {matrix: number[], over: Bridge[]}>} */
  const found = new Map([[parent, { matrix: identity(), over: [] }]]);
  for (const [here, { matrix, over }] of found) { // what is added meanwhile comes later: breadth first
    for (const one of joins) {
      const [there, step] = one.to === here ? [one.from, one.matrix]
        : one.from === here ? [one.to, inverseRigid(one.matrix)] : [here, null];
      if (step === null || found.has(there)) continue;
      found.set(there, { matrix: multiply(matrix, step), over: [...over, one] });
    }
  }
  return found;
}
