// Edit who took a frame: sent with If-Match, so that nobody's edit is overwritten unseen.
import { at, get, send } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { reasonOf, saveFrom } from "../lib/form.js";
import { sheet, toast } from "../lib/states.js";

const NAMES = { robot: "Robot", session: "Session", name: "File name", tags: "Tags" };

/**
 * A dialog for robot, session, file name and tags.
 * @param {Object<string, any>} frame as it was read
 * @param {(frame: Object<string, any>) => void} edited
 */
export function editFrame(frame, edited) {
  const path = at("maps", frame.map, "frames", frame.frame_id);
  const inputs = {};
  const field = (name, hint) => {
    inputs[name] = h("input", { type: "text", name, autocomplete: "off", placeholder: hint, value: textOf(frame, name) });
    return h("label", { class: "field" }, h("span", {}, NAMES[name]), inputs[name]);
  };
  const said = h("div", { class: "edit-said", role: "alert" });
  const save = h("button", { class: "button primary", type: "submit" }, "Save");
  const dialog = sheet({
    title: "Edit the frame",
    children: [field("robot", "none"), field("session", "none"), field("name", "none"), field("tags", "comma-separated"), said],
    buttons: [save],
  });
  let base = frame;

  saveFrom(dialog, async () => {
    const patch = changes();
    if (!Object.keys(patch).length) return;
    const { data } = await send("PATCH", path, {
      json: patch, type: "application/merge-patch+json", headers: { "If-Match": `"${base.etag}"` },
    });
    dialog.close();
    toast("The frame was edited.");
    edited(data);
  }, (error) => (error.status === 412 ? meet() : put(said, h("p", { class: "field-error" }, reasonOf(error)))));

  /** What was typed and is other than what the dialog began with. */
  function changes() {
    const patch = {};
    for (const [name, input] of Object.entries(inputs)) {
      if ([input.value, input.value.trim()].includes(textOf(frame, name))) continue;
      patch[name] = name === "tags" ? tagsOf(input.value, frame.tags) : input.value.trim() || null;
    }
    return patch;
  }

  /** Somebody else was first: say what it is now, and let choose. */
  async function meet() {
    base = await get(path);
    const other = Object.keys(NAMES).filter((name) => textOf(base, name) !== textOf(frame, name));
    const theirs = () => {
      frame = base;
      for (const [name, input] of Object.entries(inputs)) input.value = textOf(base, name);
      put(said, h("p", { class: "muted" }, "These are the current values."));
      put(save, "Save");
    };
    put(said,
      h("p", { class: "field-error" }, "Somebody edited this frame after you opened it. Your changes were not saved."),
      h("ul", {}, other.map((name) => h("li", {}, `${NAMES[name]} is now `, h("strong", {}, textOf(base, name) || "none"))), !other.length && h("li", {}, "They changed none of these fields.")),
      h("button", { class: "button", type: "button", onClick: theirs }, "Use the current values"));
    put(save, "Overwrite with mine");
  }
}

/** Tags as they were typed; one that was there and has a comma of its own stays one. */
function tagsOf(text, there) {
  const flat = (one) => `,${one.split(",").map((part) => part.trim()).join(",")},`;
  let rest = flat(text);
  const kept = there.filter((one) => one.includes(",") && rest !== (rest = rest.replace(flat(one), ",")));
  return [...kept, ...rest.split(",").filter(Boolean)];
}

function textOf(frame, name) {
  return name === "tags" ? frame.tags.join(", ") : frame[name] ?? "";
}
