// Previews of frames on tiles. One frame stands in several rows, and rows are drawn anew with every
// answer: each picture is fetched and decoded once, and only when its tile comes into view.
import { at } from "../lib/api.js";
import { h, inView } from "../lib/dom.js";
import { bitmapOf, drawPicture } from "../lib/picture.js";

const WIDTH = 192;
const MOST = 400;

/**
 * @param {AbortSignal} signal of the page
 * @returns {{frame: (map: string, id: string, view: string, alt: string) => HTMLCanvasElement,
 *   query: (id: string, view: string, alt: string) => HTMLCanvasElement}}
 */
export function thumbs(signal) {
  const known = new Map(); // path and view -> promise of a bitmap
  const viewed = inView(signal);

  function bitmap(path, view) {
    const name = `${view} ${path}`;
    let found = known.get(name);
    if (!found) {
      found = bitmapOf(path, { view, width: WIDTH }, signal);
      found.catch(() => known.delete(name)); // asked for again when it is looked at again
      known.set(name, found);
      if (known.size > MOST) known.delete(known.keys().next().value);
    }
    return found;
  }

  function canvas(path, view, alt) {
    const element = h("canvas", { role: "img", "aria-label": alt, width: WIDTH, height: WIDTH * 3 / 4, class: "query-thumb" });
    viewed(element, () => drawPicture(element, bitmap(path, view), alt));
    return element;
  }

  return {
    frame: (map, id, view, alt) => canvas(`${at("maps", map, "frames", id)}/preview.png`, view, alt),
    query: (id, view, alt) => canvas(`${at("queries", id)}/preview.png`, view === "patches" ? "depth" : view, alt),
  };
}
