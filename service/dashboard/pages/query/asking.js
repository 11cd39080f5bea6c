// One source of queries - a stored frame, a file, or an earlier query - asked again and again.
import { at, send } from "../lib/api.js";
import { formOf } from "../frames/source.js";
import { fill, plain } from "./options.js";

/**
 * @typedef {{frame?: {map: string, frame_id: string}, file?: File, given?: Object<string, any>, query?: string, base?: Object<string, any>}} Source
 *   a frame of a map; a file, with its metadata; the id of an earlier query, with its options. A
 *   file that was sent once has both `file` and `query`
 */

/**
 * Ask once.
 * @param {Source} source `query` is set when a file has been asked: the next time it is not sent
 * @param {string[] | "*"} maps @param {Object<string, any>} options of `toOptions`
 * @param {AbortSignal} signal @returns {Promise<Object<string, any>>} the answer
 */
export async function ask(source, maps, options, signal) {
  if (source.query) {
    try {
      return await repeat(source.query, maps, { ...source.base, ...options }, signal);
    } catch (error) {
      // no longer stored, or of another model by now: with the file at hand it is simply sent again
      if (!source.file || ![404, 409].includes(error.status)) throw error;
      source.query = undefined;
    }
  }
  if (source.file) {
    const form = fill(await formOf(source.file, source.given ?? {}), options);
    if (maps === "*" || maps.length > 1) form.append("maps", maps === "*" ? "*" : maps.join(","));
    const path = maps === "*" || maps.length > 1 ? "queries" : `${at("maps", maps[0])}/queries`;
    const { data } = await send("POST", path, { form, signal });
    source.query = data.query_id;
    return data;
  }
  const { map, frame_id: id } = /** @type {{map: string, frame_id: string}} */ (source.frame);
  if (maps !== "*" && maps.length === 1 && maps[0] === map) {
    return (await send("POST", `${at("maps", map)}/queries`, { json: { frame_id: id, ...plain(options) }, signal })).data;
  }
  return (await send("POST", "queries", { json: { maps, frame: source.frame, ...plain(options) }, signal })).data;
}

/**
 * Repeat an earlier query.
 * @param {string} id @param {string[] | "*"} maps @param {Object<string, any>} options all of them; null for a default
 * @param {AbortSignal} signal
 */
export async function repeat(id, maps, options, signal) {
  return (await send("POST", "queries", { json: { maps, query_id: id, ...plain(options) }, signal })).data;
}
