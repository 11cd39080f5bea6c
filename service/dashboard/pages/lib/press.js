// Clicks on what is drawn anew. A browser clicks an element that got both the press and the release:
// where an event replaces a link in between, nothing would happen, and the user would have to press again.

/** How far a pointer may move, in pixels, so that the release is one of the same spot. */
const SPOT = 12;

/** Let a press on a link or button count although it was replaced before the release. */
export function keepPresses() {
  /** @type {{on: HTMLElement, x: number, y: number} | null} */
  let press = null;
  const capture = { capture: true };
  window.addEventListener("pointerdown", ({ target, button, clientX: x, clientY: y }) => {
    const on = target instanceof Element && button === 0 ? /** @type {HTMLElement | null} */ (target.closest("a, button")) : null;
    press = on && { on, x, y };
  }, capture);
  window.addEventListener("pointercancel", () => { press = null; }, capture); // it scrolls
  window.addEventListener("pointerup", ({ clientX, clientY, ctrlKey, metaKey, shiftKey, altKey }) => {
    const began = press;
    press = null;
    if (began === null || began.on.isConnected || Math.hypot(clientX - began.x, clientY - began.y) > SPOT) return;
    began.on.dispatchEvent(new MouseEvent("click", { bubbles: true, cancelable: true, ctrlKey, metaKey, shiftKey, altKey }));
  }, capture);
}
