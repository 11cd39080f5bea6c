// Products of a map: each is computed by a long job, which a page follows until it is over.
import { get } from "./api.js";

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
export async function followJob(path, onchange, signal) {
  for (;;) {
    await new Promise((resolve) => { setTimeout(resolve, POLL_MS); });
    if (signal.aborted) return;
    if (document.hidden) continue;
    try {
      const now = await get(path, { signal });
      onchange(now);
      if (!goesOn(now)) return;
    } catch (error) {
      if (error.name === "AbortError") return;
      if (error.status === 404) { onchange(null); return; }
      if (error.status !== 0 && error.status !== 503) throw error; // a service that restarts does not end it
    }
  }
}
