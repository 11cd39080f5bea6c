// Upload: files dropped or chosen, what is said of them, and what became of each.
import { h, put, throttle } from "../lib/dom.js";
import { bytes, count, things } from "../lib/format.js";
import { link } from "../lib/router.js";
import { may, me } from "../lib/session.js";
import { empty } from "../lib/states.js";
import { follow } from "./following.js";
import { chosen, dropped, handed, isImport, taken } from "./intake.js";
import { ACCEPT, titlesOf } from "./kinds.js";
import { queueOf } from "./queue.js";
import { recordingFields } from "./recording.js";
import { groupOf, rowsOf } from "./rows.js";
import { cameraFields, hasCamera, remember, settingField, settingsForm } from "./source.js";
import { mapFields } from "./wholemap.js";

const ALOUD_MS = 5000;

export const styles = ["plan/plan.css", "coverage/coverage.css", "frames/source.css", "frames/upload.css", "frames/frames.css"];

/** The page: #/maps/NAME/upload */
export async function render(root, { params, signal, actions, about }) {
  const map = await about;
  if (!may("write", params.map)) {
    put(root, empty({ title: "Your key may not upload here", text: `“${me()?.name}” can only read this map. To upload, a key needs the scope “write” for it.` }));
    return;
  }
  const queue = queueOf(params.map);
  const said = h("p", { class: "field-error", role: "alert" });
  const note = h("p", { class: "muted", role: "status" });
  const summary = h("div", { class: "upload-sum" });
  const status = h("strong");
  const aloud = h("p", { class: "visually-hidden", role: "status" }); // the same, less often
  const stop = h("p", { class: "field-error", role: "alert" });
  const rows = rowsOf(queue, signal);
  const fields = cameraFields(queue.given);
  const start = h("button", { class: "button primary", type: "button", onClick: begin });
  const cancel = h("button", { class: "button", type: "button", onClick: () => queue.cancelAll() }, "Cancel all");
  const tidy = h("button", { class: "button quiet", type: "button", onClick: () => queue.remove(queue.items.filter((one) => groupOf(one.state) === "done")) }, "Clear finished");
  const retry = h("button", { class: "button", type: "button", onClick: () => queue.again(queue.untaken()) });
  const bar = h("div", { class: "upload-bar" }, summary, h("div", { class: "toolbar" }, tidy, retry, cancel, start));
  const place = dropZone((files) => take(files));
  put(root, h("div", { class: "upload" },
    h("div", { class: "upload-main" }, place, note, bar, aloud, said, rows),
    h("aside", { class: "card upload-said", "aria-label": "Metadata of the files" }, whoFields(queue.given), fields, mapFields(queue.given), recordingFields(queue.given))));
  actions(h("a", { class: "button", href: link("maps", params.map) }, "To the frames"));

  async function take(files) {
    put(note, "Reading the dropped files…");
    const { found, fields: told, left, faults } = await taken(files, signal);
    if (signal.aborted) return [];
    for (const one of told) Object.assign(queue.given, one);
    if (told.length) { remember(queue.given); fields.refill(); }
    queue.add(found);
    const words = [...faults];
    if (told.length) words.push("The camera settings were read from the dropped files.");
    const beside = found.filter((one) => Object.keys(one.said).length).length;
    if (beside) words.push(`${count(beside)} of ${count(found.length)} use the intrinsics.json or clouds.json in their folder.`);
    if (left.length) words.push(`${things(left.length, "file was", "files were")} skipped, not a frame: ${left.slice(0, 3).join(", ")}${left.length > 3 ? ", …" : ""}`);
    if (!found.length && !told.length && !left.length && !faults.length) words.push("It contains nothing readable.");
    put(note, words.join(" "));
    put(said);
    return found;
  }

  function begin() {
    const ready = queue.items.filter((one) => one.state === "ready");
    const blind = ready.find((one) => one.source.kind === "depth" && !hasCamera({ ...queue.given, ...one.said }));
    const lost = ready.find((one) => one.pose && ![queue.given.session, queue.given.parent_frame].some((text) => text.trim()) && !one.path.includes("/"));
    if (blind) return missing("fx", `${blind.file.name} is a depth image: enter its camera (fx, fy, cx, cy), or drop an intrinsics.json with it.`);
    if (lost) return missing("session", `${lost.file.name} has a pose: enter its session, or the parent frame of the pose.`);
    put(said);
    queue.start();
    return show(null);
  }

  function missing(name, text) {
    put(said, text);
    root.querySelector(`.upload-said [name="${name}"]`).focus();
  }

  const sumSoon = throttle(sum, 200, signal);
  function show(item) {
    if (item?.frame_id) following?.look(item.frame_id);
    rows.update(item);
    sumSoon();
  }

  function sum() {
    const states = {};
    let [size, sent] = [0, 0];
    for (const { state, file, share } of queue.items) {
      const named = state === "sending" || state === "waiting" ? state : groupOf(state) === "refused" && state !== "cancelled" ? "refused" : state;
      states[named] = (states[named] ?? 0) + 1;
      size += file.size;
      sent += file.size * share;
    }
    const ready = states.ready ?? 0;
    const busy = (states.sending ?? 0) + (states.waiting ?? 0);
    put(start, ready ? `Upload ${things(ready, "file")}` : "Upload");
    start.hidden = ready === 0;
    bar.hidden = queue.items.length === 0;
    place.toggleAttribute("data-small", queue.items.length > 0);
    const untaken = queue.untaken().length;
    retry.hidden = untaken < 2;
    put(retry, `Retry ${count(untaken)}`);
    cancel.hidden = !(queue.running && busy);
    tidy.hidden = !queue.items.some((one) => groupOf(one.state) === "done");
    const words = { indexed: "indexed", redundant: "not needed", imported: "imported", received: "waiting for a worker", signing: "being signed",
      importing: "being imported", sending: "being sent", waiting: "in the queue", ready: "ready", refused: "refused", cancelled: "cancelled" };
    const parts = Object.keys(words).filter((one) => states[one]).map((one) => `${count(states[one])} ${words[one]}`);
    const sending = busy > 0 && queue.running;
    if (status.textContent !== parts.join(" · ")) put(status, parts.join(" · "));
    put(summary, queue.items.length > 0 && [
      status,
      h("span", { class: "muted number" }, sending ? `${bytes(sent)} of ${bytes(size)} sent` : bytes(size)),
      sending && h("progress", { max: size || 1, value: sent, "aria-label": "All files, sent" }),
      stop,
    ]);
    const why = queue.stopped?.status === 401 ? "Upload stopped: the service requires another key. Enter one, then upload the rest."
      : queue.stopped ? `Upload stopped, as all other files would be rejected too: ${queue.stopped.message}` : "";
    if (stop.textContent !== why) put(stop, why);
    tell(parts.join(" · "));
  }

  let toTell = "";
  const tellSoon = throttle(() => put(aloud, toTell), ALOUD_MS, signal);
  function tell(words) { // a count that moves five times a second is no speech
    toTell = words;
    if (toTell !== aloud.textContent) tellSoon();
  }

  document.addEventListener("drop", (event) => { // that misses its zone
    if (!event.dataTransfer?.types.includes("Files") || event.defaultPrevented) return;
    event.preventDefault();
    take(dropped(/** @type {DataTransfer} */ (event.dataTransfer)));
  }, { signal });
  const given = handed.get(params.map);
  handed.delete(params.map);
  // a recording or a map says by itself what it is; frames may need a camera
  if (given) take(given).then((found) => {
    // one cloud for a map without frames is hardly one scan; whoever looks at it can say otherwise
    const isEmpty = Object.values(map.frames).every((n) => n === 0);
    if (isEmpty && found.length === 1 && found[0].source.kind === "cloud") queue.change(queue.items.at(-1), { isMap: true });
    else if (found.length > 0 && found.every((one) => isImport(one.source))) begin();
  });
  queue.listeners.add(show);
  signal.addEventListener("abort", () => queue.listeners.delete(show), { once: true });
  sum();
  const following = follow({
    map: params.map, signal,
    shown: (id) => queue.byFrame.has(id),
    pending: () => queue.pending(),
    changed: (frame) => queue.became(frame),
    missed: () => {}, // those that are pending are looked at
  });
}

