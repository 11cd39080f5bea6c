// Lists and figures that follow what happens, without flicker and without taking the focus away.

/**
 * Ask at once and then every few seconds, as long as the page is seen: a hidden tab asks nothing,
 * and asks at once when it is seen again. Rejected if the first time is; later faults go to
 * `onfault`, and it is tried again. A key that is taken no more leads to the field for another.
 * @param {() => Promise<void>} ask @param {number} s @param {AbortSignal} signal
 * @param {(error: Error) => void} [onfault]
 * @returns {Promise<() => void>} to be called where there is reason to ask now
 */
export async function poll(ask, s, signal, onfault = () => {}) {
  /** @type {Timer} */
  let timer = null;
  let asking = false;
  let again = false;
  await ask();

  async function turn() {
    clearTimeout(timer);
    if (signal.aborted || document.hidden) return;
    if (asking) { again = true; return; }
    asking = true;
    try {
      await ask();
    } catch (error) {
      if (signal.aborted) return;
      if (error.status === 401) { Promise.reject(error); return; } // main's, as of any handler
      if (error.name !== "AbortError") onfault(error);
    }
    asking = false;
    if (again) { again = false; turn(); return; }
    timer = setTimeout(turn, 1000 * s);
  }

  const seen = () => { if (!document.hidden) turn(); };
  document.addEventListener("visibilitychange", seen);
  signal.addEventListener("abort", () => {
    clearTimeout(timer);
    document.removeEventListener("visibilitychange", seen);
  }, { once: true });
  if (!signal.aborted) timer = setTimeout(turn, 1000 * s);
  return () => { turn(); };
}

/**
 * Rows of a list by their keys: what has not changed is left alone, what has is made anew with
 * its folds as they were, and the focus goes to the same part of the new one.
 * @template T
 * @param {Element} parent
 * @param {(item: T) => string} key
 * @param {(item: T) => Element} make parts that take focus have a `data-part`
 * @returns {(items: T[]) => void}
 */
export function rows(parent, key, make) {
  let known = new Map(); // key -> {element, text}
  /** @type {[Element, string | undefined] | null} */
  let wanted = null; // the new element and part that the focus goes to, once it is in place
  return (items) => {
    const next = new Map();
    for (const item of items) {
      const text = JSON.stringify(item);
      const before = known.get(key(item));
      next.set(key(item), before?.text === text ? before : { element: remade(before?.element, make(item)), text });
    }
    for (const [name, { element }] of known) if (next.get(name)?.element !== element) element.remove();
    let place = 0;
    for (const { element } of next.values()) {
      // one that stands where it should is not touched: moving it would take its focus
      if (parent.children[place] !== element) parent.insertBefore(element, parent.children[place] ?? null);
      place += 1;
    }
    known = next;
    restore();
  };

  function remade(before, after) {
    if (before === undefined) return after;
    const open = before.querySelector("details")?.open;
    if (open) after.querySelector("details")?.setAttribute("open", "");
    const focused = /** @type {HTMLElement | null} */ (document.activeElement);
    if (focused !== null && before.contains(focused)) wanted = [after, focused.dataset.part];
    return after;
  }

  function restore() {
    if (wanted === null) return;
    const [element, part] = wanted;
    wanted = null;
    /** @type {HTMLElement | null} */ (element.querySelector(`[data-part="${part}"]`) ?? element.querySelector("a, button, summary"))?.focus();
  }
}
