// The plan of a map on its card, with the robots that queried it last. A robot moves with each answer.
import { at, get } from "../lib/api.js";
import { h, put, svg } from "../lib/dom.js";
import { spread } from "../lib/labels.js";
import { robotTokens } from "../lib/palette.js";
import { picture } from "../lib/picture.js";

const PIXELS = 400; // of the longer side
const TRAIL = 30; // poses of the way of a robot

/** A share of the plan: a robot outside it is shown at its edge. @param {number} share */
const clamp = (share) => Math.min(Math.max(share, 0), 1);

/**
 * @param {string} map @param {AbortSignal} signal
 * @returns {{element: HTMLElement, load: (come?: Promise<any> | null) => Promise<void>, show: (records: Object<string, any>[]) => void, say: (text: any) => void}}
 *   load: fetch the plan where the last robot was, when `come`, the queries, are there; show: the robots of queries in the order of time; say: what stands in place of a plan
 */
export function thumbnail(map, signal) {
  const ways = svg("svg", { class: "map-ways", preserveAspectRatio: "none" });
  const stage = h("div", { class: "map-stage", "aria-hidden": "true" });
  const element = h("div", { class: "map-plan" });
  /** @type {Map<string, HTMLElement>} */
  const robots = new Map();
  /** @type {Object<string, any> | null} */
  let surface = null;
  /** @type {Object<string, any>[]} */
  let shown = [];

  /** @param {Promise<any> | null} [come] */
  async function load(come = null) {
    const [{ parents }] = await Promise.all([get(at("maps", map, "surface"), { signal }), come]);
    const asked = shown.findLast((one) => one.pose)?.pose.parent_frame;
    surface = parents.find((one) => one.parent_frame === asked) ?? parents[0] ?? null;
    if (surface === null) return;
    const { width, height } = surface.plan, share = PIXELS / Math.max(width, height);
    const plan = picture(`${at("maps", map, "surface")}/plan.png`, { parent: surface.parent_frame, width: PIXELS },
      { alt: `Plan of ${map}`, width: Math.round(width * share), height: Math.round(height * share), signal });
    ways.setAttribute("viewBox", `0 0 ${width} ${height}`);
    stage.style.setProperty("--ratio", String(width / height));
    put(stage, plan, ways, [...robots.values()]);
    put(element, stage);
    show(shown);
  }

  // pixels of the plan
  function placeOf({ translation: { x, y, z } }) {
    const { plan: { left, top, m_per_pixel: step }, x_axis: right, y_axis: up } = /** @type {any} */ (surface);
    const along = (axis) => axis[0] * x + axis[1] * y + axis[2] * z;
    return [(along(right) - left) / step, (top - along(up)) / step];
  }

  function show(records) {
    shown = records;
    if (surface === null) return;
    const { width, height } = surface.plan, parent = surface.parent_frame;
    const found = new Map();
    for (const one of records) {
      if (one.robot === null || one.pose?.parent_frame !== parent) continue;
      found.set(one.robot, [...found.get(one.robot) ?? [], placeOf(one.pose)].slice(-TRAIL));
    }
    const tokens = robotTokens([...found.keys()]), colour = (name) => `var(${tokens.get(name)})`;
    for (const [name, one] of robots) if (!found.has(name)) { one.remove(); robots.delete(name); }
    put(ways, [...found].map(([name, way]) => svg("polyline", { points: way.map((p) => p.map((v) => v.toFixed(1)).join(",")).join(" "), style: { stroke: colour(name) } })));
    const places = [...found].map(([name, way]) => ({ name, x: clamp(way.at(-1)[0] / width), y: clamp(way.at(-1)[1] / height) }));
    for (const { name, x, y } of places) {
      const robot = robots.get(name) ?? h("span", { class: "map-robot", dataset: { robot: name } }, h("span", { class: "map-robot-name" }, name));
      robot.style.setProperty("left", `${(100 * x).toFixed(2)}%`); // it moves there, rather than jumps
      robot.style.setProperty("top", `${(100 * y).toFixed(2)}%`);
      robot.style.setProperty("--robot", colour(name));
      if (!robots.has(name)) { robots.set(name, robot); stage.append(robot); }
    }
    label(places);
  }

  function label(places) {
    const room = { width: element.clientWidth, height: element.clientHeight }; // a plan may be narrow
    const [left, top] = [(room.width - stage.clientWidth) / 2, (room.height - stage.clientHeight) / 2];
    const labels = places.map(({ name, x, y }) => ({ x: left + x * stage.clientWidth, y: top + y * stage.clientHeight, node: /** @type {HTMLElement} */ (robots.get(name)?.firstElementChild) }));
    spread(labels.map(({ x, y, node }) => ({ x, y, width: node.offsetWidth, height: node.offsetHeight })), room).forEach((spot, i) => {
      const { node } = labels[i];
      node.style.setProperty("visibility", spot === null ? "hidden" : "visible");
      node.style.setProperty("left", `${spot?.[0] ?? 0}px`);
      node.style.setProperty("top", `${spot?.[1] ?? 0}px`);
    });
  }

  return { element, load, show, say: (text) => { if (surface === null) put(element, text); } };
}
