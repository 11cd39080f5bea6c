// What the API knows of the paths of a map, a part of it at a time: never a full list of frames.

import { at, get, list } from "../lib/api.js";
import { paletteOf } from "../lib/palette.js";
import { ofQuaternion } from "../viewer/matrix.js";

/** Runs that are told of at most, and drawn in one picture; poses of all of them together. */
export const MOST_RUNS = 1000, MOST_DRAWN = 40;
const POSES = 6000, MOST_POSES = 2000;
/** Colours of runs that paths.css has. */
const COLOURS = 8;
/** Edges that are drawn, at most. */
export const MOST_EDGES = 2000;

/**
 * @typedef {{session: string, robot: string | null, parent: string, number: number, colour: number, frames: number, isVirtual: boolean,
 *   first: string | null, last: string | null}} Run
 *   number: its place in the list of sessions; colour: of those of paths.css; frames: of the session, with those that have no pose;
 *   isVirtual: views rendered of a whole map, which no robot took on one way
 * @typedef {Run & {ids: string[], times: number[], poses: number[][], posed: number, leftOut: number,
 *   camera: Object<string, number> | null, isCloud: boolean, stamps: "captured" | "sequence" | "received" | null}} Path
 *   poses: T_parent_sensor, 16 column-major; times: seconds, or places in the session where stamps are `sequence`
 */

/**
 * The runs of a map that have poses, one for each frame that these lead to; and why others are not
 * among them.
 * @param {Object<string, any>[]} sessions as the API lists them
 * @returns {{runs: Run[], without: {name: string, frames: number, why: string}[]}}
 */
export function runsOf(sessions) {
  const runs = [], without = [];
  const robots = new Map();
  for (const one of sessions) robots.set(one.session, (robots.get(one.session) ?? 0) + 1);
  for (const one of sessions) {
    const frames = Object.values(one.frames).reduce((a, b) => a + b, 0);
    const name = one.session ?? (one.robot === null ? "Frames without a session" : `${one.robot}, no session`);
    if (one.with_pose === 0) {
      without.push({ name, frames, why: "no poses" });
    } else if (one.session === null) {
      without.push({ name, frames, why: "poses, but no session, which a path needs" });
    } else if (one.robot === null && robots.get(one.session) > 1) {
      without.push({ name, frames, why: "no robot, and several robots have runs of this name" });
    } else {
      for (const parent of one.parent_frames) {
        runs.push({
          session: one.session, robot: one.robot, parent, frames, number: runs.length, colour: 0, isVirtual: one.tags.includes("virtual"),
          first: one.first_captured_at, last: one.last_captured_at,
        });
      }
    }
  }
  colourRuns(runs);
  return { runs, without };
}

/** The frame that most frames have poses in; null without runs. @param {Run[]} runs */
export function commonest(runs) {
  const counts = new Map();
  for (const one of runs) counts.set(one.parent, (counts.get(one.parent) ?? 0) + one.frames);
  return [...counts].sort((a, b) => b[1] - a[1] || a[0].localeCompare(b[0]))[0]?.[0] ?? null;
}

/** Give each run a colour; those that began first choose first. @param {Run[]} runs changed in place */
function colourRuns(runs) {
  const name = (one) => JSON.stringify([one.session, one.robot, one.parent]);
  const order = (a, b) => (a.first ?? "~").localeCompare(b.first ?? "~") || name(a).localeCompare(name(b));
  const colours = paletteOf(runs.toSorted(order).map(name), COLOURS);
  for (const one of runs) one.colour = colours.get(name(one)) ?? 0;
}

/** All sessions, up to MOST_RUNS. @returns {Promise<{items: Object<string, any>[], more: boolean}>} */
export async function sessionsOf(map, signal) {
  const page = await get(at("maps", map, "sessions"), { params: { limit: MOST_RUNS }, signal });
  return { items: page.items, more: page.next_cursor !== null };
}

/**
 * The poses of a run, thinned to a share of what is drawn in all.
 * @param {string} map @param {Run} run @param {number} share of so many runs
 * @returns {Promise<Path>}
 */
export async function pathOf(map, run, share, signal) {
  const { session, robot, parent } = run;
  const most = Math.max(Math.min(Math.floor(POSES / share), MOST_POSES), 50);
  const params = { session, robot, parent_frame: parent, most };
  const sample = { session, robot: robot ?? [], parent_frame: parent, has_pose: true, limit: 1 };
  const trajectory = async (clock) => get(at("maps", map, "trajectory"), { params: { ...params, clock }, signal });
  const [told, frames] = await Promise.all([
    trajectory("taken").then((found) => (found.stamps === null ? trajectory("received") : found)),
    get(at("maps", map, "frames"), { params: sample, signal }),
  ]);
  const first = frames.items[0];
  return {
    ...run, ids: told.frame_ids, times: told.poses.map((row) => row[0]), posed: told.posed,
    poses: told.poses.map(([, x, y, z, ...q]) => ofQuaternion(q, [x, y, z])),
    leftOut: told.left_out, stamps: told.stamps,
    camera: first?.intrinsics ?? null, isCloud: first?.kind === "cloud",
  };
}

/** Associations of a map, the newest first. */
export async function associationsOf(map, signal) {
  const page = await get(at("maps", map, "associations"), { params: { limit: 100 }, signal });
  return page.items;
}

/** Edges of an association in the order in which they were found, up to MOST_EDGES. */
export async function edgesOf(map, association, signal) {
  const { items, cursor } = await list(at("maps", map, "associations", association, "edges"), { signal, most: MOST_EDGES });
  return { edges: items, more: cursor !== null };
}
