// A frame in 3-D: its points, and its patches by level, as discs of their area. Loaded by the page
// of a frame alone, as it brings the 3-D view along.
import { at, bytes, get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { count, metres } from "../lib/format.js";
import { fill } from "../lib/states.js";
import { manyColours } from "../viewer/colours.js";
import { cross, scale } from "../viewer/matrix.js";
import { parsePoints } from "../viewer/points.js";
import { createViewer, frustum } from "../viewer/viewer.js";
import { viewSwitch } from "./views.js";

const COLOURS = [["height", "Height"], ["normal", "Normals"], ["patch", "Patches"]];
const LARGEST = 10;
const CORNERS = 10;
const LIFT = 0.012; // metres: a disc within the points would be half hidden by them

/**
 * Cards with the cloud and the patches of an indexed frame.
 * @param {AbortSignal} signal @returns {Promise<HTMLElement[]>} they fill themselves when the points have come
 */
export async function scene(frame, signal) {
  const path = at("maps", frame.map, "frames", frame.frame_id);
  const canvas = h("canvas", { class: "scene-canvas" });
  const told = h("div", { class: "scene-told muted", role: "status" });
  const patchesPlace = h("div", { class: "patches" });
  /** @type {{colour: string, level: number, points: any, levels: any}} */
  const state = { colour: "height", level: 0, points: null, levels: null };
  const colours = viewSwitch(state.colour, (one) => { state.colour = one; draw(); }, COLOURS, "Colour of the points");
  const cards = [
    h("section", { class: "card scene", "aria-labelledby": "scene-title" },
      h("div", { class: "card-head" }, h("h2", { id: "scene-title" }, "In 3-D"), colours),
      h("div", { class: "scene-view" }, canvas), told),
    h("section", { class: "card", "aria-labelledby": "patches-title" },
      h("h2", { id: "patches-title" }, "Patches"), patchesPlace),
  ];
  /** @type {any} the viewer, once the points have come */
  let viewer = null;

  async function begin() {
    state.points = parsePoints(await bytes(`${path}/points`, { signal }));
    const { count: shown, total } = state.points;
    const words = `${count(shown)}${total > shown ? ` of ${count(total)}` : ""} points. Drag to turn, Shift and drag to move, wheel to zoom, 0 shows all.`;
    viewer = createViewer(canvas, {
      label: `Point cloud of frame ${frame.frame_id}, ${count(shown)} points`, up: frame.kind === "cloud" ? "z" : "-y",
      onlost: (lost) => canvas.toggleAttribute("data-lost", lost),
    });
    signal.addEventListener("abort", () => viewer.destroy(), { once: true });
    if (signal.aborted) viewer.destroy();
    viewer.cloud("points", { points: state.points, colour: "height" });
    if (frame.kind !== "cloud" || frame.viewpoint) {
      viewer.lines("sensor", { positions: frustum(frame.intrinsics, 0.25), tint: "query" });
    }
    if (frame.kind === "cloud") viewer.look({ elevation: 0.8 }); // a scan is wide and flat
    viewer.fit(["points"]);
    draw();
    return words;
  }

  async function describe() {
    const told = await get(`${path}/patches`, { signal });
    state.levels = [...told.levels.map((one, i) => levelOf(one, `Level ${i + 1}`)), levelOf(told.validation, "Validation")];
    const names = state.levels.map((one, i) => [String(i), `${one.name} · ${count(one.size.length)}`]);
    const table = h("div", { class: "patches-table" });
    const pick = viewSwitch("0", (one) => {
      state.level = Number(one);
      put(table, tableOf(state.levels[state.level]));
      colours.show("patch");
      state.colour = "patch";
      draw();
    }, names, "Level");
    put(table, tableOf(state.levels[0]));
    draw();
    return [pick, table];
  }

  function draw() {
    if (!viewer) return;
    const level = state.levels?.[state.level];
    const isPatch = state.colour === "patch" && level;
    // which point is of which patch is told of validation's; of the others, where they are
    const byPoint = isPatch && level.name === "Validation" && state.points.hasPatches;
    const look = isPatch ? (byPoint ? { colour: "patch", patchColours: level.colours } : { colour: "tint", tint: "muted" }) : { colour: state.colour };
    viewer.cloud("points", look);
    if (isPatch && !byPoint) viewer.triangles("patches", { ...discs(level), visible: true });
    else if (viewer.has?.("patches")) viewer.remove("patches");
  }

  fill(told, begin, "Loading the points");
  fill(patchesPlace, describe, "Loading the patches");
  return cards;
}

function levelOf(told, name) {
  return { ...told, name, colours: manyColours(told.size.length) };
}

/** A disc for each patch, of its area and facing as it does. */
function discs({ mean, normal, area_m2, colours }) {
  const positions = new Float32Array(9 * CORNERS * mean.length);
  const painted = new Uint8Array(9 * CORNERS * mean.length);
  let to = 0;
  mean.forEach((centre, i) => {
    const n = normal[i];
    // any direction that is not the normal's spans the disc's plane with it
    const other = Math.abs(n[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0];
    const side = cross(n, other), u = scale(side, 1 / Math.hypot(...side));
    const v = cross(n, u);
    const radius = Math.sqrt(area_m2[i] / Math.PI);
    const middle = centre.map((x, k) => x + LIFT * n[k]);
    const corner = (j) => {
      const angle = (2 * Math.PI * j) / CORNERS;
      return middle.map((x, k) => x + radius * (Math.cos(angle) * u[k] + Math.sin(angle) * v[k]));
    };
    for (let j = 0; j < CORNERS; j += 1) {
      positions.set([...middle, ...corner(j), ...corner(j + 1)], to);
      for (let k = 0; k < 9; k += 3) painted.set(colours.subarray(3 * i, 3 * i + 3), to + k);
      to += 9;
    }
  });
  return { positions, colours: painted };
}

function tableOf(level) {
  const order = level.area_m2.map((_, i) => i).sort((a, b) => level.area_m2[b] - level.area_m2[a]);
  const area = level.area_m2.reduce((sum, one) => sum + one, 0);
  const rows = order.slice(0, LARGEST).map((i) => {
    const [r, g, b] = level.colours.subarray(3 * i, 3 * i + 3);
    return h("tr", {},
      h("td", {}, h("span", { class: "swatch", style: { background: `rgb(${r} ${g} ${b})` } }), h("span", { class: "mono" }, ` ${i}`)),
      h("td", { class: "number" }, squared(level.area_m2[i])), h("td", { class: "number" }, count(level.size[i])),
      h("td", { class: "number" }, metres(Math.hypot(...level.mean[i]))),
      h("td", { class: "number mono three" }, three(level.mean[i])), h("td", { class: "number mono three" }, three(level.normal[i])));
  });
  const heads = ["Patch", "Area", "Pixels", "Away", "Centre x y z, m", "Normal x y z"];
  return [
    h("p", { class: "muted" }, `${count(level.size.length)} patches cover ${area.toFixed(2)} m². The largest:`),
    h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": `The largest patches, ${level.name}` },
      h("table", { class: "table" },
        h("thead", {}, h("tr", {}, heads.map((one, i) => h("th", { scope: "col", class: i ? "number" : "" }, one)))),
        h("tbody", {}, rows))),
  ];
}

function three(vector) {
  return vector.map((x) => x.toFixed(2).padStart(6)).join(" ");
}

function squared(area) {
  return area < 0.1 ? `${(1e4 * area).toFixed(0)} cm²` : `${area.toFixed(2)} m²`;
}
