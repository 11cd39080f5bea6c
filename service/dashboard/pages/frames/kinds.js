// What a file is: by its first bytes where they tell, else by its name; and what the small files
// that lie beside frames say (intrinsics.json, clouds.json, NAME.pose.txt).

/** @typedef {{kind: "depth"|"cloud"|"archive"|"map"|"camera"|"clouds"|"pose"|"other",
 *             format?: string, width?: number, height?: number}} Source */

// enough for the header of an NPY file, and for a tar's magic at byte 257
const HEAD = 1024;
// a small file beside frames is a few hundred bytes; more is no such file
const MOST_TEXT = 65_536;
const SUFFIXES = {
  ".png": "depth", ".npy": "depth", ".ply": "cloud", ".pcd": "cloud", ".las": "cloud",
  ".laz": "cloud", ".bin": "cloud", ".cdr": "cloud", ".zip": "archive", ".tar": "archive", ".tgz": "archive",
  ".gz": "archive", ".tbz2": "archive", ".bz2": "archive", ".txz": "archive", ".xz": "archive",
  ".obj": "map", ".stl": "map", ".glb": "map", ".gltf": "map", ".e57": "map", // a mesh is a map that comes whole
};
/** What a file picker offers. */
export const ACCEPT = [...Object.keys(SUFFIXES), ".json", ".txt"].join(",");

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
  const text = (from, to) => String.fromCharCode(...head.subarray(from, to));
  const view = new DataView(head.buffer);
  if (text(1, 4) === "PNG" && head.length >= 24) {
    return { kind: "depth", format: "png", width: view.getUint32(16), height: view.getUint32(20) };
  }
  if (text(1, 6) === "NUMPY") return arrayOf(text(0, head.length));
  if (/^ply[\n\r ]/.test(text(0, 4))) return { kind: "cloud", format: "ply" };
  if (text(0, 4) === "LASF") return { kind: "cloud", format: "las" };
  if (/^(#.*\n)*\s*(VERSION|FIELDS)\b/.test(text(0, HEAD))) return { kind: "cloud", format: "pcd" };
  if (text(0, 4) === "glTF" || text(0, 8) === "ASTM-E57") return { kind: "map" };
  const packed = text(0, 2) === "PK" || text(0, 3) === "BZh" || text(257, 262) === "ustar"
    || (head[0] === 0x1f && head[1] === 0x8b) || text(1, 5) === "7zXZ" && head[0] === 0xfd;
  return packed ? { kind: "archive" } : null;
}

/** An array of three or four columns is a cloud, as the service takes it; any other an image. */
function arrayOf(head) {
  const shape = /'shape':\s*\((\d+),\s*(\d+)\)/.exec(head);
  if (!shape) return { kind: "depth", format: "npy" };
  const [height, width] = [Number(shape[1]), Number(shape[2])];
  return width === 3 || width === 4
    ? { kind: "cloud", format: "npy" } : { kind: "depth", format: "npy", width, height };
}

function byName(name) {
  const suffix = /\.[a-z0-9]+$/.exec(name)?.[0] ?? "";
  const kind = SUFFIXES[suffix] ?? "other";
  return suffix === ".bin" ? { kind, format: "kitti" } : { kind };
}

/**
 * What a frame's file is called without what tells its format: its pose is NAME.pose.txt.
 * @param {string} name
 */
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
