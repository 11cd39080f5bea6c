// What frames every page: the rail, where one is, and the tabs of a map.
import { h, put, svg } from "./dom.js";
import { link } from "./router.js";
import { forgetKey, key, me, setTheme, theme } from "./session.js";

const AREAS = [
  ["maps", "Maps", "#/", "M4 5.500l5-2 6 2 5-2v15l-5 2-6-2-5 2zM9 3.500v15M15 5.500v15"],
  ["operations", "Operations", "#/operations", "M3 12h4l3-8 4 16 3-8h4"],
];
const THEMES = [
  ["auto", "System", "M12 3a9 9 0 100 18zM12 3a9 9 0 010 18"],
  ["light", "Light", "M12 8a4 4 0 100 8 4 4 0 000-8zM12 2v2M12 20v2M2 12h2M20 12h2M5 5l1.400 1.400M17.600 17.600L19 19M5 19l1.400-1.400M17.600 6.400L19 5"],
  ["dark", "Dark", "M20 14.500A8.500 8.500 0 019.500 4a8.500 8.500 0 1010.500 10.500z"],
];
const TABS = [["place", "Place"], ["frames", "Frames"], ["sessions", "Sessions"], ["query", "Query"], ["queries", "Queries"], ["coverage", "Coverage"], ["upload", "Upload"]];

/** Say what page this is. @param {string} text */
export function setTitle(text) {
  document.title = `${text} · sceneprint`;
  put(document.getElementById("title"), text);
}

/**
 * What leads to a page, and its heading if that names the map.
 * @param {any} route @param {Object<string, string>} params `map` of an answer is known once that has come
 * @param {string} [name] what the map is called: its title
 */
export function drawCrumbs(route, { map, query, frame }, name = map) {
  if (route?.heading !== undefined) setTitle(`${route.heading}${name}`);
  const crumbs = [];
  if (route?.area === "maps" && route.path !== "") crumbs.push(["Maps", "#/"]);
  if (map && route.section !== "place") crumbs.push([name, link("maps", map, "place")]);
  if (query && map) crumbs.push(["Queries", link("maps", map, "queries")]);
  if (query && frame) crumbs.push(["Answer", link("queries", query)]);
  if (route?.path === "operations/jobs/:job") crumbs.push(["Operations", "#/operations"]);
  const items = crumbs.map(([text, href]) => h("li", {}, h("a", { href }, text)));
  if (crumbs.length) items.push(h("li", { "aria-current": "page" }, map && route.section === "place" ? name : route.title));
  put(document.getElementById("crumbs"), h("ol", {}, items));
}

/** Title, breadcrumbs and tabs of a route. */
export function drawHead(route, params) {
  const { map } = params;
  setTitle(route?.title ?? "Not found");
  put(document.getElementById("actions"));
  drawCrumbs(route, params);
  const tabs = document.getElementById("tabs");
  tabs.hidden = !route?.section;
  put(tabs, route?.section && TABS.map(([section, text]) => {
    const href = section === "frames" ? link("maps", map) : link("maps", map, section);
    return h("a", { href, "aria-current": section === route.section && "page" }, text);
  }));
  tabs.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest", inline: "center" }); // they are wider than a phone
}

/** Navigation, theme, and whose key is shown. @param {any} route @param {() => void} again */
export function drawRail(route, again) {
  put(document.getElementById("nav"), AREAS.map(([area, text, href, path]) =>
    h("a", { href, "aria-current": route?.area === area && "page" }, icon(path), h("span", {}, text))));
  const choose = (name) => { setTheme(name); drawRail(route, again); document.getElementById(`theme-${name}`)?.focus(); };
  const themes = THEMES.map(([name, text, path]) => h("button", {
    type: "button", id: `theme-${name}`, title: text, "aria-label": `Theme: ${text}`,
    "aria-pressed": theme() === name, onClick: () => choose(name),
  }, icon(path)));
  const forget = () => { forgetKey(); again(); };
  put(document.getElementById("rail-foot"),
    key() !== null && h("div", { class: "whose" },
      h("span", { class: "muted" }, "Key "), h("strong", {}, me()?.name ?? "not required"),
      h("button", { class: "button quiet", type: "button", onClick: forget }, "Forget")),
    h("div", { class: "themes", role: "group", "aria-label": "Theme" }, themes));
}

function icon(path) {
  return svg("svg", { class: "icon", viewBox: "0 0 24 24", "aria-hidden": "true" }, svg("path", { d: path }));
}
