// The line that answers the first question: is it well.
import { get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";

/**
 * Whether the service works, its version, and whether this page is live.
 * @param {AbortSignal} signal
 * @returns {{element: HTMLElement, look: (signal: AbortSignal) => Promise<void>, live: (state: "live" | "waiting") => void}}
 */
export function health(signal) {
  const ready = h("span", { class: "badge" }, "asking");
  const version = h("span", { class: "muted" });
  const live = h("span", { class: "badge", dataset: { figure: "live" } }, "waiting");
  const said = h("span", { class: "visually-hidden", role: "status" });
  let before = null;

  function tell(kind, text) {
    if (text === before) return;
    before = text;
    ready.dataset.kind = kind;
    put(ready, text);
    put(said, `The service is ${text}`);
  }

  // a service that hangs leaves `look` waiting
  window.addEventListener("sceneprint:lost", () => { tell("bad", "not answering"); tellLive("waiting"); }, { signal });

  function tellLive(state) {
    live.dataset.kind = state === "live" ? "good" : "warn";
    live.title = state === "live" ? "Live events" : "The event stream was interrupted; reconnecting";
    put(live, state);
  }

  return {
    element: h("div", { class: "health" }, ready, live, version, said),
    async look(signal) {
      try {
        const told = await get("../readyz", { signal });
        tell(told.read_only ? "warn" : "good", told.read_only ? "read-only: it answers queries but accepts no uploads" : "ready");
        put(version, `version ${told.version}`);
      } catch (error) {
        if (error.name === "AbortError") throw error;
        tell("bad", error.status === 0 ? "not answering" : `not ready: ${error.detail ?? error.message}`);
      }
    },
    live: tellLive,
  };
}
