// The stream of events, by fetch: EventSource cannot show a key.
import { ask, whole } from "./http.js";

const FIRST_S = 1;
const LONGEST_S = 15;
const SILENT_S = 8; // a stream says every three seconds that it lives

/**
 * Hear what happens until `signal` aborts. Where the stream breaks off it goes on at the last
 * event; while the page is hidden it rests, since a browser has few connections for all its tabs.
 * It is "live" once the service has told its place: what comes from then on is heard, so a list that
 * is read then lacks nothing.
 * @param {{map?: string, kinds?: string[], onevent: (event: Object<string, any>) => void,
 *   onstate?: (state: "live" | "waiting") => void, signal: AbortSignal}} what kinds: their beginnings
 * @returns {Promise<void>} rejected with a Problem where the API refuses for good
 */
export async function watch({ map, kinds, onevent, onstate = () => {}, signal }) {
  /** @type {any} */
  const state = { last: null };
  let wait = FIRST_S;
  while (!signal.aborted) {
    await shown(signal);
    const turn = new AbortController();
    const stop = () => turn.abort();
    const rest = () => { if (document.hidden) turn.abort(); };
    signal.addEventListener("abort", stop);
    document.addEventListener("visibilitychange", rest);
    let silent = false;
    let lost = true;
    /** @type {Timer} */
    let timer = null;
    const heard = () => {
      clearTimeout(timer);
      timer = setTimeout(() => { silent = true; turn.abort(); }, 1000 * SILENT_S);
    };
    try {
      if (signal.aborted) return;
      heard();
      const headers = { Accept: "text/event-stream" };
      if (state.last !== null) headers["Last-Event-ID"] = state.last;
      const answer = await ask("events", { map, kind: kinds }, { headers, signal: turn.signal });
      wait = FIRST_S;
      let begun = false;
      await messages(answer.body, state, onevent, () => {
        heard();
        if (!begun && state.last !== null) { begun = true; tell("live", onstate); }
      });
    } catch (error) {
      lost = silent || !turn.signal.aborted; // else it rests
      if (error.name !== "AbortError" && !passes(error)) throw error;
    } finally {
      clearTimeout(timer);
      signal.removeEventListener("abort", stop);
      document.removeEventListener("visibilitychange", rest);
    }
    if (signal.aborted) return;
    if (lost) {
      tell("waiting", onstate);
      await pause(wait, signal);
      wait = Math.min(2 * wait, LONGEST_S);
    }
  }
}

// no answer, too much to do, broken down; all else would be refused again
function passes(error) {
  return error.status === 0 || error.status === 408 || error.status === 429 || error.status >= 500;
}

function tell(state, onstate) {
  onstate(state);
  window.dispatchEvent(new CustomEvent("sceneprint:live", { detail: state }));
}

async function messages(body, state, onevent, heard) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await whole(reader.read());
    if (done) return;
    const parts = (rest + value).split("\n\n");
    rest = parts.pop() ?? "";
    for (const part of parts) {
      let data = "";
      /** @type {any} */
      let id = null;
      for (const line of part.split("\n")) {
        if (line.startsWith("id: ")) id = line.slice(4);
        if (line.startsWith("data: ")) data += line.slice(6);
      }
      // told first: where telling fails the event is not taken as seen
      if (data) onevent(JSON.parse(data));
      if (id !== null) state.last = id;
    }
    heard();
  }
}

function shown(signal) {
  if (!document.hidden || signal.aborted) return Promise.resolve(null);
  return new Promise((resolve) => {
    const look = () => {
      if (document.hidden && !signal.aborted) return;
      document.removeEventListener("visibilitychange", look);
      resolve(null);
    };
    document.addEventListener("visibilitychange", look);
    signal.addEventListener("abort", look, { once: true });
  });
}

/** Wait, or until the page is left. @param {number} s @param {AbortSignal} signal */
export function pause(s, signal) {
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, 1000 * s);
    signal.addEventListener("abort", () => { clearTimeout(timer); resolve(null); }, { once: true });
  });
}
