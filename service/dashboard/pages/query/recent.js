// Where the answers of this tab were asked, so that one that is no longer kept can be asked again.

const KEPT_AS = "sceneprint.asked";
const MOST = 50;

/** @param {string} id of an answer @param {string} address of the page that asks it */
export function remember(id, address) {
  try {
    const known = read().filter(([one]) => one !== id);
    sessionStorage.setItem(KEPT_AS, JSON.stringify([[id, address], ...known].slice(0, MOST)));
  } catch { /* a convenience */ }
}

/** @param {string} id @returns {string | null} */
export function recall(id) {
  return read().find(([one]) => one === id)?.[1] ?? null;
}

function read() {
  try { return JSON.parse(sessionStorage.getItem(KEPT_AS) ?? "[]") ?? []; } catch { return []; }
}
