// What was dropped or chosen, folders walked through: frames and archives with what lies beside
// them, as data sets have it (intrinsics.json or clouds.json here or above, NAME.pose.txt).
import { fieldsOf, kindOf, stemOf } from "./kinds.js";

// a page that works through thousands of names draws in between
const BREATH_MS = 12;
const NATURAL = new Intl.Collator("en", { numeric: true });
const PARENTS = 4; // folders above a frame that are looked into, as `sceneprint upload` does

/** @typedef {{file: File | null, path: string}} Dropped path: with the folders that were dropped; file:
 *   null where it cannot be read */
/** @typedef {{file: File, path: string, source: import("./kinds.js").Source, said: Object<string, any>,
 *   pose: File | null}} Found said: fields of the nearest intrinsics.json or clouds.json */

/**
 * Files of a drop; to be called while the event is handled, its entries are gone afterwards.
 * @param {DataTransfer} transfer @returns {AsyncGenerator<Dropped>}
 */
export function dropped(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  return entries.length ? walk(entries) : chosen(transfer.files);
}

/** Files of a file input, of which one for folders tells the paths. @param {Iterable<File>} files */
export async function* chosen(files) {
  for (const file of [...files]) yield { file, path: file.webkitRelativePath || file.name };
}

/** Files of entries of a drop, folders walked through. @param {any[]} entries @returns {AsyncGenerator<Dropped>} */
export async function* walk(entries) {
  for (const entry of entries) {
    if (entry.name.startsWith(".")) continue;
    if (entry.isFile) {
      const file = await new Promise((resolve, reject) => { entry.file(resolve, reject); }).catch(() => null);
      yield { file, path: entry.fullPath.replace(/^\//, "") };
      continue;
    }
    const reader = entry.createReader();
    for (;;) { // a hundred at a time
      const some = await new Promise((resolve, reject) => { reader.readEntries(resolve, reject); }).catch(() => null);
      if (some === null) yield { file: null, path: entry.fullPath.replace(/^\//, "") };
      if (!some?.length) break;
      yield* walk(some);
    }
  }
}

/**
 * Sort what came: frames and archives, what they lack and what belongs to none of them.
 * @param {AsyncIterable<Dropped>} files @param {AbortSignal} signal
 * @returns {Promise<{found: Found[], fields: Object<string, any>[], left: string[], faults: string[]}>}
 *   fields: of files that were dropped without a folder, for the form; left: paths of what is not
 *   sent; faults: files that should say something and do not
 */
export async function taken(files, signal) {
  const frames = [];
  const [beside, poses] = [new Map(), new Map()];
  /** @type {Object<string, any>[]} */
  const fields = [];
  /** @type {string[][]} */
  const [left, faults] = [[], []];
  let since = performance.now();
  for await (const { file, path } of files) {
    if (signal.aborted) break;
    if (file === null) { faults.push(`${path} cannot be read.`); continue; }
    const source = await kindOf(file).catch(() => ({ kind: "other" }));
    if (source.kind === "pose") poses.set(`${folderOf(path)}/${stemOf(file.name)}`, file);
    else if (source.kind === "camera" || source.kind === "clouds") {
      try {
        const said = await fieldsOf(file);
        const folder = folderOf(path);
        if (folder === "") fields.push(said);
        else beside.set(`${folder}|${source.kind}`, said);
      } catch (error) {
        faults.push(error.message);
      }
    } else if (source.kind === "other") left.push(path);
    else frames.push({ file, path, source });
    if (performance.now() - since > BREATH_MS) {
      await new Promise((resolve) => { setTimeout(resolve); });
      since = performance.now();
    }
  }
  // folders tell their files in an order of their own
  if (frames.some((one) => one.path.includes("/"))) frames.sort((a, b) => NATURAL.compare(a.path, b.path));
  const found = frames.map((one) => ({
    ...one,
    said: isImport(one.source) ? {} : nearest(beside, one),
    pose: isImport(one.source) ? null : poses.get(`${folderOf(one.path)}/${stemOf(one.file.name)}`) ?? null,
  }));
  return { found, fields, left, faults };
}

/** Whether a file becomes many frames, which the service reads from it. @param {import("./kinds.js").Source} source */
export function isImport({ kind }) {
  return kind === "archive" || kind === "map" || kind === "recording";
}

/** What was dropped on another page, by map: the page Upload takes it. @type {Map<string, Dropped[]>} */
export const handed = new Map();

function nearest(beside, { path, source }) {
  const kind = source.kind === "cloud" ? "clouds" : "camera";
  let folder = folderOf(path);
  for (let up = 0; up <= PARENTS && folder !== ""; up += 1) {
    const said = beside.get(`${folder}|${kind}`);
    if (said) return said;
    folder = folderOf(folder);
  }
  return {};
}

const MOST_OF_NAME = 255;
const SEVEN_SCENES = /^frame-(\d{1,15})\.depth\.png$/;

/**
 * What files are called, and their places in their sessions: the number of the file where the layout has
 * one, else its place among those of its folder; a file alone has none.
 * @param {{path: string, file: File}[]} found in their order
 * @returns {{name: string, sequence?: number}[]}
 */
export function labelsOf(found) {
  const counts = new Map(), places = new Map();
  for (const { path } of found) counts.set(folderOf(path), (counts.get(folderOf(path)) ?? 0) + 1);
  return found.map(({ path, file }) => {
    const folder = folderOf(path), place = places.get(folder) ?? 0;
    places.set(folder, place + 1);
    // as the service takes it: whatever a file is called, its frame is sent
    // eslint-disable-next-line no-control-regex
    const name = file.name.replace(/[\u0000-\u001f\u007f\\/\p{Cs}]/gu, "_").slice(-MOST_OF_NAME);
    const number = SEVEN_SCENES.exec(file.name);
    if (number) return { name, sequence: Number(number[1]) };
    return counts.get(folder) > 1 ? { name, sequence: place } : { name };
  });
}

/** The folders of a path. @param {string} path */
export function folderOf(path) {
  return path.includes("/") ? path.slice(0, path.lastIndexOf("/")) : "";
}

/**
 * What a folder says of session and parent frame, as `sceneprint upload` names them: SCENE/seq-01 in
 * SCENE, or the folder in itself.
 * @param {string} path of a frame
 * @returns {{session: string, parent_frame: string}} "" where it was dropped without a folder
 */
export function namesOf(path) {
  const folders = folderOf(path).split("/").filter(Boolean);
  const [scene, own] = [folders.at(-2), folders.at(-1) ?? ""];
  return scene && /^seq-?\d+$/i.test(own)
    ? { session: `${scene}/${own}`, parent_frame: scene } : { session: own, parent_frame: own };
}
