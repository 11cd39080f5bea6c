// What a page shows in place of what was asked for, and what asks or tells across pages.
import { lives } from "./api.js";
import { h, put, svg } from "./dom.js";
import { coded } from "./prose.js";

const SHAPES = {
  good: "M5 12.500l4.500 4.500L19 7.500",
  bad: "M12 7v6.500M12 17v.1",
  none: "M4 8l8-4 8 4v8l-8 4-8-4zM4 8l8 4 8-4M12 12v8",
  wait: "M12 7v5l3 2",
};
const AGAIN_S = 2;
const TOAST_S = 6;

/** A skeleton, told to screen readers. @param {string} [text] */
export function loading(text = "Loading") {
  const lines = [1, 2, 3].map(() => h("span", { class: "skeleton-line" }));
  return h("div", { class: "skeleton", role: "status" }, h("span", { class: "visually-hidden" }, `${text}…`), lines);
}

/**
 * There is nothing yet, and how to begin.
 * @param {{title: string, text?: any, actions?: any}} what text, actions: as children of `h`
 */
export function empty({ title, text, actions }) {
  return state("none", title, text, actions);
}

/**
 * What the API refused, in its own words.
 * @param {Fault} problem a Problem, or a fault of ours
 * @param {() => void} [retry]
 */
export function failed(problem, retry) {
  const known = problem.status !== undefined;
  const fields = (problem.errors ?? []).map((one) => h("li", {}, coded(one.field ? `${one.field}: ${one.reason}` : one.reason)));
  const text = [
    h("p", {}, known ? coded(problem.detail ?? problem.message) : `The page failed: ${problem.message}`),
    fields.length > 0 && h("ul", {}, fields),
    problem.instance && h("p", { class: "muted" }, "Request id in the log: ", h("span", { class: "mono" }, problem.instance.split("/").pop())),
  ];
  const title = known ? problem.title : "This page cannot be shown";
  return state("bad", title, text, retry && h("button", { class: "button", type: "button", onClick: retry }, "Try again"));
}

/**
 * The service is gone; asks until it is back.
 * @param {() => void} back what to do then
 * @param {AbortSignal} signal
 */
export function gone(back, signal) {
  const timer = setInterval(async () => {
    if (signal.aborted || !(await lives(signal)) || signal.aborted) return;
    clearInterval(timer);
    back();
  }, 1000 * AGAIN_S);
  signal.addEventListener("abort", () => clearInterval(timer), { once: true });
  const text = "It may be restarting. This page reloads as soon as the service answers.";
  return state("wait", "The service does not answer", text, h("span", { class: "muted" }, `Trying every ${AGAIN_S} seconds…`));
}

/**
 * Say what has happened, at the edge of the page.
 * @param {string} text
 * @param {{kind?: "good" | "bad", action?: {text: string, act: () => void, seconds: number}}} [how]
 *   action: a button, and for how long it is there
 * @returns {() => void} take it away
 */
export function toast(text, { kind = "good", action } = {}) {
  const region = document.getElementById("toasts");
  const close = h("button", { class: "button quiet", type: "button", "aria-label": "Dismiss", onClick: () => one.remove() }, "×");
  const button = action && h("button", { class: "button", type: "button", onClick: () => { one.remove(); action.act(); } }, action.text);
  const one = h("div", { class: "toast", dataset: { kind } }, shape(kind), h("span", {}, coded(text)), button, close);
  region.append(one);
  while (region.children.length > 4) region.firstChild?.remove();
  // what went wrong stays until it was seen
  if (kind === "good") setTimeout(() => one.remove(), 1000 * (action?.seconds ?? TOAST_S));
  return () => one.remove();
}

/**
 * Fill a place with what is asked for; meanwhile there is a skeleton, and if it is refused the reason, with a button to try again.
 * @param {Element} place @param {() => Promise<any>} ask children of `put`; undefined: nothing is to be put @param {string} text what is loaded
 */
export async function fill(place, ask, text) {
  put(place, loading(text));
  try {
    const shown = await ask();
    if (shown !== undefined) put(place, shown);
  } catch (error) {
    if (error.name === "AbortError") return;
    if (error.status === 401) throw error;
    put(place, failed(error, () => fill(place, ask, text)));
  }
}

/**
 * Ask before something is done.
 * @param {{title: string, text: any, word?: string, action?: string}} what word: to be typed
 *   first, for what cannot be undone; action: what the button says
 */
export function confirm({ title, text, word, action = "Continue" }) {
  return new Promise((resolve) => {
    const button = h("button", { class: word ? "button danger" : "button primary", value: "yes", disabled: Boolean(word) }, action);
    const look = (event) => { button.disabled = event.target.value !== word; };
    const field = word && h("label", { class: "field" }, h("span", {}, "Type ", h("strong", { class: "mono" }, word), " to confirm"),
      h("input", { class: "mono", autocomplete: "off", spellcheck: "false", onInput: look }));
    const dialog = sheet({ title, children: [h("div", { class: "dialog-text" }, text), field], buttons: [button] });
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"));
    dialog.querySelector("form").addEventListener("submit", (event) => {
      event.preventDefault();
      if (!button.disabled) dialog.close("yes");
    });
  });
}

/**
 * A dialog with a form, shown at once and removed when it closes; what its form does is the
 * caller's. Escape and Cancel close it.
 * @param {{title: string, children: any, buttons: any, cancel?: string}} what cancel: words of the button that closes it
 */
export function sheet({ title, children, buttons, cancel = buttons ? "Cancel" : "Close" }) {
  const close = h("button", { class: "button", type: "button", onClick: () => dialog.close() }, cancel);
  const dialog = h("dialog", { class: "dialog", "aria-label": title },
    h("form", { novalidate: true }, h("h2", {}, title), children, h("div", { class: "dialog-foot" }, close, buttons)));
  const before = /** @type {HTMLElement | null} */ (document.activeElement);
  dialog.addEventListener("close", () => {
    dialog.remove();
    // what was pressed may have been drawn anew
    (before?.isConnected ? before : document.getElementById(before?.id))?.focus();
  });
  document.body.append(dialog);
  dialog.showModal();
  dialog.querySelector("input, select, textarea")?.focus();
  return dialog;
}

/** Words of a state with a shape of their own, in place of a page or a part of it. */
function state(kind, title, text, actions) {
  return h("section", { class: "state", dataset: { kind } }, shape(kind),
    h("h2", { tabindex: "-1" }, title), h("div", { class: "state-text" }, text),
    actions && h("div", { class: "toolbar" }, actions));
}

function shape(kind) {
  const round = kind === "none" ? null : svg("circle", { cx: 12, cy: 12, r: 10 });
  return svg("svg", { class: "shape", viewBox: "0 0 24 24", "aria-hidden": "true" }, round, svg("path", { d: SHAPES[kind] }));
}

/** Show a skeleton in an element if what comes takes longer than a blink. @param {Element} root
 * @param {string} [text] @returns {() => void} to be called when it has come */
export function soon(root, text) {
  const timer = setTimeout(() => { if (!root.hasChildNodes()) put(root, loading(text)); }, 150);
  return () => {
    clearTimeout(timer);
    if (root.firstElementChild?.classList.contains("skeleton")) root.firstElementChild.remove();
  };
}
