// Files on their way into a map: a few at a time, each with a state of its own. A queue outlives
// the page that shows it, so that one may look around while it works.
import { at, get, send } from "../lib/api.js";
import { isPending } from "./badge.js";
import { folderOf, isImport, labelsOf, namesOf } from "./intake.js";
import { poseOf, stemOf } from "./kinds.js";
import { measure, recordingParams } from "./recording.js";
import { formOf, settings } from "./source.js";
import { mapParams } from "./wholemap.js";

const AT_ONCE = 3;
const TRIES = 6; // where nothing answers, or too much is asked
const POLL_S = 1;
const REST_S = 5;
// what would be said of all that follow as well
const ENDS_ALL = new Set([401, 403, 404, 507]);

/** @typedef {import("./intake.js").Found & {id: number, state: string, share: number, label: {name: string, sequence?: number},
 *   frame_id: string | null, job: Object<string, any> | null, reason: string | null, problem: Error | null,
 *   isThere: boolean, tries: number, until: number, stop: AbortController | null, isMap: boolean, topic?: string,
 *   step?: string | null, coverage?: Object<string, any> | null}} Item
 *   isMap: whether it is a whole map, of which views are rendered; topic: chosen among several of a recording;
 *   step: what the map waits for after the import of a recording; coverage: its result
 *   state: ready, waiting, sending, sent, importing, imported, refused, cancelled, or a frame's */

const queues = new Map();
let numbers = 0;

/** The queue of a map, the same until the tab is closed. @param {string} map @returns {Queue} */
export function queueOf(map) {
  if (!queues.has(map)) queues.set(map, new Queue(map));
  return queues.get(map);
}

// leaving the tab would cut them off; the browser asks in its own words
window.addEventListener("beforeunload", (event) => {
  if ([...queues.values()].some((one) => one.isBusy())) event.preventDefault();
});

export class Queue {
  constructor(map) {
    this.map = map;
    this.items = [];
    this.given = settings();
    this.folders = new Set(); // that files came from
    this.byFrame = new Map(); // the items of each: the same file may have been given twice
    this.running = false;
    this.stopped = null; // the Problem that ended all
    this.pausedUntil = 0;
    this.listeners = new Set(); // of items that changed
  }

  /** @param {import("./intake.js").Found[]} found */
  add(found) {
    const labels = labelsOf(found);
    for (const one of found) this.folders.add(folderOf(one.path));
    for (const [i, one] of found.entries()) {
      this.items.push({ ...one, label: labels[i], id: numbers += 1, state: "ready", share: 0, frame_id: null, job: null,
        reason: null, problem: null, isThere: false, tries: 0, until: 0, stop: null, isMap: one.source.kind === "map" });
    }
    this.tell(null);
  }

  /** Send all that is ready. */
  start() {
    this.again(this.items.filter((one) => one.state === "ready"));
  }

  /** Send items, for the first time or once more. @param {Item[]} items */
  again(items) {
    for (const item of items) Object.assign(item, { state: "waiting", problem: null, reason: null, tries: 0, share: 0, until: 0 });
    this.running = true;
    this.stopped = null;
    this.tell(null);
    this.next();
  }

  /** Those that were not taken, and may be when they are sent once more. */
  untaken() {
    return this.items.filter((one) => !one.job && (one.state === "refused" || one.state === "cancelled"));
  }

  isBusy() {
    return this.items.some((one) => one.state === "sending" || (this.running && one.state === "waiting"));
  }

  cancel(item) {
    item.stop?.abort();
    if (item.state === "importing") send("POST", `${at("jobs", item.job.job_id)}/cancel`); // main tells of a refusal
    else if (["ready", "waiting", "sending"].includes(item.state)) this.change(item, { state: "cancelled" });
  }

  cancelAll() {
    this.running = false;
    for (const item of this.items) if (item.state === "waiting") item.state = "cancelled";
    for (const item of this.items) if (item.state === "sending") this.cancel(item);
    this.tell(null);
  }

  /** Forget items: those that are over, or one. */
  remove(items) {
    const gone = new Set(items);
    for (const item of gone) item.stop?.abort();
    this.items = this.items.filter((one) => !gone.has(one));
    this.tell(null);
  }

  change(item, changes) {
    Object.assign(item, changes);
    this.tell(item);
  }

  tell(item) {
    for (const heard of this.listeners) heard(item);
  }

  next() {
    if (!this.running) return;
    const wait = this.pausedUntil - Date.now();
    if (wait > 0) { setTimeout(() => this.next(), wait); return; }
    let free = AT_ONCE - this.items.filter((one) => one.state === "sending").length;
    for (const item of this.items) {
      if (free <= 0) return;
      if (item.state !== "waiting") continue;
      free -= 1;
      this.sendOne(item);
    }
  }

  async sendOne(item) {
    item.stop = new AbortController();
    this.change(item, { state: "sending", share: 0, problem: null });
    try {
      // else the network would be blamed for it, and it asked again and again
      await item.file.slice(0, 1).arrayBuffer().catch(() => { throw new Error("The file can no longer be read: it was changed, moved or removed. Choose it again."); });
      if (isImport(item.source) || item.isMap) await this.sendImport(item);
      else await this.sendFrame(item);
    } catch (error) {
      this.refused(item, error);
    }
    this.next();
  }

