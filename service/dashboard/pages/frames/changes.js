// Frames deleted and edited by one call each, repeated for what it had no time for, and undone.
import { at, get, send } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { things, time } from "../lib/format.js";
import { toast } from "../lib/states.js";

/** For how long a message offers to undo a change; the page of sessions lists deletions for longer. */
const UNDO_S = 60;
/** Of each deletion whose message is still shown, by its map and id, what takes the message away.
 * @type {Map<string, () => void>} */
const offered = new Map();

/**
 * @typedef {{frame_ids?: string[], filter?: Object<string, any>}} Selection one of the two
 * @typedef {(text: string) => void} Say of what is under way; "" when it is over
 */

/**
 * Delete frames, and offer to restore them.
 * @param {string} map @param {Selection} selection
 * @param {{say?: Say, changed?: () => any}} [how] changed: called when it is done, and when it is undone
 */
export async function deleteFrames(map, selection, { say = () => {}, changed = () => {} } = {}) {
  const deletions = [];
  let done = 0;
  try {
    for (let left = 1; left > 0;) {
      const { data } = await send("POST", at("maps", map, "frames", "delete"), { json: selection });
      if (data.deletion) deletions.push(data.deletion);
      [done, left] = [done + data.frames, data.remaining];
      say(left ? `Deleting: ${things(left, "frame")} left…` : "");
    }
  } finally {
    say("");
    await changed(); // of one that broke off a part is gone
  }
  if (done === 0) { toast("No frame was left to delete."); return; }
  offerRestore(map, `Deleted ${things(done, "frame")}.`, deletions, changed);
}

/**
 * Say that frames were deleted, with a button that restores them while that can be done.
 * @param {string} map @param {string} text @param {Object<string, any>[]} deletions as the API tells them
 * @param {() => any} changed
 */
function offerRestore(map, text, deletions, changed) {
  if (deletions.length === 0) { toast(`${text} This cannot be undone.`); return; }
  const until = Math.min(...deletions.map((one) => Date.parse(one.until)));
  const clock = new Date(until).toTimeString().slice(0, 5);
  const act = async () => { await restore(map, deletions); await changed(); };
  const close = toast(`${text} You can undo it until ${clock}.`, { action: { text: "Undo", act, seconds: UNDO_S } });
  for (const { deletion_id: id } of deletions) offered.set(`${map}/${id}`, close);
}

/** Restore the frames of deletions. @param {string} map */
async function restore(map, deletions) {
  const refused = new Map();
  let done = 0;
  for (const { deletion_id: id } of deletions) {
    offered.get(`${map}/${id}`)?.(); // undone from a list, nothing is left to offer
    offered.delete(`${map}/${id}`);
    for (let left = 1; left > 0;) {
      const { data } = await send("POST", at("maps", map, "deletions", id, "restore"));
      for (const one of data.refused) refused.set(one.frame_id, one.reason);
      [done, left] = [done + data.frames, data.frames ? data.remaining : 0];
    }
  }
  toast(`Restored ${things(done, "frame")}.`);
  if (refused.size) toast(`${things(refused.size, "frame")} could not be restored: ${[...refused.values()][0]}.`, { kind: "bad" });
}

/**
 * Edit frames, and offer to undo it.
 * @param {string} map @param {Selection & Object<string, any>} edit as the API takes it
 * @param {{say?: Say, changed?: () => any}} [how] see `deleteFrames`
 * @returns {Promise<number>} how many were changed
 */
export async function editFrames(map, edit, { say = () => {}, changed = () => {} } = {}) {
  const inverse = [];
  let done = 0;
  /** @type {string | undefined} */
  let after;
  try {
    do {
      const { data } = await send("POST", at("maps", map, "frames", "edit"), { json: { ...edit, after } });
      inverse.push(...data.inverse);
      [done, after] = [done + data.frames, data.remaining ? data.last_frame_id : undefined];
      say(after ? `Editing: ${things(data.remaining, "frame")} left…` : "");
    } while (after !== undefined);
  } finally {
    say("");
    await changed();
  }
  const act = async () => {
    for (const one of inverse) await send("POST", at("maps", map, "frames", "edit"), { json: one });
    toast(`${things(done, "frame")} ${done === 1 ? "is" : "are"} as before.`);
    await changed();
  };
  toast(done ? `Changed ${things(done, "frame")}.` : "Nothing had to be changed.", done ? { action: { text: "Undo", act, seconds: UNDO_S } } : {});
  return done;
}

/**
 * Deletions of a map that can still be undone; `look()` asks for them again.
 * @param {string} map @param {{signal: AbortSignal, changed: () => any}} how
 * @returns {HTMLElement & {look: () => Promise<void>}}
 */
export function recentDeletions(map, { signal, changed }) {
  const list = h("ul", { class: "deletions" });
  const card = h("section", { class: "card", hidden: true, "aria-labelledby": "deletions-title" },
    h("h2", { id: "deletions-title" }, "Recently deleted"), list);
  async function look() {
    const { items } = await get(at("maps", map, "deletions"), { params: { limit: 20 }, signal });
    const undo = async (one) => { await restore(map, [one]); await Promise.all([look(), changed()]); };
    put(list, items.map((one) => h("li", {}, h("span", {}, `${things(one.frames, "frame")}, deleted `, time(one.at), "; gone for good ", time(one.until), "."), " ",
      h("button", { class: "button", type: "button", "aria-label": `Undo the deletion of ${things(one.frames, "frame")}`, onClick: () => undo(one) }, "Undo"))));
    card.hidden = items.length === 0;
  }
  return Object.assign(card, { look });
}
