// The shell: finds the page of an address, renders it, and shows what came of it.
import { at, get, lives, Problem } from "./lib/api.js";
import { h, put } from "./lib/dom.js";
import { ago } from "./lib/format.js";
import { keepPresses } from "./lib/press.js";
import { go, parse } from "./lib/router.js";
import { doubt, identify, may } from "./lib/session.js";
import { empty, failed, gone, soon, toast } from "./lib/states.js";
import { drawCrumbs, drawHead, drawRail, setTitle } from "./lib/shell.js";

const PAGES = new URL("./", import.meta.url);
const LATE_MS = 2500;
const AGES_MS = 20_000; // "just now" is not true for long
const PULSE_MS = 2500; // with what `lives` waits and LATE_MS, within ten seconds
const main = document.getElementById("main");
const sheets = new Map(); // address -> <link> of styles
const titles = new Map(); // of maps that were shown
let turn = new AbortController(); // aborts what the page that is shown began
/** @type {any} */
let shownPath = null;

/** Render the page of the address. */
async function show() {
  turn.abort();
  turn = new AbortController();
  const { signal } = turn;
  const { route, params, search, path } = parse(location.hash);
  const moved = shownPath !== null && shownPath !== path;
  for (const one of document.querySelectorAll("dialog")) one.close(); // it was of the page that is left
  const before = moved ? null : document.activeElement;
  const inside = main.contains(before);
  shownPath = path;
  main.setAttribute("aria-busy", "true");
  lost(false); // it was of the page that is left
  drawHead(route, params);
  drawRail(route, show);
  if (moved) { // as a page of its own would be: told to screen readers, and from the top
    window.scrollTo(0, 0);
    document.getElementById("title").focus({ preventScroll: true });
  }
  const root = h("div", { class: "page" });
  put(main, root);
  const came = soon(root);
  try {
    if (route === null) {
      const back = h("a", { class: "button", href: "#/" }, "To the maps");
      put(root, empty({ title: "Page not found", text: "There is no page at this address.", actions: back }));
      return;
    }
    const about = params.map ? called(route, params, signal) : null;
    const [page] = await Promise.all([import(new URL(route.page, PAGES).href).catch(unloaded), identify(get)]);
    drawRail(route, show);
    const styles = await Promise.all((page.styles ?? []).map(styled));
    if (signal.aborted) return;
    // only its own: pages give other meanings to the same class
    for (const link of sheets.values()) if (link.sheet) link.sheet.disabled = !styles.includes(link);
    const actions = (...nodes) => { if (!signal.aborted) put(document.getElementById("actions"), nodes); };
    const title = (text) => { if (!signal.aborted) setTitle(text); };
    const home = (map) => called(route, { ...params, map }, signal);
    await page.render(root, { params, search, signal, go, title, actions, home, about });
  } catch (error) {
    if (!signal.aborted && error.name !== "AbortError") await fault(root, error, signal);
  } finally {
    came();
    if (!signal.aborted) {
      main.setAttribute("aria-busy", "false");
      // where that was is drawn anew: the keyboard must not begin at the top again
      if (document.activeElement === document.body) (document.getElementById(before?.id) ?? (inside ? main : null))?.focus({ preventScroll: true });
    }
  }
}

/** Name the map of a page by its title as soon as that is known. @returns {Promise<any>} the map */
function called(route, params, signal) {
  const { map } = params, about = get(at("maps", map), { signal });
  const draw = () => { if (!signal.aborted) drawCrumbs(route, params, titles.get(map) ?? map); };
  draw();
  about.then(({ title }) => { titles.set(map, title); draw(); }, () => {}); // the page tells of faults
  return about;
}

