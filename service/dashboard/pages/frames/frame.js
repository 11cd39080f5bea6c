// One frame: what it looks like, what is known of it, which frames are near.
import { at, bytes, get, save } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { frameLabel } from "../lib/format.js";
import { link } from "../lib/router.js";
import { may } from "../lib/session.js";
import { confirm } from "../lib/states.js";
import { about } from "./about.js";
import { deleteFrames } from "./changes.js";
import { editFrame } from "./edit.js";
import { follow } from "./following.js";
import { neighbours } from "./neighbours.js";
import { preview } from "./tile.js";
import { viewSwitch } from "./views.js";

export const styles = ["frames/frames.css", "frames/frame.css"];

const WIDTH = 640;

/** The page: #/maps/NAME/frames/ID?view= */
export async function render(root, { params, search, signal, go, title, actions }) {
  const path = at("maps", params.map, "frames", params.frame);
  let frame = await get(path, { signal });
  let job = await jobOf(frame);
  const canWrite = may("write", params.map);
  const side = h("div", { class: "frame-side" });
  const main = h("div", { class: "frame-main" });
  /** @type {string | null} */
  let drawn = null; // the state that the main part shows
  title(`Frame ${frameLabel(frame)}`);
  put(root, h("div", { class: "frame-page" }, main, side));

  async function draw() {
    const isEdit = document.activeElement?.id === "edit";
    put(side, about(frame, job, { edit: canWrite && frame.state !== "deleted" ? () => editFrame(frame, take) : undefined }));
    if (isEdit) document.getElementById("edit")?.focus();
    if (drawn === frame.state) return;
    drawn = frame.state;
    actions(
      frame.state === "indexed" && h("a", { class: "button primary", href: link("maps", params.map, "query", { frame: frame.frame_id }) }, "Locate this frame"),
      canWrite && frame.state !== "deleted" && h("button", { class: "button danger", type: "button", onClick: remove }, "Delete"));
    if (frame.state !== "indexed") { put(main, look()); return; }
    const { scene } = await import("./scene.js");
    const cards = await scene(frame, signal);
    if (!signal.aborted && frame.state === "indexed") put(main, look(), cards, neighbours(frame, signal));
  }

  /** The picture, with what its colours mean, and the files. */
  function look() {
    const place = h("div", { class: "frame-look" });
    const meaning = h("p", { class: "muted frame-meaning" });
    const show = async (view) => {
      const shown = preview(frame, { view, width: WIDTH, signal });
      put(place, shown);
      put(meaning);
      if (frame.state !== "indexed" || !(await shown.querySelector("canvas")?.ready)) return;
      const png = await bytes(`${path}/preview.png`, { params: { view, width: WIDTH }, signal, accept: "image/png" });
      if (shown.isConnected) put(meaning, textOf(png, "Description")); // else another view was chosen meanwhile
    };
    const first = ["normals", "patches"].includes(search.get("view")) ? search.get("view") : "depth";
    const views = viewSwitch(first, (view) => {
      go(link("maps", params.map, "frames", params.frame, view === "depth" ? {} : { view }), { replace: true, quiet: true });
      show(view);
    });
    show(first);
    return h("section", { class: "card", "aria-labelledby": "look-title" },
      h("div", { class: "card-head" }, h("h2", { id: "look-title" }, "Sensor view"), frame.state === "indexed" && views),
      place, meaning, files());
  }

  function files() {
    const button = (text, file, name) => h("button", { class: "button", type: "button", onClick: () => save(`${path}/${file}`, name ? { name } : {}) }, text);
    if (frame.state === "deleted" || frame.state === "redundant") return null;
    return h("div", { class: "toolbar", role: "group", "aria-label": "Download" },
      button("Upload", "upload"),
      frame.state === "indexed" && [button("Cloud (PLY)", "cloud.ply", `${frame.frame_id}.ply`),
        button("Signature", "signature", `${frame.frame_id}.signature.json`), button("Patches", "patches", `${frame.frame_id}.patches.json`)]);
  }

  async function remove() {
    const sure = await confirm({
      title: "Delete this frame?", action: "Delete",
      text: "Queries no longer find it. You can undo this for a while: the message that follows says until when.",
    });
    if (!sure) return;
    await deleteFrames(params.map, { frame_ids: [frame.frame_id] });
    if (!signal.aborted) go(link("maps", params.map));
  }

  function take(given) {
    frame = { ...frame, ...given };
    return draw();
  }

  // who may not see jobs sees the frame all the same
  function jobOf(of) {
    return get(at("jobs", of.job_id), { signal }).catch((error) => {
      if (error.name === "AbortError" || error.status === 401 || error.status === 0) throw error;
      return null;
    });
  }

  await draw();
  follow({
    map: params.map, signal,
    shown: (id) => id === frame.frame_id,
    pending: () => [frame.frame_id],
    changed: async (given) => {
      if (given.etag === frame.etag && given.state === frame.state) return;
      job = given.job_id ? await jobOf(given) : job;
      await take(given);
    },
    missed: () => {}, // it is pending
  });
}

/** A tEXt chunk of a PNG; "" where it has none of that name. */
function textOf(png, name) {
  const view = new DataView(png);
  const latin = new TextDecoder("latin1");
  for (let from = 8; from + 12 <= png.byteLength;) {
    const length = view.getUint32(from);
    const type = latin.decode(new Uint8Array(png, from + 4, 4));
    if (type === "IDAT" || from + 12 + length > png.byteLength) break;
    if (type === "tEXt") {
      const [key, ...text] = latin.decode(new Uint8Array(png, from + 8, length)).split("\0");
      if (key === name) return text.join("");
    }
    from += 12 + length;
  }
  return "";
}
