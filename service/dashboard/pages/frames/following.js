// What happens to frames while a page shows them: events say which, the API says what they are now.
import { at, get, watch } from "../lib/api.js";

const PAUSE_MS = 150;
const AGAIN_MS = 3000; // where nothing answers, or too much is asked
const AT_ONCE = 4;
const MOST_UNKNOWN = 2000;

/**
 * Keep what is shown of frames true until `signal` aborts.
 * @param {{map: string, signal: AbortSignal,
 *   shown: (id: string) => boolean,
 *   pending?: () => Iterable<string>,
 *   changed: (frame: Object<string, any>) => void, missed: () => void,
 *   arrived?: (id: string) => void, begins?: () => void}} what
 *   shown: a frame that is on the page; pending: those to which something may have happened before
 *   this could hear of it; changed: told of what is there no more as `deleted`, and nothing else of
 *   it; arrived: one came that is not shown; begins: from now on
 *   nothing is missed
 * @returns {{look: (id: string) => void}} look: whether something has happened already to a frame
 *   that the page shows from now on
 */
export function follow({ map, signal, shown, pending, changed, missed, arrived, begins }) {
  const waiting = new Set();
  const unknown = new Set(); // frames of which was heard before the page knew them
  /** @type {Timer} */
  let timer = null;
  let begun = false;

  // one look at a time: an older answer must not come after a newer one
  async function look() {
    const ids = [...waiting].slice(0, AT_ONCE);
    let rest = PAUSE_MS;
    for (const id of ids) waiting.delete(id);
    await Promise.all(ids.map(async (id) => {
      try {
        changed(await get(at("maps", map, "frames", id), { signal }));
      } catch (error) {
        if (error.name === "AbortError") return;
        if (error.status === 404 && shown(id)) changed({ frame_id: id, state: "deleted", reason: null });
        else if (error.status === 0 || error.status === 429 || error.status >= 500) { waiting.add(id); rest = AGAIN_MS; }
        else if (error.status === 401) throw error;
      }
    })).finally(() => { timer = waiting.size && !signal.aborted ? setTimeout(look, rest) : null; });
  }

  function soon() {
    timer ??= setTimeout(look, PAUSE_MS);
  }

  function doubt() {
    for (const id of pending?.() ?? []) waiting.add(id);
    if (waiting.size) soon();
  }

  function hear(event) {
    if (event.kind === "events.missed" || event.kind === "map.deleted") { doubt(); missed(); return; }
    if (!event.frame_id) return;
    if (shown(event.frame_id)) { waiting.add(event.frame_id); soon(); return; }
    unknown.add(event.frame_id);
    if (unknown.size > MOST_UNKNOWN) unknown.delete(unknown.values().next().value);
    if (event.kind === "frame.received") arrived?.(event.frame_id);
  }

  signal.addEventListener("abort", () => clearTimeout(timer), { once: true });
  watch({
    map, kinds: ["frame.", "map."], signal, onevent: hear,
    onstate: (state) => {
      // what happened between the list and the stream was told to nobody
      if (state !== "live") return;
      if (!begun) begins?.();
      begun = true;
      doubt();
    },
  });
  return { look: (id) => { if (unknown.delete(id)) { waiting.add(id); soon(); } } };
}
