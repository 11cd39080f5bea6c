// What an overlay is made of, asked for from the API: the page and the inset of an answer share it.
import { at, bytes, get } from "../lib/api.js";
import { parsePoints } from "../viewer/points.js";
import { isOptical } from "./words.js";

const POINTS = "application/vnd.sceneprint.points";
/** The API's word for a pose. */
export const TRANSFORM = { before: "none", aligned: "aligned", rival: "rival" };

/**
 * Addresses of a match, and how its parts are loaded.
 * @param {string} query id of an answer @param {string} frame id of the match
 * @param {string | undefined} map of the match @param {AbortSignal} signal
 */
export function overlayParts(query, frame, map, signal) {
  const match = at("queries", query, "matches", frame);
  const side = async (one, pose) => parsePoints(await bytes(`${match}/points`, {
    params: { map, side: one, transform: TRANSFORM[pose] }, signal, accept: POINTS,
  }));
  return {
    match,
    details: () => get(match, { params: { map }, signal }),
    points: async (pose) => {
      const [a, b] = await Promise.all([side("query", pose), side("match", pose)]);
      return { query: a, match: b };
    },
    // cameras and names are for the eye alone: a page does without where a frame has gone
    frame: (one) => get(at("maps", one.map, "frames", one.frame_id), { signal }).catch((error) => {
      if (error.name === "AbortError" || error.status === 401) throw error;
      return null;
    }),
  };
}

/** A camera to draw: as it is known, else as wide as what was seen; null of a cloud's sensor. */
export function lens(frame, points, kind) {
  if (frame?.intrinsics) return frame.intrinsics;
  if (kind === "cloud") return null;
  const { origin: [x, y, z], extent: [w, d, deep] } = points, far = z + deep;
  return { width: w, height: d, fx: far, fy: far, cx: -x - 0.5, cy: -y - 0.5 }; // pixels begin at -0.5
}

/** What both clouds are, to be drawn: cameras, and which axis is up. */
export function sensorsOf(details, answer, { asked, matched }, aligned) {
  const parent = details.transform?.parent_frame;
  const kind = matched?.kind ?? (parent ? (isOptical(parent) ? "depth" : "cloud") : answer.kind);
  return {
    up: /** @type {"z" | "-y"} */ (kind === "cloud" ? "z" : "-y"),
    cameras: { query: lens(asked, aligned.query, answer.kind), match: lens(matched, aligned.match, kind) },
  };
}
