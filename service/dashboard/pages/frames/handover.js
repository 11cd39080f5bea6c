// Files that are dropped on a page that does not take them: they go to the page Upload of the map that
// is shown, or of a new one.
import { link } from "../lib/router.js";
import { may, me } from "../lib/session.js";
import { toast } from "../lib/states.js";
import { createMap } from "../maps/edit.js";
import { chosen, handed, walk } from "./intake.js";
import { kindOf, stemOf } from "./kinds.js";

const TAIL = 1 << 20; // bytes at the end of a recording, where its types of messages are listed

/**
 * Take files to the page Upload.
 * @param {{entries: any[], files: File[]}} drop files: where there are no entries
 * @param {{route: any, params: Object<string, string>}} where the page that is shown
 * @param {(hash: string) => void} go @param {AbortSignal} signal of that page
 */
export async function handOver({ entries, files }, { route, params }, go, signal) {
  const given = [];
  for await (const one of entries.length ? walk(entries) : chosen(files)) given.push(one);
  const upload = (map) => { handed.set(map, given); go(link("maps", map, "upload")); };
  if (params.map) { upload(params.map); return; }
  if (route?.path !== "") { toast("Drop the files on the page Maps, or on a map.", { kind: "bad" }); return; }
  if (!may("admin") && !Object.values(me()?.grants ?? {}).includes("admin")) { toast("Your key may not create maps. Open a map, and drop the files there.", { kind: "bad" }); return; }
  const name = stemOf(given[0]?.path.split("/")[0] ?? "").toLowerCase().replace(/[^a-z0-9_-]+/g, "-").replace(/^[-_]+|-+$/g, "").slice(0, 63);
  const first = given.find((one) => one.file)?.file;
  await createMap(go, signal, { name, model: first && await isScan(first) ? "lidar" : "depth", created: upload });
}

/** Whether a file has points rather than depth images, as far as its start and its end tell. */
async function isScan(file) {
  const { kind } = await kindOf(file);
  if (kind !== "recording") return kind === "cloud" || kind === "map";
  const tail = await file.slice(-TAIL).text();
  return /sensor_msgs\/(msg\/)?PointCloud2/.test(tail) && !/depth/i.test(tail);
}
