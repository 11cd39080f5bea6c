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

/**
 * The same in the namespace of SVG.
 * @param {string} tag
 * @param {?Object<string, any>} [props]
 * @param {...any} children
 * @returns {SVGElement}
 */
export function svg(tag, props, ...children) {
  return made(document.createElementNS(SVG, tag), props, children);
}

/**
 * Replace what is in an element.
 * @param {Element} parent
 * @param {...any} children as of `h`
 * @returns {any} the parent
 */
export function put(parent, ...children) {
  parent.replaceChildren(...nodes(children));
  return parent;
}

/**
 * What a button does, once at a time: a second click while it is under way does nothing.
 * @param {() => Promise<any>} act
 * @returns {() => Promise<any>}
 */
export function once(act) {
  /** @type {Promise<any> | null} */
  let turn = null;
  return () => (turn ??= act().finally(() => { turn = null; }));
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
