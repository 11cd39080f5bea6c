// Colours of the theme as WebGL takes them, and those of data that mean the same in every theme.

/** Of a residual: within a fifth, two fifths, and all of what validation allows; as overlay.ply. */
export const STEPS = [[38, 130, 60], [140, 190, 70], [240, 200, 60]];
export const BESIDE = [150, 155, 160];
export const VIOLATES = [200, 40, 40];

/** @type {any} the context that colours are read from, once there is one */
let pen = null;
const known = new Map(); // a token's bytes, until the theme changes
window.addEventListener("sceneprint:theme", () => known.clear()); // before those that draw hear of it

/** @param {string} text any CSS colour @returns {number[]} red, green, blue, 0 to 255 */
function bytesOf(text) {
  pen ??= new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
  pen.fillStyle = "#808080"; // what stays where the text is no colour
  pen.fillStyle = text;
  pen.fillRect(0, 0, 1, 1);
  return [...pen.getImageData(0, 0, 1, 1).data.slice(0, 3)];
}

/**
 * @param {string | number[]} tint a token's name ("query", "path-3", ...) or red, green, blue
 * @returns {number[]} 0 to 255, as the theme has it now
 */
export function colourOf(tint) {
  if (Array.isArray(tint)) return tint;
  if (!known.has(tint)) known.set(tint, bytesOf(getComputedStyle(document.documentElement).getPropertyValue(`--${tint}`).trim()));
  return known.get(tint);
}

/**
 * Colours for so many patches that neighbours in the list differ: the golden angle apart.
 * @param {number} count @returns {Uint8Array} red, green, blue of each
 */
export function manyColours(count) {
  const out = new Uint8Array(3 * count);
  for (let i = 0; i < count; i += 1) {
    const hue = (i * 0.61803398875) % 1, light = [0.62, 0.48, 0.72][i % 3];
    for (let k = 0; k < 3; k += 1) {
      const x = Math.abs(((hue + 1 - k / 3) * 6) % 6 - 3) - 1;
      out[3 * i + k] = Math.round(255 * (light + 0.55 * (Math.min(Math.max(x, 0), 1) - 0.5)
        * (1 - Math.abs(2 * light - 1))));
    }
  }
  return out;
}
