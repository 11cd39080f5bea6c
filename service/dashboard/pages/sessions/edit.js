// A session renamed, tagged or deleted, each of which can be undone.
import { deleteFrames, editFrames } from "../frames/changes.js";
import { h, put } from "../lib/dom.js";
import { reasonOf, saveFrom } from "../lib/form.js";
import { things } from "../lib/format.js";
import { confirm, sheet } from "../lib/states.js";

/**
 * @typedef {{say: (text: string) => void, changed: () => Promise<void>}} How say: of what is under
 *   way; changed: called when it is over
 * @typedef {Object<string, any>} Session as the API lists it
 */

/** Ask for a name, and give it to all frames of a session. @param {string} map @param {Session} one
 * @param {Session[]} all that are listed @param {How} how */
export function renameSession(map, one, all, how) {
  const known = new Set(all.map((other) => other.session));
  let joins = ""; // the name that was said to join two sessions
  form(one, all, {
    title: "Rename the session", label: "Name", value: one.session, action: "Rename",
    async save(name, dialog) {
      if (name === one.session) return;
      if (known.has(name) && joins !== name) {
        joins = name;
        throw Object.assign(new Error(`There is a session ${name}. Rename again to join the two.`), { status: 409 });
      }
      await edit(map, one, { session: name }, how, dialog);
    },
  });
}

/** Ask for tags, and add and remove what was changed on all frames. @param {string} map
 * @param {Session} one @param {Session[]} all @param {How} how */
export function tagSession(map, one, all, how) {
  form(one, all, {
    title: "Tags of the session", label: "Tags", value: one.tags.join(", "), action: "Save tags",
    hint: "Comma-separated. A tag that you add goes on every frame; one that you remove is removed from every frame.",
    async save(text, dialog) {
      const tags = text.split(",").map((tag) => tag.trim()).filter(Boolean);
      const known = one.tags.join(",").split(",").map((tag) => tag.trim());
      const added = tags.filter((tag) => !known.includes(tag));
      const removed = one.tags.filter((tag) => !tag.split(",").every((part) => tags.includes(part.trim())));
      if (!added.length && !removed.length) return;
      await edit(map, one, { add_tags: added, remove_tags: removed }, how, dialog);
    },
  });
}

/** Ask for the name of a session to be typed, and delete all its frames. @param {string} map
 * @param {Session} one @param {Session[]} all @param {How} how */
export async function deleteSession(map, one, all, how) {
  const text = [h("p", {}, `Queries no longer find its ${things(framesOf(one, all), "frame")}. You can undo this for a while: the message that follows says until when.`), others(one, all)];
  if (!(await confirm({ title: `Delete ${one.session}?`, text, word: one.session, action: "Delete session" }))) return;
  await deleteFrames(map, { filter: chosen(one) }, how);
  if (document.activeElement === document.body) document.getElementById("title").focus({ preventScroll: true }); // its row is gone
}

/** Edit all frames of a session, and say in the dialog how far that is. */
function edit(map, one, changes, how, dialog) {
  const say = (text) => put(dialog.querySelector(".sessions-left"), text);
  return editFrames(map, { filter: chosen(one), ...changes }, { say, changed: how.changed });
}

/** A dialog with one field that stays until it is saved; what is refused is told at the field. */
function form(one, all, { title, label, value, action, hint = "", save }) {
  const input = h("input", { id: "session-field", autocomplete: "off", spellcheck: "false", value, "aria-describedby": "session-why session-hint" });
  const why = h("p", { class: "field-error", id: "session-why", role: "alert" });
  const dialog = sheet({ title, buttons: h("button", { class: "button primary" }, action), children: [
    h("p", { class: "dialog-text muted" }, `${one.session}: ${things(framesOf(one, all), "frame")}`), others(one, all),
    h("div", { class: "field" }, h("label", { for: input.id }, label), input, why, h("p", { class: "muted", id: "session-hint" }, hint)),
    h("p", { class: "muted sessions-left", role: "status" }),
  ] });
  saveFrom(dialog, () => save(input.value.trim(), dialog), (error) => {
    put(why, reasonOf(error));
    input.setAttribute("aria-invalid", "true");
    input.focus();
  });
}

/** The filter that its frames pass. @param {Session} one */
function chosen(one) {
  return { session: [one.session], robot: one.robot === null ? [] : [one.robot] };
}

/** Rows that a call for one changes: where it names no robot, those of all robots. */
function reached(one, all) {
  return one.robot === null ? all.filter((other) => other.session === one.session) : [one];
}

function framesOf(one, all) {
  return reached(one, all).flatMap((row) => Object.values(row.frames)).reduce((a, b) => a + b, 0);
}

function others(one, all) {
  const robots = reached(one, all).map((row) => row.robot).filter((robot) => robot !== one.robot);
  return robots.length > 0 && h("p", {}, h("strong", {}, "Frames that name no robot cannot be chosen alone"), `: those of ${robots.join(", ")} in this session are meant as well.`);
}
