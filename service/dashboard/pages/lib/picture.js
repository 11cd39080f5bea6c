// A picture of the API on a canvas: an <img> cannot show a key, and the policy forbids blob:.
import { bytes } from "./api.js";
import { h } from "./dom.js";
import { plain } from "./prose.js";

/**
 * A canvas that draws itself when the picture has come; where there is nothing to see it says why.
 * @param {string} path @param {Object<string, any>} params
 * @param {{alt: string, width: number, height: number, signal?: AbortSignal}} how size: in CSS
 *   pixels, kept free until the picture is there
 * @returns {HTMLCanvasElement & {ready: Promise<boolean>}} its property `ready` is a promise: whether it was drawn
 */
export function picture(path, params, { alt, width, height, signal }) {
  const canvas = h("canvas", { role: "img", "aria-label": alt, width, height, class: "picture" });
  return Object.assign(canvas, { ready: drawPicture(canvas, bitmapOf(path, params, signal), alt) });
}

/** Fetch and decode a picture of the API. @param {string} path @param {Object<string, any>} params @param {AbortSignal} [signal] */
export async function bitmapOf(path, params, signal) {
  const data = await bytes(path, { params, signal, accept: "image/png" });
  return createImageBitmap(new Blob([data], { type: "image/png" }));
}

/**
 * Draw a picture when it has come, or why it has not.
 * @param {HTMLCanvasElement} canvas @param {Promise<ImageBitmap>} coming @param {string} alt
 * @returns {Promise<boolean>} whether it was drawn
 */
export async function drawPicture(canvas, coming, alt) {
  try {
    const bitmap = await coming;
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
    canvas.getContext("2d")?.drawImage(bitmap, 0, 0);
    return true;
  } catch (error) {
    if (error.name === "AbortError") return false;
    const why = error.status === 409 ? "No preview yet" : error.status === 0 ? "No answer" : "Not available";
    canvas.setAttribute("aria-label", `${alt}. ${why}: ${plain(error.message)}`);
    canvas.title = plain(error.message);
    write(canvas, why);
    if (error.status === 401) throw error;
    return false;
  }
}

function write(canvas, text) {
  const colours = getComputedStyle(document.documentElement);
  const scale = window.devicePixelRatio || 1;
  canvas.width *= scale;
  canvas.height *= scale;
  const pen = canvas.getContext("2d");
  pen.fillStyle = colours.getPropertyValue("--sunken");
  pen.fillRect(0, 0, canvas.width, canvas.height);
  pen.fillStyle = colours.getPropertyValue("--muted");
  pen.font = `${13 * scale}px system-ui, sans-serif`;
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.fillText(text, canvas.width / 2, canvas.height / 2, canvas.width * 0.9);
}
