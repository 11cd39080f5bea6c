// What is asked: a frame of the map by its id or from a small gallery, or a file that is dropped.
import { cameraFields, hasCamera, remember, settings } from "../frames/source.js";
import { ACCEPT, fieldsOf, kindOf, titlesOf } from "../frames/kinds.js";
import { h, put } from "../lib/dom.js";
import { shortId } from "../lib/format.js";
import { pickFrame } from "./picker.js";

/**
 * @param {{map: string, pictures: any, signal: AbortSignal, onchoose: (source: import("./asking.js").Source) => void}} how
 * @returns {HTMLElement & {tell: (source: any) => void, pick: (title?: string) => Promise<string | null>}}
 */
export function chooser({ map, pictures, signal, onchoose }) {
  const given = settings();
  /** @type {File | null} */
  let waiting = null; // a depth image whose camera is not known yet
  const fields = cameraFields(given, { onchange: () => { send.disabled = !hasCamera(given); } });
  const send = h("button", { type: "button", class: "button primary", onclick: () => take(waiting) }, "Query with this file");
  const camera = h("details", { class: "query-camera" }, h("summary", {}, "Camera settings"), fields, send);
  const told = h("span", { class: "query-source" }, "No query yet.");
  const wrong = h("p", { class: "field-error", role: "alert" });
  const file = h("input", { type: "file", accept: ACCEPT, class: "visually-hidden", id: "ask-file", multiple: true,
    onchange: () => { read([...file.files ?? []]); file.value = ""; } });
  const pick = (title) => pickFrame(map, { pictures, signal, title });

  /** A frame, with the camera that lies beside it, or before or after it. */
  async function read(files) {
    put(wrong);
    const kinds = await Promise.all(files.map(kindOf));
    let one = waiting;
    for (const [i, { kind }] of kinds.entries()) {
      if (kind === "camera" || kind === "clouds") Object.assign(given, await fieldsOf(files[i]));
      else one = files[i];
    }
    fields.refill();
    if (!one) return;
    const { kind } = await kindOf(one);
    if (kind !== "depth" && kind !== "cloud") {
      put(wrong, `${one.name} is neither a depth image (${titlesOf("depth")}) nor a point cloud (${titlesOf("cloud")}).`);
      return;
    }
    if (kind === "depth" && !hasCamera(given)) {
      waiting = one;
      camera.open = true;
      send.hidden = false;
      send.disabled = true;
      put(wrong, `${one.name} is a depth image: enter its camera settings.`);
      fields.querySelector("input")?.focus();
      return;
    }
    take(one);
  }

  function take(one) {
    waiting = null;
    put(wrong);
    send.hidden = true;
    camera.open = false;
    remember(given);
    onchoose({ file: one, given: { ...given } });
  }

  send.hidden = true;
  const element = h("section", { class: "card query-source-card", "aria-label": "Query frame",
    ondragover: (event) => { event.preventDefault(); element.dataset.over = "true"; },
    ondragleave: () => { element.dataset.over = "false"; },
    ondrop: (event) => { event.preventDefault(); element.dataset.over = "false"; read([...event.dataTransfer.files]); } },
  h("div", { class: "toolbar query-source-bar" },
    told,
    h("span", { class: "query-source-actions toolbar" },
      h("button", { type: "button", class: "button", onclick: async () => {
        const id = await pick();
        if (id !== null) onchoose({ frame: { map, frame_id: id } });
      } }, "Pick a frame…"),
      h("label", { class: "button query-file", for: "ask-file" }, "Choose a file…"), file,
      h("span", { class: "muted query-drop" }, "or drop one here"))),
  wrong, camera);
  return Object.assign(element, {
    pick,
    tell(source) {
      put(told, !source ? "No query yet." : source.file ? ["File ", h("strong", {}, source.file.name)]
        : source.frame ? ["Frame ", h("strong", { class: "mono", title: source.frame.frame_id }, shortId(source.frame.frame_id)), source.frame.map === map ? "" : ` of map ${source.frame.map}`]
          : ["The frame of answer ", h("strong", { class: "mono" }, shortId(source.query))]);
    },
  });
}
