// Hands on the view: mouse, touch, wheel and keys, all of them to one orbit.

const TURN = 0.1, STEP = 0.05, NEARER = 0.87;
/** Radians for a drag across the height of the canvas. */
const ACROSS = Math.PI;

/**
 * @param {HTMLCanvasElement} canvas
 * @param {import("./camera.js").Orbit} orbit
 * @param {{changed: () => void, fit: () => void}} then
 * @returns {() => void} takes the hands off
 */
export function hands(canvas, orbit, { changed, fit }) {
  const stop = new AbortController();
  const on = (type, handler, options) =>
    canvas.addEventListener(type, handler, { signal: stop.signal, ...options });
  const held = new Map(); // pointers that are down, and where

  on("contextmenu", (event) => event.preventDefault()); // the right button moves
  on("pointerdown", (event) => {
    held.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.setPointerCapture(event.pointerId);
    canvas.dataset.held = "";
  });
  for (const type of ["pointerup", "pointercancel"]) {
    on(type, (event) => {
      held.delete(event.pointerId);
      if (!held.size) delete canvas.dataset.held;
    });
  }
  on("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const size = canvas.clientHeight || 1, now = [event.clientX, event.clientY];
    const [right, down] = [(now[0] - before[0]) / size, (now[1] - before[1]) / size];
    if (held.size === 2) {
      const [other] = [...held].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const apart = (at) => Math.max(Math.hypot(at[0] - other[0], at[1] - other[1]), 1);
      orbit.zoom(apart(before) / apart(now));
      orbit.pan(right / 2, -down / 2); // each finger its half
    } else if ((event.shiftKey || (event.buttons & 6) !== 0) !== orbit.flat) { // a plan is rather moved than turned
      orbit.pan(right, -down);
    } else if (orbit.flat) {
      orbit.orbit(right * ACROSS, 0);
    } else {
      orbit.orbit(right * ACROSS, down * ACROSS);
    }
    held.set(event.pointerId, now);
    changed();
  });
  on("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 33 : event.deltaMode === 2 ? 400 : 1;
    const turned = Math.min(Math.max(event.deltaY * lines, -300), 300);
    orbit.zoom(Math.exp(turned * 0.0015));
    changed();
  }, { passive: false });
  on("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const arrow = arrows[event.key];
    if (arrow && event.shiftKey !== orbit.flat) orbit.pan(-arrow[0] * STEP, -arrow[1] * STEP);
    else if (arrow) orbit.orbit(arrow[0] * TURN, orbit.flat ? 0 : arrow[1] * TURN);
    else if (event.key === "+" || event.key === "=") orbit.zoom(NEARER);
    else if (event.key === "-" || event.key === "_") orbit.zoom(1 / NEARER);
    else if (event.key !== "0") return;
    event.preventDefault();
    if (event.key === "0") fit();
    else changed();
  });
  return () => stop.abort();
}
