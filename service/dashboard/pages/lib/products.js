// Products of a map: each is computed by a long job, which a page follows until it is over.
import { get, send } from "./api.js";
import { saveFrom } from "./form.js";

const POLL_MS = 700;
const OVER = new Set(["succeeded", "failed", "dead", "cancelled"]);

/** Whether it goes on. @param {Object<string, any>} one a long job */
export const goesOn = (one) => !OVER.has(one.state);

/**
 * Follow a long job until it is over.
 * @param {string} path of its record
 * @param {(now: Object<string, any> | null) => void} onchange null: somebody deleted it
 * @param {AbortSignal} signal
 */
export function followJob(path, onchange, signal) {
  return repeat(async () => {
    if (document.hidden) return false;
    const now = await get(path, { signal }).catch((error) => { if (error.status === 404) return null; throw error; });
    onchange(now);
    return now === null || !goesOn(now);
  }, signal);
}

/**
 * Repeat requests until they return true, or `signal` aborts.
 * @param {() => Promise<boolean>} request @param {AbortSignal} signal
 */
export async function repeat(request, signal) {
  for (;;) {
    await new Promise((resolve) => { setTimeout(resolve, POLL_MS); });
    if (signal.aborted) return;
    try {
      if (await request()) return;
    } catch (error) {
      if (error.name === "AbortError") return;
      if (![0, 429, 503].includes(error.status)) throw error; // a service that restarts does not end it
    }
  }
}

/**
 * Begin a product when the form of a dialog is submitted; what is wrong is said in its `.field-error`.
 * @param {HTMLDialogElement} dialog @param {string} path of the list of such products
 * @param {() => Object<string, any>} request what the form asks for
 * @param {(begun: Object<string, any>) => void} onbegun
 */
export function beginFrom(dialog, path, request, onbegun) {
  saveFrom(dialog, async () => {
    const { data } = await send("POST", path, { json: request() });
    dialog.close();
    onbegun(data);
  });
}
