// A query and one of its matches laid on each other, with all that speaks for and against it.
import { at, save } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { shortId } from "../lib/format.js";
import { picture } from "../lib/picture.js";
import { coded, sentence } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { toast } from "../lib/states.js";
import { residualCounts } from "../viewer/points.js";
import { createViewer } from "../viewer/viewer.js";
import { legend } from "./legend.js";
import { evidenceCard, framesCard, rivalCard, transformCard, uncertaintyCard, verdictCard } from "./numbers.js";
import { sensorsOf, TRANSFORM } from "./parts.js";
import { Scene, tally } from "./scene.js";

const COLOURS = [["source", "Source"], ["normal", "Normals"], ["residual", "Residual"]];
const POSES = { before: "Before", aligned: "Aligned", rival: "Rival" };
const PARTS = { query: "Query", match: "Match", patches: "Patches", violations: "Violations", cameras: "Sensors", free: "Free directions" };

/**
 * @param {HTMLElement} root @param {Object<string, any>} context of the router
 * @param {Object<string, any>} told the answer, the match's details, points under its transform, both frames
 *   (null where they are not, or not kept), addresses, and how points under another are loaded
 */
export function show(root, { params, search, signal, go, actions }, { answer, details, aligned, asked, matched, query, match, map, load }) {
  const poses = ["before", details.transform && "aligned", details.rival && "rival"].filter(Boolean);
  const wanted = search.get("pose"), first = poses.includes(wanted) ? wanted : poses[1] ?? "before";
  const shown = {
    pose: first, share: first === "before" ? 0 : 1, hidden: new Set(["patches"]),
    colour: COLOURS.some(([name]) => name === search.get("colour")) ? search.get("colour") : "source",
  };
  const sets = { aligned }, coming = new Set();
  const tallies = {};
  const count = (pose) => {
    const { query: a, match: b } = sets[pose];
    if (a.hasResiduals) tallies[pose] = tally([residualCounts(a), residualCounts(b)]);
  };
  count("aligned");

  const canvas = h("canvas", { class: "overlay-canvas" });
  const lost = h("p", { class: "overlay-lost", role: "status", hidden: true }, "The browser suspended 3-D graphics. The view returns when the browser resumes them.");
  const said = h("div", { class: "visually-hidden", role: "status" });
  const legends = h("div");
  const bar = h("div", { class: "overlay-bar" });
  const rival = h("div");
  const stage = h("div", { class: "overlay-stage" }, canvas, lost);
  const view = h("section", { class: "card overlay-view", "aria-label": "The view" }, bar, stage, legends);
  const side = h("div", { class: "overlay-side" }, verdictCard(answer, details), rival, evidenceCard(details),
    transformCard(details), uncertaintyCard(details), framesCard(answer, details, matched, asked));
  put(root, h("div", { class: "overlay-page" }, view, side));
  actions(steps(answer, params, map), h("button", {
    class: "button", type: "button", onClick: () => download(),
  }, "Download PLY"));

  const { up, cameras } = sensorsOf(details, answer, { asked, matched }, aligned);
  const viewer = createViewer(canvas, {
    label: `Query and match ${shortId(params.frame)}, ${details.validation.status}`, up,
    onlost: (isLost) => { lost.hidden = !isLost; },
    onview: () => { if (viewer.frames === 1) performance.mark("overlay"); }, // for who measures it
  });
  canvas.viewer = viewer; // for who measures it
  if (!viewer.available) {
    put(legends, h("div", { class: "overlay-flat" }, pictures(details, query, signal)));
    put(rival, rivalCard(details, tallies));
    return;
  }
  const scene = new Scene(viewer, details, sets, cameras, shown, () => slid());
  canvas.scene = scene;
  signal.addEventListener("abort", () => { scene.destroy(); viewer.destroy(); }, { once: true });

  const slider = h("input", {
    type: "range", min: 0, max: 100, step: 1, "aria-label": "From before to aligned", class: "overlay-slide",
    disabled: !details.transform, onInput: (event) => { scene.blend(event.target.value / 100); drawn(); },
  });
  const slid = () => { slider.value = String(Math.round(100 * shown.share)); };

  /** Points with the residuals of the pose that is shown, where they are wanted and not there. */
  async function fetched(pose) {
    if (sets[pose] || coming.has(pose) || !details.transform) return;
    coming.add(pose); // once, whatever is pressed meanwhile
    try {
      const set = await load(pose);
      if (signal.aborted) return;
      scene.add(pose, set);
      count(pose);
      drawn();
    } catch (error) {
      if (error.status === 401) throw error;
      if (error.name !== "AbortError") toast(error.message, { kind: "bad" });
    } finally {
      coming.delete(pose);
    }
  }

  function choose(pose) {
    if (!poses.includes(pose)) return;
    scene.turn(pose);
    if (pose === "rival" || shown.colour === "residual") fetched(pose);
    said.textContent = `${POSES[pose]} is shown.`;
    drawn();
  }
  function paint(colour) {
    shown.colour = colour;
    if (colour === "residual") fetched(shown.pose);
    scene.paint();
    drawn();
  }
  function toggle(part) {
    if (!shown.hidden.delete(part)) shown.hidden.add(part);
    scene.paint();
    drawn();
  }
  async function download() {
    const name = `overlay-${shortId(params.frame)}-${shown.pose}-${shown.colour}.ply`;
    const told = { map, color: shown.colour, transform: TRANSFORM[shown.pose] };
    await save(`${match}/overlay.ply`, { params: told, name });
  }

  /** Controls, legend and address, as what is shown is now. */
  function drawn() {
    const focused = document.activeElement?.id;
    const button = (id, text, isOn, act, more = {}) => h("button", {
      class: "button", type: "button", id: `overlay-${id}`, "aria-pressed": isOn, onClick: act, ...more,
    }, text);
    const group = (label, ...buttons) => h("div", { class: "overlay-group", role: "group", "aria-label": label }, buttons);
    const parts = Object.keys(PARTS).filter((part) => (part !== "patches" || details.patches)
      && (part !== "violations" || details.transform) && (part !== "free" || details.uncertainty?.degenerate.length));
    put(bar,
      h("div", { class: "overlay-row" },
        group("Pose", Object.keys(POSES).filter((pose) => pose !== "rival" || details.rival).map((pose) =>
          button(pose, POSES[pose], shown.pose === pose, () => choose(pose), { disabled: !poses.includes(pose) }))),
        slider,
        group("Colours", COLOURS.map(([colour, text]) => button(colour, text, shown.colour === colour, () => paint(colour))))),
      h("div", { class: "overlay-row" },
        group("Layers", parts.map((part) => button(part, PARTS[part], !shown.hidden.has(part), () => toggle(part)))),
        button("fit", "Show all", null, () => scene.fit())));
    if (focused?.startsWith("overlay-")) document.getElementById(focused)?.focus();
    const points = shown.colour === "residual" && sets[shown.pose] ? sets[shown.pose] : aligned;
    put(legends, !details.transform && h("p", { class: "overlay-none" }, h("strong", {}, "No transform. "),
      coded(sentence(details.validation.reason)), " Both are shown in their own sensor frames, with a common origin."),
    legend(shown, details, points, tallies[shown.pose]),
    h("p", { class: "muted overlay-keys" }, "Drag to turn, with Shift to move, wheel or pinch to zoom. In the view: arrows, + and −, 0 shows all; B toggles before and after",
      details.rival && ", R rival", ", C colours, P patches, V violations, S sensors."), said);
    put(rival, rivalCard(details, tallies));
    go(link("queries", params.query, "matches", params.frame, {
      map: search.get("map"), pose: shown.pose === (poses[1] ?? "before") ? null : shown.pose,
      colour: shown.colour === "source" ? null : shown.colour,
    }), { replace: true, quiet: true });
  }

  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const next = COLOURS[(COLOURS.findIndex(([name]) => name === shown.colour) + 1) % COLOURS.length][0];
    const acts = {
      b: () => choose(shown.pose === "before" ? poses[1] : "before"), r: () => choose("rival"), c: () => paint(next),
      p: () => details.patches && toggle("patches"), v: () => toggle("violations"), s: () => toggle("cameras"),
    };
    const act = acts[event.key.toLowerCase()];
    if (act) { event.preventDefault(); act(); }
  });
  slid();
  drawn();
  if (shown.colour === "residual" || first === "rival") fetched(first);
  if (details.rival) fetched("rival"); // its evidence is told beside that of the other
}

/** To the matches before and after it in the answer. */
function steps(answer, params, map) {
  const tried = answer.matches.filter((one) => one.validation.status !== "skipped");
  const i = tried.findIndex((one) => one.frame_id === params.frame && (!map || one.map === map));
  const to = (one, text, label) => one && h("a", { class: "button", "aria-label": label,
    href: link("queries", answer.query_id, "matches", one.frame_id, { map: one.map }) }, text);
  return i < 0 ? null : [to(tried[i - 1], "← Previous", "Previous match"), to(tried[i + 1], "Next →", "Next match")];
}

/** Where nothing can be drawn in 3-D: both as pictures. */
function pictures(details, query, signal) {
  const one = (text, path) => h("figure", {}, picture(path, { view: "depth", width: 320 },
    { alt: `Depth of the ${text.toLowerCase()}`, width: 320, height: 240, signal }), h("figcaption", { class: "muted" }, text));
  return [one("Query", `${query}/preview.png`), one("Match", `${at("maps", details.map, "frames", details.frame_id)}/preview.png`)];
}