  async sendFrame(item) {
    if (item.file.size === 0) throw new Error("The file is empty.");
    // the service would speak of the size of an image that this is not
    if (item.source.kind === "depth" && !item.source.format) throw new Error("Its name is that of a depth image, but its content is not.");
    const pose = item.pose ? await poseOf(item.pose) : null;
    const form = await formOf(item.file, this.saidOf(item), { source: item.source, pose, label: this.labelOf(item) });
    const answer = await send("POST", at("maps", this.map, "frames"), {
      form, signal: item.stop.signal, onprogress: (share) => this.change(item, { share }),
    });
    const { frame_id, job_id, state, reason } = answer.data;
    this.byFrame.set(frame_id, [...(this.byFrame.get(frame_id) ?? []).filter((one) => one !== item), item]);
    this.change(item, { frame_id, job: { job_id }, state, reason, share: 1, isThere: answer.status === 200 });
  }

  /** What a file is called, and its place: folders that go into one session follow each other there. */
  labelOf({ label, id }) {
    return this.given.session.trim() && this.folders.size > 1 ? { ...label, sequence: id } : label;
  }

  /** Settings of the form, with what lay beside a file in place of theirs. */
  saidOf(item) {
    const names = namesOf(item.path);
    const own = this.given;
    const session = own.session.trim() || names.session;
    let parent = own.parent_frame.trim();
    // two robots' folders may be called alike, and their poses lead nowhere in common
    if (!parent && !own.session.trim() && names.parent_frame) {
      parent = own.robot.trim() ? `${own.robot.trim()}/${names.parent_frame}` : names.parent_frame;
    }
    return { ...own, ...item.said, session, parent_frame: parent };
  }

  async sendImport(item) {
    const own = this.given, isBag = item.source.kind === "recording";
    if (item.source.format === "rosbag2") throw new Error(`A rosbag2 database is read where it is, with its folder. Run \`sceneprint upload ${this.map} FOLDER\` there.`);
    const stem = stemOf(item.file.name.replace(/\.tar\.\w+$/, ".tar"));
    // a map's format may be told by the ending of its name alone, and a recording is called after its file
    const name = item.isMap || isBag ? item.file.name.slice(-64) : stem.slice(0, 64);
    const params = { robot: own.robot.trim(), session: own.session.trim(), parent_frame: own.parent_frame.trim(),
      tags: own.tags.split(",").map((one) => one.trim()).filter(Boolean).join(","),
      name: name.replace(/^\.+/, "") || "import", ...(item.isMap ? mapParams(own) : isBag ? recordingParams({ ...own, bag_topic: item.topic ?? own.bag_topic }) : {}) };
    const { data } = await send("POST", at("maps", this.map, "imports"), {
      body: item.file, type: "application/octet-stream", params, signal: item.stop.signal,
      onprogress: (share) => this.change(item, { share }),
    });
    this.change(item, { state: "importing", job: data, share: 1 });
    this.followImport(item);
  }

  async followImport(item) {
    const path = at("jobs", item.job.job_id);
    let wait = POLL_S;
    while (item.state === "importing") {
      await new Promise((resolve) => { setTimeout(resolve, 1000 * wait); });
      let job;
      try { job = await get(path); wait = POLL_S; } catch (error) {
        wait = REST_S; // without a key, or an answer, it goes on all the same
        if (error.status !== 404) continue;
        this.change(item, { state: "refused", problem: error });
        return;
      }
      const over = job.state !== "queued" && job.state !== "running";
      const items = over ? await get(at("maps", this.map, "imports", item.job.job_id, "items"), { params: { limit: 1000 } }).catch(() => null) : null;
      const refused = items?.items.filter((one) => one.problem) ?? [];
      this.change(item, { job, refused, reason: job.error, state: over ? (job.state === "succeeded" ? "imported" : job.state) : "importing" });
      // a map that is left, or a key that is forgotten, ends it: the page Coverage has the rest
      if (item.state === "imported" && item.source.kind === "recording") measure(this.map, item, (changes) => this.change(item, changes)).catch(() => this.change(item, { step: null }));
    }
  }

  refused(item, error) {
    if (error.name === "AbortError") {
      if (item.state !== "cancelled") this.change(item, { state: "cancelled" });
      return;
    }
    const passes = error.status === 0 || error.status === 429 || error.status === 503;
    item.tries += 1;
    if (passes && item.tries < TRIES) {
      // as the service asks; where it does not answer at all, ever longer
      const seconds = error.retryAfter ?? 2 ** item.tries;
      this.pausedUntil = Math.max(this.pausedUntil, Date.now() + 1000 * seconds);
      this.change(item, { state: "waiting", problem: error, until: this.pausedUntil, share: 0 });
      return;
    }
    if (ENDS_ALL.has(error.status)) {
      this.running = false;
      this.stopped = error;
      for (const one of this.items) if (one.state === "waiting") this.change(one, { state: "ready" });
    }
    this.change(item, { state: "refused", problem: error, share: 0 });
  }

  /** What became of a frame of this queue. */
  became(frame) {
    for (const item of this.byFrame.get(frame.frame_id) ?? []) {
      if (isPending(item.state)) this.change(item, { state: frame.state, reason: frame.reason });
    }
  }

  /** Frames that are on their way to the index. */
  pending() {
    return this.items.filter((one) => one.frame_id && isPending(one.state)).map((one) => one.frame_id);
  }
}
