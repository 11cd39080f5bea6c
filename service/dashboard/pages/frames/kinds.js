// What a file is: by its first bytes where they tell, else by its name; and what the small files
// that lie beside frames say (intrinsics.json, clouds.json, NAME.pose.txt).

import { FORMATS } from "./formats.js";

/** @typedef {{kind: import("./formats.js").FileKind|"camera"|"clouds"|"pose"|"other",
 *             format?: string, width?: number, height?: number}} Source */

// the service looks at as many first bytes
const HEAD = 10_016;
// a small file beside frames is a few hundred bytes; more is no such file
const MOST_TEXT = 65_536;
const PATTERNS = FORMATS.filter((one) => one.signature)
  .map(({ kind, name, signature }) => ({ kind, format: name, pattern: new RegExp(`^(?:${signature})`) }));
/** What a file picker offers. */
export const ACCEPT = [...new Set(FORMATS.flatMap((one) => one.suffixes)), ".json", ".txt"].join(",");

/** The formats of a kind as text. @param {import("./formats.js").FileKind} kind */
export function titlesOf(kind) {
  return [...new Set(FORMATS.filter((one) => one.kind === kind).map((one) => one.title))].join(", ");
}

/**
 * What a file is, by its first bytes or its name.
 * @param {File} file
 * @returns {Promise<Source>} format "kitti" where the service cannot tell it by itself; of an image
 *   its size, pixels
 */
export async function kindOf(file) {
  const name = file.name.toLowerCase();
  if (name === "intrinsics.json") return { kind: "camera" };
  if (name === "clouds.json") return { kind: "clouds" };
  if (name.endsWith(".pose.txt")) return { kind: "pose" };
  // 7-Scenes has a colour image beside each depth image, TUM a folder of them
  if (name.endsWith(".color.png") || name.endsWith(".jpg")) return { kind: "other" };
  const head = new Uint8Array(await file.slice(0, HEAD).arrayBuffer());
  return byHead(head) ?? byName(name);
}

function byHead(head) {
  const text = String.fromCharCode(...head);
  for (const { kind, format, pattern } of PATTERNS) {
    const found = pattern.exec(text);
    if (!found) continue;
    const [width, height] = format === "png" ? sizeOfPng(head) : [Number(found[1]), Number(found[2])];
    return kind === "depth" && width && height ? { kind, format, width, height } : { kind, format };
  }
  return null;
}

function sizeOfPng(head) {
  const view = new DataView(head.buffer);
  return head.length < 24 ? [0, 0] : [view.getUint32(16), view.getUint32(20)];
}

/** @param {string} name @returns {Source} */
function byName(name) {
  const found = FORMATS.find((one) => one.suffixes.some((suffix) => name.endsWith(suffix)));
  if (!found) return { kind: "other" };
  // what has a signature is none of that format if it does not begin so
  return found.signature ? { kind: found.kind } : { kind: found.kind, format: found.name };
}

/** What a frame's file is called without what tells its format: its pose is NAME.pose.txt. @param {string} name */
export function stemOf(name) {
  return name.replace(/\.(pose\.txt|depth\.png|[^.]+)$/i, "");
}

/**
 * The fields of an intrinsics.json or a clouds.json, as `settings` of source.js has them.
 * @param {File} file
 * @returns {Promise<Object<string, any>>}
 * @throws {Error} it is no JSON object, or too large to be one of them
 */
export async function fieldsOf(file) {
  if (file.size > MOST_TEXT) throw new Error(`${file.name} is too large: it should contain only a few numbers.`);
  let said;
  try {
    said = JSON.parse(await file.text());
  } catch {
    throw new Error(`${file.name} is not JSON.`);
  }
  if (said === null || typeof said !== "object" || Array.isArray(said)) {
    throw new Error(`${file.name} is not a JSON object.`);
  }
  const known = ["fx", "fy", "cx", "cy", "width", "height", "distortion", "depth_scale",
    "depth_along_ray", "viewpoint", "units_per_metre", "format", "up"];
  return Object.fromEntries(known.filter((one) => one in said).map((one) => [one, said[one]]));
}

/**
 * T_parent_sensor of a .pose.txt: 16 numbers, row by row.
 * @param {File} file
 * @returns {Promise<number[][]>} 4 x 4
 * @throws {Error} it holds anything else
 */
export async function poseOf(file) {
  if (file.size > MOST_TEXT) throw new Error(`${file.name} is too large: a pose has 16 numbers.`);
  const numbers = (await file.text()).trim().split(/\s+/).map(Number);
  if (numbers.length !== 16 || !numbers.every(Number.isFinite)) {
    throw new Error(`${file.name} contains no pose. Write 4 rows of 4 numbers, sensor to parent.`);
  }
  return [0, 4, 8, 12].map((row) => numbers.slice(row, row + 4));
}
