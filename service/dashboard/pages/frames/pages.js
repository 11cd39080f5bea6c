// Which page came before which: the API's cursors lead forward only. Kept in this tab, so that
// Previous works after a reload too; who was sent a link to the middle begins at the first page.
import { FILTERS } from "./filters.js";

const KEPT_AS = "sceneprint.pages";
const MOST = 2000;
const known = new Map(load());

/** Note that `next` follows the page of an address. */
export function remember(map, search, next) {
  if (!next) return;
  known.set(nameOf(map, search, next), search.get("cursor"));
  for (const oldest of known.keys()) {
    if (known.size <= MOST) break;
    known.delete(oldest);
  }
  try { sessionStorage.setItem(KEPT_AS, JSON.stringify([...known])); } catch { /* until a reload */ }
}

/** Cursor of the page before that of an address: null is the first page, undefined not known. */
export function before(map, search) {
  return known.get(nameOf(map, search, search.get("cursor")));
}

function nameOf(map, search, cursor) {
  return JSON.stringify([map, search.get("order"), FILTERS.map((one) => search.getAll(one)), cursor]);
}

function load() {
  try { return JSON.parse(sessionStorage.getItem(KEPT_AS) ?? "[]"); } catch { return []; }
}
