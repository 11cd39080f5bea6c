// Hands on a picture that is moved and zoomed: mouse, touch, wheel and keys.

/** How much nearer a press of a key or button brings it. */
export const NEARER = 1.25;
/** @type {Object<string, [number, number]>} */
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/**
 * @param {HTMLElement | SVGElement} element
 * @param {{drag: (right: number, down: number, event: PointerEvent) => void, move: (right: number, down: number) => void,
 *   zoom: (factor: number, at?: [number, number]) => void, arrow: (right: number, up: number, event: KeyboardEvent) => void,
 *   fit: () => void, click?: (at: [number, number]) => void, wheels?: (event: WheelEvent) => boolean}} acts pixels of the element;
 *   drag: with one pointer; move: with two; zoom: more than 1 is nearer; arrow: -1, 0 or 1 each; fit: show all; click: that did
 *   not drag; wheels: whether the wheel is meant for it
 * @param {{signal: AbortSignal, still?: number}} how still: pixels that a pointer may move before it drags
 */
export function hands(element, { drag, move, zoom, arrow, fit, click = () => {}, wheels = () => true }, { signal, still = 0 }) {
  const on = (type, act, options) => element.addEventListener(type, act, { signal, ...options });
  const held = new Map(); // pointers that are down, and where
  let moved = 0;
  const at = (event) => { const box = element.getBoundingClientRect(); return /** @type {[number, number]} */ ([event.clientX - box.left, event.clientY - box.top]); };
  on("pointerdown", (event) => {
    held.set(event.pointerId, at(event));
    if (held.size === 1) moved = 0;
    element.dataset.held = "";
  });
  for (const type of ["pointerup", "pointercancel"]) {
    on(type, (event) => {
      held.delete(event.pointerId);
      if (!held.size) delete element.dataset.held;
    });
  }
  on("pointermove", (event) => {
    const before = held.get(event.pointerId), now = at(event);
    if (!before) return;
    const [right, down] = [now[0] - before[0], now[1] - before[1]];
    moved += Math.hypot(right, down);
    if (moved > still && !element.hasPointerCapture(event.pointerId)) element.setPointerCapture(event.pointerId);
    if (held.size === 2) {
      const [other] = [...held].filter(([id]) => id !== event.pointerId).map(([, where]) => where);
      const apart = (p) => Math.max(Math.hypot(p[0] - other[0], p[1] - other[1]), 1);
      zoom(apart(now) / apart(before), [(now[0] + other[0]) / 2, (now[1] + other[1]) / 2]);
      move(right / 2, down / 2); // each finger its half
    } else if (moved > still) drag(right, down, event);
    held.set(event.pointerId, now);
  });
  on("click", (event) => { if (moved <= still) click(at(event)); });
  on("wheel", (event) => {
    if (!wheels(event)) return;
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 33 : event.deltaMode === 2 ? 400 : 1;
    zoom(Math.exp(-0.0015 * Math.min(Math.max(event.deltaY * lines, -300), 300)), at(event));
  }, { passive: false });
  on("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (ARROWS[event.key]) arrow(...ARROWS[event.key], event);
    else if (event.key === "+" || event.key === "=") zoom(NEARER);
    else if (event.key === "-" || event.key === "_") zoom(1 / NEARER);
    else if (event.key === "0") fit();
    else return;
    event.preventDefault();
  });
}
