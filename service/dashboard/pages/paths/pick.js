// Which of many points is meant by a place on the canvas.

/** A click farther from everything than that means nothing, CSS pixels. */
export const NEAR_PX = 28;

/**
 * The point whose projection is nearest; of two that are about as near, the one before the other.
 * @param {Iterable<number[]>} points of the world
 * @param {(p: number[]) => [number, number, number] | null} project
 * @param {number} x @param {number} y CSS pixels on the canvas
 * @param {number} [within] CSS pixels
 * @returns {number} its place, or -1
 */
export function nearest(points, project, x, y, within = NEAR_PX) {
  let best = -1, least = within, depth = Infinity, place = -1;
  for (const point of points) {
    place += 1;
    const at = project(point);
    if (at === null) continue;
    const away = Math.hypot(at[0] - x, at[1] - y);
    if (away > within) continue;
    const alike = Math.abs(away - least) <= 2 && best >= 0;
    if (alike ? at[2] < depth : away < least) {
      best = place;
      least = Math.min(least, away);
      depth = at[2];
    }
  }
  return best;
}
