// Elements made by hand: text becomes text nodes, never HTML.

const SVG = "http://www.w3.org/2000/svg";
// what an element has as a property of its own, apart from the attribute of the same name
const LIVE = new Set(["value", "checked", "indeterminate", "selected"]);

/**
 * An element. `props`: class, dataset, style (an object, set through CSSOM: the policy forbids
 * style attributes), on<Event> handlers, attributes; null and false are left out.
 * @template {keyof HTMLElementTagNameMap} T
 * @param {T} tag
 * @param {?Object<string, any>} [props]
 * @param {...any} children nodes, strings, numbers, arrays of them; null and false are left out
 * @returns {HTMLElementTagNameMap[T]}
 */
export function h(tag, props, ...children) {
  return made(document.createElement(tag), props, children);
}

/** The same in the namespace of SVG. @param {string} tag @param {?Object<string, any>} [props] @param {...any} children @returns {SVGElement} */
export function svg(tag, props, ...children) {
  return made(document.createElementNS(SVG, tag), props, children);
}

/**
 * Replace what is in an element.
 * @param {Element} parent @param {...any} children as of `h`
 * @returns {any} the parent
 */
export function put(parent, ...children) {
  parent.replaceChildren(...nodes(children));
  return parent;
}

/**
 * What a button does, once at a time: a second click while it is under way does nothing.
 * @param {() => Promise<any>} act @returns {() => Promise<any>}
 */
export function once(act) {
  /** @type {Promise<any> | null} */
  let turn = null;
  return () => (turn ??= act().finally(() => { turn = null; }));
}

/**
 * Copy the text of a field; without the permission, or in a page that came without TLS, it is selected, to be copied by hand.
 * @param {HTMLInputElement} field @returns {Promise<boolean>} whether it was copied
 */
export async function copyFrom(field) {
  field.select();
  return navigator.clipboard ? navigator.clipboard.writeText(field.value).then(() => true, () => false) : false;
}

/**
 * Act once for calls that come in bursts.
 * @param {() => any} act @param {number} pause milliseconds from the first call of a burst until then
 * @param {AbortSignal} signal after which it acts no more
 * @returns {() => void}
 */
export function throttle(act, pause, signal) {
  /** @type {Timer} */
  let timer = null;
  signal.addEventListener("abort", () => clearTimeout(timer), { once: true });
  return () => { timer ??= setTimeout(() => { timer = null; act(); }, pause); };
}

/**
 * Act once for each of some elements when it comes into view, or nearly: what nobody looks at costs no request.
 * @param {AbortSignal} signal of the page @param {number} [most] acts that are under way at once
 * @returns {(element: Element, act: () => any) => void} to be called for each
 */
export function inView(signal, most = Infinity) {
  const acts = new WeakMap(), queue = new Set(); // those that came into view first are first
  let busy = 0;
  const watcher = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) if (isIntersecting) queue.add(target); else queue.delete(target);
    next();
  }, { rootMargin: "200px" });
  signal.addEventListener("abort", () => watcher.disconnect(), { once: true });
  function next() {
    for (const element of queue) {
      if (busy >= most || signal.aborted) return;
      queue.delete(element);
      watcher.unobserve(element);
      busy += 1;
      Promise.resolve(acts.get(element)?.()).finally(() => { busy -= 1; next(); });
    }
  }
  return (element, act) => { acts.set(element, act); watcher.observe(element); };
}

function made(element, props, children) {
  const isProps = props === null || props === undefined
    || (typeof props === "object" && !Array.isArray(props) && !(props instanceof Node));
  element.append(...nodes(isProps ? children : [props, ...children]));
  for (const [name, value] of Object.entries(isProps ? props ?? {} : {})) set(element, name, value);
  return element;
}

function set(element, name, value) {
  if (name.startsWith("on") && typeof value === "function") {
    element.addEventListener(name.slice(2).toLowerCase(), value);
  } else if (name === "dataset") {
    for (const [key, one] of Object.entries(value)) if (one != null) element.dataset[key] = one;
  } else if (name === "style") {
    for (const [key, one] of Object.entries(value)) {
      element.style.setProperty(key.replace(/[A-Z]/g, (c) => `-${c.toLowerCase()}`), String(one));
    }
  } else if (LIVE.has(name) && name in element) {
    if (value !== null && value !== undefined) element[name] = value;
  } else if (name.startsWith("aria-") && typeof value === "boolean" && name !== "aria-current") {
    element.setAttribute(name, String(value));
  } else if (value !== null && value !== undefined && value !== false) {
    element.setAttribute(name, value === true ? "" : String(value));
  }
}

function nodes(children) {
  const found = [];
  for (const child of children.flat(Infinity)) {
    if (child === null || child === undefined || child === false || child === true) continue;
    found.push(child instanceof Node ? child : document.createTextNode(String(child)));
  }
  return found;
}
