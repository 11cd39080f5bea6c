// The arithmetic of charts: steps of an axis, paths through values, and what is stacked on what.
// Nothing here touches the page, so that tests can hold it to values worked out by hand.

/**
 * Ends of the steps of an axis from 0 up to at least `most`: 1, 2 or 5 times a power of ten apart.
 * @param {number} most the greatest value
 * @param {number} [count] steps that are wanted, about
 * @param {number} [least] the smallest step: 1 where only whole numbers happen
 * @returns {number[]} rising, from 0; the last one is the top of the axis
 */
export function steps(most, count = 3, least = 0) {
  const top = most > 0 ? most : least || 1;
  const rough = Math.max(top / count, least);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((one) => one * power).find((one) => one >= rough * (1 - 1e-9)) ?? 10 * power;
  const last = Math.ceil(top / step - 1e-9);
  // a power below 1 has no exact sums: digits beyond those of the step are noise
  return Array.from({ length: last + 1 }, (_, i) => Number((i * step).toPrecision(12)));
}

/** Pixels of a place. @typedef {(value: number) => number} Pixel */

/** A path through points; a null between them leaves a gap, and one alone is left to `dotPath`.
 * @param {(number | null)[]} values @param {Pixel} x of a number in the list @param {Pixel} y of a value @returns {string} of the attribute `d` */
export const linePath = (values, x, y) => runs(values, (n) => n > 1).map(([from, to]) => `M${points(values, from, to, x, y)}`).join("");

/** A path of no length at each value that has no neighbour: with round ends a dot.
 * @param {(number | null)[]} values @param {Pixel} x @param {Pixel} y */
export const dotPath = (values, x, y) => runs(values, (n) => n === 1).map(([from, to]) => `M${points(values, from, to, x, y)}h0`).join("");

/** The area between a line and the bottom, part by part as the line. @param {(number | null)[]} values @param {Pixel} x @param {Pixel} y */
export const areaPath = (values, x, y) => runs(values, (n) => n > 1)
  .map(([from, to]) => `M${fixed(x(from))} ${fixed(y(0))}L${points(values, from, to, x, y)}L${fixed(x(to - 1))} ${fixed(y(0))}Z`).join("");

const points = (values, from, to, x, y) => values.slice(from, to).map((value, i) => `${fixed(x(from + i))} ${fixed(y(value))}`).join("L");

/**
 * Where each value begins and ends when they stand one on the other; null counts as nothing.
 * @param {(number | null)[][]} series the lowest first
 * @returns {[number, number][][]} as `series`
 */
export function stacked(series) {
  const height = (series[0] ?? []).map(() => 0);
  return series.map((values) => values.map((value, i) => {
    const from = height[i];
    height[i] += value ?? 0;
    return [from, height[i]];
  }));
}

/**
 * Places of an axis of time that have a label: whole multiples of some minutes, on the local clock.
 * @param {Date[]} times rising, as far apart as each other
 * @param {number} most labels
 * @returns {number[]} indices into `times`
 */
export function timeTicks(times, most) {
  if (times.length === 0) return [];
  for (const minutes of [1, 2, 5, 10, 15, 30, 60, 120, 240, 720, 1440]) {
    const found = times.flatMap((time, i) => {
      const clock = time.getHours() * 60 + time.getMinutes();
      return clock % minutes === 0 ? [i] : [];
    });
    if (found.length <= most) return found;
  }
  return [];
}

/** Hours and minutes on the local clock. @param {Date} time */
export function clock(time) {
  return `${String(time.getHours()).padStart(2, "0")}:${String(time.getMinutes()).padStart(2, "0")}`;
}

/** From and to (excluded) of stretches without a null, of wanted lengths. */
function runs(values, isWanted) {
  const found = [];
  /** @type {number | null} */
  let from = null;
  [...values, null].forEach((value, i) => {
    if (value !== null && from === null) from = i;
    if (value === null && from !== null) { found.push([from, i]); from = null; }
  });
  return found.filter(([begin, end]) => isWanted(end - begin));
}

const fixed = (x) => Math.round(x * 100) / 100;
