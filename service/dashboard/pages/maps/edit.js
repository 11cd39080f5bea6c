// Maps made, retitled and removed.
import { at, get, send } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { bytes, things } from "../lib/format.js";
import { saveFrom } from "../lib/form.js";
import { coded } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { me } from "../lib/session.js";
import { confirm, sheet, toast } from "../lib/states.js";

// what the models that ship are for; their size comes from the API
const FOR = {
  depth: ["Rooms", "For depth cameras indoors."],
  lidar: ["LiDAR", "For long-range scans: halls, storeys, city blocks."],
  paper: ["Paper", "For research: the long signatures of the paper, with exact search."],
};

/** Ask for a name, a title and a model, and make a map of them. @param {(hash: string) => void} go
 * @param {AbortSignal} signal @param {{name?: string, model?: string, created?: (name: string) => void}} [how]
 *   name, model: chosen at first; created: what is done in place of showing the map */
export async function createMap(go, signal, { name: first = "", model: wanted = "depth", created } = {}) {
  const { items } = await get("models", { signal });
  const name = h("input", { id: "new-name", name: "name", class: "mono", autocomplete: "off", spellcheck: "false", maxlength: 63, value: first });
  const title = h("input", { id: "new-title", name: "title", autocomplete: "off", maxlength: 200 });
  const models = items.filter((one) => one.preset).map((one) => choice(one, one.name === wanted));
  await form({
    title: "New map", action: "Create map",
    children: [
      field("Name", name, "Up to 63 lower-case letters, digits, hyphens and underscores, the first a letter or digit. It is part of every address and cannot be changed."),
      field("Title", title, "Optional display name; you can change it later."),
      h("fieldset", { class: "models" }, h("legend", {}, "Model"), models,
        h("p", { class: "field-error", id: "new-model-error", role: "alert" })),
    ],
    async save(dialog) {
      const model = dialog.querySelector("input[name=model]:checked")?.value;
      const json = { name: name.value.trim(), title: title.value.trim() || null, model };
      const { status, data } = await send("POST", "maps", { json });
      toast(status === 201 ? `${data.name} was created.` : `${data.name} already exists with these settings.`);
      if (created) created(data.name);
      else if (dialog.open) go(link("maps", data.name)); // else it was left meanwhile
    },
    place: (problem) => (problem.type === "map-exists" ? "name" : null),
  });
}

/** Ask for another title; an edit of another is not overwritten unseen. @param {() => Promise<void>} changed */
export async function retitleMap(map, changed) {
  let { etag } = map;
  const title = h("input", { id: "new-title", name: "title", autocomplete: "off", maxlength: 200, value: map.title ?? "" });
  await form({
    title: `Rename ${map.name}`, action: "Save title",
    children: [field("Title", title, "If empty, the name is shown.")],
    async save() {
      await send("PATCH", at("maps", map.name), {
        json: { title: title.value.trim() || null }, type: "application/merge-patch+json", headers: { "If-Match": `"${etag}"` },
      });
      toast(`The title of ${map.name} was changed.`);
      await changed();
    },
    async place(problem) {
      if (problem.type !== "precondition-failed") return null;
      const now = await get(at("maps", map.name));
      etag = now.etag;
      problem.detail = `Somebody else changed the title to “${now.title ?? now.name}” in the meantime. Save again to use yours.`;
      return "title";
    },
  });
}

/** Show the commands that copy a map, and all maps: a map can be larger than what a browser saves. @param {string} name */
export function copyMap(name) {
  const command = (text, line) => [h("p", {}, text), h("pre", { class: "dialog-text mono" }, line)];
  sheet({ title: `Back up or copy ${name}`, buttons: null, children: [
    command("To keep all maps, with their uploads and keys, on the machine of the service:", "sceneprint snapshot --to backup"),
    command(`To query ${name} on a robot without a network, or to keep it without its uploads:`,
      `sceneprint pull --map ${name} --url ${new URL(".", location.href)}${me() ? " --key KEY" : ""} --data copy`)] });
}

/** Ask for the name of a map to be typed, and remove it. */
export async function deleteMap(map, changed) {
  const frames = Object.entries(map.frames).reduce((n, [state, one]) => n + (state === "deleted" ? 0 : one), 0);
  const text = `This permanently deletes its ${things(frames, "frame")} with uploads, signatures and index. Only a snapshot can restore them.`;
  if (!(await confirm({ title: `Delete ${map.title ?? map.name}?`, text, word: map.name, action: "Delete map" }))) return;
  await send("DELETE", at("maps", map.name));
  toast(`${map.name} was deleted.`);
  await changed();
  if (document.activeElement === document.body) document.getElementById("title").focus({ preventScroll: true }); // its card is gone
}

/** A dialog that stays until what it asks for is saved; refusals are told at their fields. */
async function form({ title, action, children, save, place }) {
  const rest = h("p", { class: "field-error", role: "alert" });
  const dialog = sheet({ title, children: [children, rest], buttons: h("button", { class: "button primary" }, action) });
  saveFrom(dialog, () => save(dialog), async (error) => {
    const own = await place(error);
    const told = own ? [{ field: own, reason: error.detail ?? "" }] : error.errors ?? [];
    const left = told.filter((one) => !tell(dialog, one));
    if (left.length || !told.length) put(rest, coded(error.detail ?? error.message));
    /** @type {HTMLElement | null} */ (dialog.querySelector("[aria-invalid]"))?.focus();
  });
}

/** Say what is wrong with a field; false where the dialog has none of that name. */
function tell(dialog, { field: name, reason }) {
  const input = dialog.querySelector(`[name="${CSS.escape(name)}"]`);
  const place = dialog.querySelector(`#new-${CSS.escape(name)}-error`);
  if (!place) return false;
  put(place, coded(reason));
  if (input.type !== "radio") input.setAttribute("aria-invalid", "true");
  return true;
}

function field(text, input, hint) {
  const [why, note] = [`${input.id}-error`, `${input.id}-hint`];
  input.setAttribute("aria-describedby", `${why} ${note}`);
  return h("div", { class: "field" }, h("label", { for: input.id }, text), input,
    h("p", { class: "field-error", id: why, role: "alert" }), h("p", { class: "muted hint", id: note }, hint));
}

function choice(model, checked) {
  const [text, use] = FOR[model.name] ?? [model.name, ""];
  return h("label", { class: "model" },
    h("input", { type: "radio", name: "model", value: model.name, checked }),
    h("span", {}, h("strong", {}, text), " ", h("span", { class: "muted mono" }, model.name), h("br", {}),
      h("span", { class: "muted" }, `${use} ${bytes(model.signature_bytes)} a frame.`)));
}