function dropZone(take) {
  const pick = (props) => h("input", { type: "file", multiple: true, class: "visually-hidden", tabindex: "-1", "aria-hidden": "true", ...props,
    onChange: (event) => { take(chosen(event.target.files)); event.target.value = ""; } });
  const [files, folder] = [pick({ accept: ACCEPT, name: "files" }), pick({ webkitdirectory: true, name: "folder" })];
  const zone = h("div", { class: "drop" }, files, folder,
    h("strong", {}, "Drop a recording, frames, folders, archives or a whole map here"),
    h("p", { class: "muted" }, `Recordings (MCAP, ROS 1), depth images (${titlesOf("depth")}), point clouds (${titlesOf("cloud")}), or archives (${titlesOf("archive")}). A file of ${titlesOf("map")}, or a cloud marked as a whole map, becomes the map. An intrinsics.json, clouds.json or NAME.pose.txt beside them is read.`),
    h("div", { class: "toolbar" },
      h("button", { class: "button", type: "button", onClick: () => files.click() }, "Choose files"),
      h("button", { class: "button", type: "button", onClick: () => folder.click() }, "Choose a folder")));
  let depth = 0; // of elements within that are dragged over: each of them tells
  const over = (change) => (event) => {
    event.preventDefault();
    depth += change;
    zone.toggleAttribute("data-over", depth > 0);
  };
  zone.addEventListener("dragenter", over(1));
  zone.addEventListener("dragleave", over(-1));
  zone.addEventListener("dragover", (event) => event.preventDefault());
  zone.addEventListener("drop", (event) => { depth = 0; over(0)(event); take(dropped(/** @type {DataTransfer} */ (event.dataTransfer))); });
  return zone;
}

function whoFields(given) {
  const field = (name, label, placeholder) => settingField(name, label, { placeholder });
  return settingsForm(given, h("fieldset", {}, h("legend", {}, "Source"),
    h("div", { class: "source-row" },
      field("robot", "Robot", "none"), field("session", "Session", "folder name"),
      field("tags", "Tags", "door, north"), field("parent_frame", "Parent frame of poses", "same as the session"))));
}
