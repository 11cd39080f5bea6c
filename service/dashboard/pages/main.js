// The shell: finds the page of an address, renders it, and shows what came of it.
import { get, lives, Problem } from "./lib/api.js";
import { h, put } from "./lib/dom.js";
import { go, parse } from "./lib/router.js";
import { doubt, identify, may } from "./lib/session.js";
import { empty, failed, gone, soon, toast } from "./lib/states.js";
import { drawHead, drawRail, setTitle } from "./lib/shell.js";

const PAGES = new URL("./", import.meta.url);
const LATE_MS = 2500;
const main = document.getElementById("main");
const sheets = new Map(); // address -> <link> of styles
let turn = null; // aborts what the page that is shown began
let shownPath = null;

/** Render the page of the address. */
async function show() {
  turn?.abort();
  turn = new AbortController();
  const { signal } = turn;
  const { route, params, search, path } = parse(location.hash);
  const moved = shownPath !== null && shownPath !== path;
  const focused = moved ? null : document.activeElement?.id;
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
      const home = h("a", { class: "button", href: "#/" }, "To the maps");
      put(root, empty({ title: "There is no such page", text: "The address leads nowhere.", actions: home }));
      return;
    }
    const [page] = await Promise.all([import(new URL(route.page, PAGES).href).catch(unloaded), identify(get)]);
    drawRail(route, show);
    const styles = await Promise.all((page.styles ?? []).map(styled));
    if (signal.aborted) return;
    // only its own: pages give other meanings to the same class
    for (const link of sheets.values()) if (link.sheet) link.sheet.disabled = !styles.includes(link);
    const actions = (...nodes) => { if (!signal.aborted) put(document.getElementById("actions"), nodes); };
    const title = (text) => { if (!signal.aborted) setTitle(text); };
    await page.render(root, { params, search, signal, go, title, actions });
    if (focused && !signal.aborted) document.getElementById(focused)?.focus();
  } catch (error) {
    if (!signal.aborted && error.name !== "AbortError") await fault(root, error, signal);
  } finally {
    came();
    if (!signal.aborted) main.setAttribute("aria-busy", "false");
  }
}

/** Show in place of a page why it is not there. */
async function fault(root, error, signal) {
  put(document.getElementById("actions"));
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
    put(root, failed(error, show));
  }
}

/** What was thrown where nobody waited for it: a handler of a page. */
function uncaught(event) {
  const error = event.reason;
  if (error?.name === "AbortError") { event.preventDefault(); return; }
  const unfetched = /dynamically imported module/.test(error?.message);
  if (error?.status === undefined && !unfetched) return; // a fault of ours: the console has it
  event.preventDefault();
  if (error.status === 401) { doubt(); show(); } else toast(error.message, { kind: "bad" });
}

async function styled(name) {
  const href = new URL(name, PAGES).href;
  let link = sheets.get(href);
  if (!link) {
    link = h("link", { rel: "stylesheet", href });
    link.came = new Promise((resolve) => {
      link.onload = () => { link.sheet.disabled = true; resolve(); }; // until a page wears it
      link.onerror = () => { sheets.delete(href); resolve(); };
    });
    sheets.set(href, link);
    document.head.append(link);
  }
  await link.came;
  return link;
}

async function unloaded(error) {
  const isUp = await lives();
  const document = { title: "This page cannot be loaded", detail: error.message };
  throw Object.assign(new Problem(isUp ? 404 : 0, document), { reload: true });
}

const banner = document.getElementById("banner");
let late = null; // a stream that is back at once is not worth a word

function lost(isLost) {
  clearTimeout(late);
  if (!isLost) { banner.hidden = true; put(banner); return; }
  late = setTimeout(() => {
    banner.hidden = false;
    put(banner, "The service does not answer. What is shown may be old; trying again…");
  }, LATE_MS);
}

window.addEventListener("sceneprint:live", (event) => lost(event.detail === "waiting"));
window.addEventListener("unhandledrejection", uncaught);
window.addEventListener("hashchange", show);
window.addEventListener("sceneprint:go", show);
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault(); // its `#main` would be taken for an address
  main.focus();
});
show();