/** Show in place of a page why it is not there. */
async function fault(root, error, signal) {
  put(document.getElementById("actions"));
  if (isUnfetched(error)) error = await unloaded(error).catch((told) => told); // by the page itself
  if (signal.aborted) return;
  if (error.status === 0) {
    // a module that could not be fetched is not asked for again before the page is loaded anew
    put(root, gone(error.reload ? () => location.reload() : show, signal));
  } else if (error.status === 401 || error.status === 403 || (error.status === 404 && !may("read"))) {
    doubt(); // what it may can have changed
    if (error.status !== 401) await identify(get).catch(() => {});
    const { keyPage } = await import("./lib/keys.js");
    if (!signal.aborted) put(root, keyPage(error, show));
  } else {
    if (error.status === undefined) console.error(error); // a fault of ours
    put(root, failed(error, error.reload ? () => location.reload() : show));
  }
}

/** What was thrown where nobody waited for it: a handler of a page. */
function uncaught(event) {
  const error = event.reason;
  if (error?.name === "AbortError") { event.preventDefault(); return; }
  if (error?.status === undefined && !isUnfetched(error)) return; // a fault of ours: the console has it
  event.preventDefault();
  if (error.status === 401) { doubt(); show(); } else toast(isUnfetched(error) ? "A part of this page could not be loaded. Reload the page." : error.message, { kind: "bad" });
}

async function styled(name) {
  const href = new URL(name, PAGES).href;
  let link = sheets.get(href);
  if (!link) {
    link = h("link", { rel: "stylesheet", href });
    link.came = new Promise((resolve) => {
      link.onload = () => { link.sheet.disabled = true; resolve(null); }; // until a page wears it
      link.onerror = () => { sheets.delete(href); resolve(null); };
    });
    sheets.set(href, link);
    document.head.append(link);
  }
  await link.came;
  return link;
}

function isUnfetched(error) {
  return /dynamically imported module/.test(error?.message);
}

async function unloaded(error) {
  const isUp = await lives();
  const document = { title: "This page cannot be loaded", detail: error.message };
  throw Object.assign(new Problem(isUp ? 404 : 0, document), { reload: true });
}

const banner = document.getElementById("banner");
/** @type {Timer} */
let late = null; // a stream that is back at once is not worth a word

function lost(isLost) {
  if (isLost) { late ??= setTimeout(tellLost, LATE_MS); return; }
  clearTimeout(late);
  late = null;
  banner.hidden = true;
  put(banner);
}

function tellLost() {
  banner.hidden = false;
  put(banner, "The service does not answer. The data shown may be out of date; retrying…");
  window.dispatchEvent(new CustomEvent("sceneprint:lost"));
}

// a service that hangs answers nothing and refuses nothing: no request of a page would ever tell
async function pulse() {
  const before = late !== null;
  const isUp = document.hidden || await lives();
  if (isUp === before) window.dispatchEvent(new CustomEvent("sceneprint:live", { detail: isUp ? "live" : "waiting" }));
  setTimeout(pulse, PULSE_MS);
}

window.addEventListener("sceneprint:live", (event) => lost(event.detail === "waiting"));
setTimeout(pulse, PULSE_MS);
window.addEventListener("unhandledrejection", uncaught);
setInterval(() => { for (const one of document.querySelectorAll("time")) put(one, ago(one.dateTime)); }, AGES_MS);
window.addEventListener("hashchange", show);
window.addEventListener("sceneprint:go", show);
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault(); // its `#main` would be taken for an address
  main.focus();
});
// files dropped on any page: a page that takes them has prevented it; else the browser would leave for the file
const isFiles = (event) => event.dataTransfer?.types.includes("Files");
document.addEventListener("dragover", (event) => { if (isFiles(event)) event.preventDefault(); });
window.addEventListener("drop", async (event) => {
  if (!isFiles(event) || event.defaultPrevented || event.dataTransfer === null) return;
  event.preventDefault();
  const { items, files: [...alone] } = event.dataTransfer; // gone after the event
  const entries = [...items].map((item) => item.webkitGetAsEntry()).filter(Boolean);
  const { handOver } = await import(new URL("frames/handover.js", PAGES).href);
  await handOver({ entries, files: alone }, parse(location.hash), go, turn.signal);
});
keepPresses();
show();
