// Addresses of the pages: everything behind `#`, so that they survive a reload and can be shared.

/** Pages by the pattern of their address; `:name` is a segment. `section`: its place in the tabs of a
 * map; `heading`: what stands before the title of the map in the heading, if it has that. */
export const ROUTES = [
  { path: "", page: "maps/maps.js", area: "maps", title: "Maps" },
  { path: "maps/:map", page: "frames/gallery.js", area: "maps", section: "frames", title: "Frames", heading: "Frames of " },
  { path: "maps/:map/frames/:frame", page: "frames/frame.js", area: "maps", section: "frames", title: "Frame" },
  { path: "maps/:map/sessions", page: "sessions/sessions.js", area: "maps", section: "sessions", title: "Sessions", heading: "Sessions of " },
  { path: "maps/:map/difference", page: "difference/difference.js", area: "maps", section: "sessions", title: "Difference", heading: "Difference in " },
  { path: "maps/:map/upload", page: "frames/upload.js", area: "maps", section: "upload", title: "Upload", heading: "Upload to " },
  { path: "maps/:map/query", page: "query/ask.js", area: "maps", section: "query", title: "Query", heading: "Query " },
  { path: "maps/:map/queries", page: "history/queries.js", area: "maps", section: "queries", title: "Queries", heading: "Queries of " },
  { path: "maps/:map/coverage", page: "coverage/coverage.js", area: "maps", section: "coverage", title: "Coverage", heading: "Coverage of " },
  { path: "maps/:map/place", page: "place/place.js", area: "maps", section: "place", title: "Place", heading: "" },
  { path: "queries/:query", page: "query/answer.js", area: "maps", title: "Answer" },
  { path: "queries/:query/matches/:frame", page: "overlay/overlay.js", area: "maps", title: "Overlay" },
  { path: "operations", page: "operations/operations.js", area: "operations", title: "Operations" },
  { path: "operations/jobs/:job", page: "operations/job.js", area: "operations", title: "Job" },
];

/**
 * What an address stands for; `route` is null where it is none of ours.
 * @param {string} hash with its `#`
 * @returns {{route: Object<string, any> | null, params: Object<string, string>, search: URLSearchParams, path: string}}
 */
export function parse(hash) {
  const [path, query] = hash.replace(/^#?\/?/, "").split(/\?(.*)/s, 2);
  const search = new URLSearchParams(query ?? "");
  const given = path.replace(/\/+$/, "").split("/");
  for (const route of ROUTES) {
    const wanted = route.path.split("/");
    if (wanted.length !== given.length) continue;
    const params = {};
    const fits = wanted.every((one, i) => {
      if (!one.startsWith(":")) return one === given[i];
      params[one.slice(1)] = decoded(given[i]);
      return given[i] !== "";
    });
    if (fits) return { route, params, search, path };
  }
  return { route: null, params: {}, search, path };
}

/**
 * An address: `link("maps", name, "frames", id, {k: 5})`; a last object is its search.
 * @param {...(string | Object<string, any> | URLSearchParams)} parts
 */
export function link(...parts) {
  const last = parts.at(-1);
  const search = typeof last === "object" ? last : null;
  if (search) parts.pop();
  return `#/${parts.map((one) => encodeURIComponent(String(one))).join("/")}${searchOf(search)}`;
}

/** The end of an address from `?` on, of what has a value; lists have one for each item. */
export function searchOf(params) {
  const query = new URLSearchParams();
  for (const [name, value] of params instanceof URLSearchParams ? params : Object.entries(params ?? {})) {
    for (const one of [value].flat()) if (one !== null && one !== undefined && one !== "") query.append(name, one);
  }
  return query.size ? `?${query}` : "";
}

/**
 * Go to a page. `replace`: Back leads past this one; `quiet`: the page that is shown has changed
 * itself already, and only its address follows; `state`: what the history keeps with it.
 * @param {string} hash @param {{replace?: boolean, quiet?: boolean, state?: any}} [how]
 */
export function go(hash, { replace = false, quiet = false, state = null } = {}) {
  const same = hash === (location.hash || "#/");
  if (replace || same) history.replaceState(state, "", hash); else history.pushState(state, "", hash);
  if (!quiet) window.dispatchEvent(new CustomEvent("sceneprint:go"));
}

// what is no percent-encoding stands for itself
function decoded(segment) {
  try { return decodeURIComponent(segment); } catch { return segment; }
}
