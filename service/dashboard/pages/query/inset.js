// The query laid on one of its matches, beside the plan; the page of the overlay has all the rest.
import { h, inView, put } from "../lib/dom.js";
import { frameLabel, metres, percent } from "../lib/format.js";
import { link } from "../lib/router.js";
import { fill } from "../lib/states.js";
import { overlayParts, sensorsOf } from "../overlay/parts.js";
import { keyOf, statusOf } from "./words.js";

/**
 * @param {Object<string, any>} answer
 * @param {{pictures: any, choice: any, signal: AbortSignal, wanted?: string | null, onshow?: (key: string) => void}} how
 *   wanted: key of the match that is shown first; onshow: another match was chosen here
 * @returns {HTMLElement | null} null where there is no frame to compare
 */
export function overlayInset(answer, { pictures, choice, signal, wanted = null, onshow = () => {} }) {
  const laid = answer.matches.filter((one) => one.transform);
  if (answer.matches.length === 0) return null;
  const head = h("h2", { id: "query-inset-title" }, "Overlay");
  if (laid.length === 0) {
    return h("section", { class: "card query-inset", "aria-labelledby": "query-inset-title" }, head, besideNearest(answer, pictures));
  }
  const stage = h("div", { class: "query-inset-stage" });
  const told = h("p", { class: "query-inset-told" });
  const open = h("a", { class: "button" }, "Overlay in 3-D");
  const field = h("select", { id: "query-inset-match", "aria-label": "Match", onChange: () => { choice.choose(field.value); onshow(field.value); } },
    laid.map((one, i) => h("option", { value: keyOf(one) }, `${i + 1} · ${frameLabel(one)} · ${statusOf(one.validation).text}`)));
  const poses = h("div", { class: "query-inset-poses toolbar", role: "group", "aria-label": "Pose" });
  /** @type {string | null} */
  let shown = null;
  /** @type {AbortController | null} */
  let turn = null;
  signal.addEventListener("abort", () => turn?.abort(), { once: true });

  async function show(key) {
    const match = laid.find((one) => keyOf(one) === key);
    if (!match || key === shown) return;
    shown = field.value = key;
    turn?.abort();
    const own = turn = new AbortController();
    const { kind, text } = statusOf(match.validation), { overlap, residual } = match.validation;
    open.href = link("queries", answer.query_id, "matches", match.frame_id, { map: match.map });
    put(told, h("span", { class: "badge", dataset: { kind } }, text), " ", overlap !== null && `overlap ${percent(overlap)}`,
      residual && `, residual ${metres(residual.translation_m)}`);
    put(poses);
    await fill(stage, () => draw(stage, poses, answer, match, own.signal), "Loading the overlay");
  }

  choice.hear((_, chosen) => { if (chosen !== null) show(chosen); });
  const element = h("section", { class: "card query-inset", "aria-labelledby": "query-inset-title" },
    h("div", { class: "query-inset-head" }, head, open), h("div", { class: "query-inset-bar" }, field, poses), stage,
    h("div", { class: "query-inset-foot" }, h("ul", { class: "plan-key", "aria-label": "Colours" },
      h("li", {}, h("span", { class: "query-swatch", dataset: { side: "query" } }), "Query"), h("li", {}, h("span", { class: "query-swatch", dataset: { side: "match" } }), "Match")), told));
  // when it is looked at: the service validates the match for it
  inView(signal)(element, () => { if (shown === null) show(laid.some((one) => keyOf(one) === wanted) ? wanted : keyOf(laid[0])); });
  return element;
}

/** Draw it, and the buttons that turn it. */
async function draw(stage, buttons, answer, match, signal) {
  const parts = overlayParts(answer.query_id, match.frame_id, match.map, signal);
  const [details, aligned, asked, matched, { createViewer }, { Scene }] = await Promise.all([
    parts.details(), parts.points("aligned"), answer.frame && parts.frame(answer.frame), parts.frame(match),
    import("../viewer/viewer.js"), import("../overlay/scene.js")]);
  if (signal.aborted) return;
  const canvas = h("canvas", { class: "query-inset-canvas" });
  put(stage, canvas);
  const { up, cameras } = sensorsOf(details, answer, { asked, matched }, aligned);
  const viewer = createViewer(canvas, { label: `Query laid on ${frameLabel(match)}, ${details.validation.status}`, up });
  canvas.viewer = viewer;
  if (!viewer.available) return;
  const first = details.transform ? "aligned" : "before";
  const scene = new Scene(viewer, details, { aligned }, cameras,
    { pose: first, share: first === "before" ? 0 : 1, hidden: new Set(["patches", "violations", "free"]), colour: "source" }, () => {});
  signal.addEventListener("abort", () => { scene.destroy(); viewer.destroy(); }, { once: true });
  const both = /** @type {["before" | "aligned", string][]} */ ([["before", "Before"], ["aligned", "Aligned"]]).map(([pose, text]) => h("button", {
    class: "button", type: "button", "aria-pressed": pose === first, disabled: pose === "aligned" && !details.transform,
    onClick: () => {
      scene.turn(pose);
      both.forEach((one, i) => one.setAttribute("aria-pressed", String((i === 1) === (pose === "aligned"))));
    },
  }, text));
  put(buttons, both);
}

/** Where nothing could be laid on anything: the query and the frame nearest to it. */
function besideNearest(answer, pictures) {
  const [near] = answer.matches.toSorted((a, b) => a.rank - b.rank);
  const query = answer.frame ? pictures.frame(answer.frame.map, answer.frame.frame_id, "depth", "The query") : pictures.query(answer.query_id, "depth", "The query");
  return [h("div", { class: "query-beside" },
    h("figure", {}, query, h("figcaption", {}, "Query")),
    h("figure", {}, pictures.frame(near.map, near.frame_id, "depth", `Frame ${frameLabel(near)}`),
      h("figcaption", {}, "Nearest frame, ", h("a", { class: "mono", href: link("maps", near.map, "frames", near.frame_id) }, frameLabel(near))))),
  h("p", { class: "muted" }, "No transform was found, so nothing can be laid on the query.")];
}
