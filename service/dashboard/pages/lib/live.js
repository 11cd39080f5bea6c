// The stream of events, by fetch: EventSource cannot show a key.
import { ask, whole } from "./http.js";

const FIRST_S = 1;
const LONGEST_S = 15;
const SILENT_S = 8; // a stream says every three seconds that it lives
const HIDDEN = "hidden"; // why a stream was ended

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
  const tell = (now) => { onstate(now); window.dispatchEvent(new CustomEvent("sceneprint:live", { detail: now })); };
  for (;;) {
    while (document.hidden && !signal.aborted) await either([document, "visibilitychange"], [signal, "abort"]);
    if (signal.aborted) return;
    const turn = new AbortController(), ends = AbortSignal.any([signal, turn.signal]);
    document.addEventListener("visibilitychange", () => { if (document.hidden) turn.abort(HIDDEN); }, { signal: ends });
    let isLive = false;
    /** @type {Timer} */
    let timer = null;
    const heard = () => {
      clearTimeout(timer);
      timer = setTimeout(() => turn.abort(), 1000 * SILENT_S);
      if (isLive || state.last === null) return;
      isLive = true;
      tell("live");
    };
    try {
      timer = setTimeout(() => turn.abort(), 1000 * SILENT_S);
      const headers = { Accept: "text/event-stream", ...(state.last !== null && { "Last-Event-ID": state.last }) };
      const answer = await ask("events", { map, kind: kinds }, { headers, signal: ends });
      wait = FIRST_S;
      await messages(answer.body, state, onevent, heard);
    } catch (error) {
      if (!ends.aborted && !passes(error)) throw error;
    } finally {
      clearTimeout(timer);
    }
    if (signal.aborted) return;
    if (turn.signal.reason === HIDDEN) continue;
    turn.abort(); // the page may be hidden now
    tell("waiting");
    await pause(wait, signal);
    wait = Math.min(2 * wait, LONGEST_S);
  }
}

/** Wait for the first of some events. @param {...[EventTarget, string]} events */
const either = (...events) => new Promise((resolve) => {
  for (const [target, type] of events) target.addEventListener(type, resolve, { once: true });
});

// no answer, too much to do, broken down; all else would be refused again
function passes(error) {
  return error.status === 0 || error.status === 408 || error.status === 429 || error.status >= 500;
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

/** Wait, or until the page is left. @param {number} s @param {AbortSignal} signal */
function pause(s, signal) {
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, 1000 * s);
    signal.addEventListener("abort", () => { clearTimeout(timer); resolve(null); }, { once: true });
  });
}
