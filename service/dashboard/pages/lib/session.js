// Who looks: the key of this tab, what it may, and the theme.

const KEY = "sceneprint.key";
const THEME = "sceneprint.theme";
const SCOPES = ["read", "write", "admin"];
/** @type {any} */
let kept = null; // where storage is forbidden the key lasts until the page is left
/** @type {any} */
let known = { key: undefined, me: null };

/** The key of this tab; null where none was given. */
export function key() {
  try { return sessionStorage.getItem(KEY) ?? kept; } catch { return kept; }
}

/** Keep a key until the tab is closed. @param {string} text */
export function setKey(text) {
  const given = kept = text.trim();
  try { sessionStorage.setItem(KEY, given); } catch { /* it is in `kept` */ }
}

/** Know no key any more. */
export function forgetKey() {
  kept = null;
  known = { key: undefined, me: null };
  try { sessionStorage.removeItem(KEY); } catch { /* nothing was stored */ }
}

/**
 * Ask once a key what it may do; main does so before any page is rendered.
 * @param {(path: string) => Promise<any>} get of api.js
 */
export async function identify(get) {
  if (known.key === key()) return;
  const asked = key();
  const found = await get("keys/me");
  // a name is what only a key has: without one whoever reaches the service may do all
  known = { key: asked, me: found.name === null ? null : found };
}

/** Ask again next time: what a key may can change. */
export function doubt() {
  known = { key: undefined, me: null };
}

/**
 * Name and grants of the key; null where none is asked for.
 * @returns {{name: string, grants: Object<string, string>, expires_at: string | null} | null}
 */
export function me() {
  return known.me;
}

/**
 * Whether the key may do that with a map; without one: with all maps.
 * @param {"read" | "write" | "admin"} scope @param {string} [map]
 */
export function may(scope, map) {
  if (known.me === null) return true;
  const held = [known.me.grants["*"], map === undefined ? null : known.me.grants[map]];
  return held.some((one) => SCOPES.indexOf(one) >= SCOPES.indexOf(scope));
}

/** The theme that was chosen. @returns {"auto" | "light" | "dark"} */
export function theme() {
  return /** @type {any} */ (document.documentElement.dataset.theme) ?? "auto";
}

/** Choose a theme; pages that draw hear of it by the event `sceneprint:theme` of window.
 * @param {"auto" | "light" | "dark"} name */
export function setTheme(name) {
  const root = document.documentElement;
  if (name === "auto") delete root.dataset.theme; else root.dataset.theme = name;
  try {
    if (name === "auto") localStorage.removeItem(THEME); else localStorage.setItem(THEME, name);
  } catch { /* it lasts until the page is left */ }
  window.dispatchEvent(new CustomEvent("sceneprint:theme"));
}

// the system's choice counts as long as none was made here
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  if (theme() === "auto") window.dispatchEvent(new CustomEvent("sceneprint:theme"));
});
