// The rows R, DR and VDR one under the other, the query at their left, as in the paper's figure.
import { h, put } from "../lib/dom.js";
import { count, frameLabel, frameTitle, percent, shortId } from "../lib/format.js";
import { coded, plain } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { voteOf } from "./alternatives.js";
import { figures, keyOf, number, statusOf } from "./words.js";

const VIEWS = [["depth", "Depth"], ["normals", "Normals"], ["patches", "Patches"]];
/** Why nothing was tried, where validation was left out. */
const NOT_ASKED = "not requested";
let view = "depth"; // as it was chosen last, for the next answer

/**
 * @param {Object<string, any>} answer
 * @param {{ranking: any[], told: boolean}} ranked the ranking; told: with distances and reasons
 * @param {{pictures: any, choice: any, before?: Object<string, any> | null}} shown before: the answer
 *   that this one replaces
 */
export function rows(answer, ranked, { pictures, choice, before = null }) {
  const several = answer.maps.length > 1;
  const was = before && new Map(before.matches.map((one) => [keyOf(one), statusOf(one.validation).text]));
  const tiles = []; // all of them, to be marked
  const selected = answer.matches.filter((one) => one.selected !== false).toSorted((a, b) => a.rank - b.rank);
  const isSelection = answer.counts.selected > 0;
  const validated = answer.matches.filter((one) => one.validation.status !== "skipped");
  const isTried = answer.matches.some((one) => one.validation.reason !== NOT_ASKED);
  const skipped = answer.matches.length - validated.length;
  const reasons = new Map((answer.explanations ?? []).map((one) => [keyOf(one), one]));
  const body = h("div", { class: "query-rows" });
  const pick = h("select", { id: "query-view", onchange: () => { view = pick.value; draw(); } },
    VIEWS.map(([value, text]) => h("option", { value }, text)));
  pick.value = view;

  const query = h("figure", { class: "query-asked" });
  let lines = [];
  let looked = [null, null];
  const follow = () => mark(lines, tiles, reasons, ...looked);

  function draw() {
    tiles.length = 0;
    put(query, asked(answer, pictures));
    lines = [
      line("R", "Ranking by distance", `${count(answer.counts.ranked)} of ${count(answer.counts.compared)} compared${ranked.ranking.length < answer.counts.ranked ? `, ${count(ranked.ranking.length)} shown` : ""}`,
        ranked.ranking, (one) => [
          ranked.told && h("span", { class: "query-figure" }, h("span", { class: "muted" }, "distance "), count(one.distance)),
          similarity(one.similarity)],
        (one) => `of rank ${one.rank}`),
      line("DR", isSelection ? "Diverse selection" : "Diversification was not requested", isSelection
        ? `${count(selected.length)} of ${count(answer.counts.ranked)} ranked` : "",
      isSelection ? selected : [], (one) => [
        h("span", { class: "query-figure" }, h("span", { class: "muted", title: "How much the frame added to the selection when it was selected: more for a near frame that resembles none of the others" }, "gain "), number(one.diversity_gain)), bar(one.diversity_gain)],
      (one) => `selected, with a gain of ${number(one.diversity_gain)}`),
      line("VDR", validated.length ? "Validated, best first" : isTried ? "Nothing was validated" : "Validation was not requested", validated.length
        ? `${count(answer.counts.accepted)} of ${count(answer.counts.validated)} accepted${skipped ? `, ${skipped} not tried` : ""}` : "",
      isTried ? answer.matches : [], (one) => evidence(answer, one, was),
      (one) => `${statusOf(one.validation).text}: ${one.validation.reason}`, "wide"),
    ];
    put(body, lines);
    follow();
  }

  function line(name, title, tally, frames, tell, fate, size = "") {
    const trace = h("span", { class: "query-trace" });
    const list = h("ol", { class: `query-tiles ${size}`, "aria-label": `${name}: ${title}` },
      frames.map((one) => tile(one, tell(one), name)));
    const element = h("section", { class: "query-row", "aria-label": name, dataset: { row: name } },
      h("div", { class: "query-row-head" }, h("h3", {}, title), h("span", { class: "muted", title: "Name of this row in the paper" }, name), h("span", { class: "muted number query-row-title" }, tally), trace),
      list);
    return Object.assign(element, { trace, list, fates: new Map(frames.map((one) => [keyOf(one), fate(one)])), name });
  }

  function tile(one, told, row) {
    const key = keyOf(one);
    const label = `Rank ${one.rank}, frame ${frameTitle(one)}${several ? ` of map ${one.map}` : ""}`;
    const status = row === "VDR" ? one.validation.status : null;
    const button = h("button", { type: "button", class: "query-pick", "aria-pressed": "false", "aria-label": `${label}: highlight it in all rows`,
      onclick: () => choice.toggle(key) },
    pictures.frame(one.map, one.frame_id, view, `Preview of frame ${frameLabel(one)}`), h("span", { class: "query-rank" }, one.rank));
    const element = h("li", { class: "query-tile", dataset: { key, status },
      onmouseenter: () => choice.point(key), onmouseleave: () => choice.point(null),
      onfocusin: () => choice.point(key), onfocusout: () => choice.point(null) },
    button, h("div", { class: "query-tile-text" },
      h("a", { class: "mono query-id", href: link("maps", one.map, "frames", one.frame_id), title: frameTitle(one) }, frameLabel(one)),
      several && h("span", { class: "muted" }, one.map), told));
    tiles.push({ key, element, button });
    return element;
  }

  draw();
  choice.hear((...keys) => { looked = keys; follow(); });
  const clear = (event) => { if (event.key === "Escape") choice.choose(null); };
  return h("section", { class: "query-figure-block", "aria-label": "Rows R, DR, VDR", onkeydown: clear },
    h("div", { class: "toolbar query-rows-bar" },
      h("span", { class: "muted" }, "Hover over a frame to follow it through the rows; click to keep it highlighted."),
      h("label", { class: "query-view", for: "query-view" }, "Pictures ", pick)),
    h("div", { class: "query-figure-grid" }, query, body));
}

function asked(answer, pictures) {
  const { frame, query_id: id } = answer;
  const alt = `The query, ${frame ? `frame ${frame.frame_id}` : "an uploaded file"}`;
  return [
    frame ? pictures.frame(frame.map, frame.frame_id, view, alt) : pictures.query(id, view, alt),
    h("figcaption", {}, h("strong", {}, "Query"),
      frame ? h("a", { class: "mono", href: link("maps", frame.map, "frames", frame.frame_id), title: frame.frame_id }, shortId(frame.frame_id))
        : h("span", { class: "muted" }, "uploaded", view === "patches" && "; its patches are not stored, this is its depth"),
      frame && !answer.maps.every((one) => one === frame.map) && h("span", { class: "muted" }, `of map ${frame.map}`))];
}

function evidence(answer, one, was) {
  const { kind, text } = statusOf(one.validation);
  const measured = figures(one.validation), vote = voteOf(answer, one);
  return [
    h("span", { class: "badge", dataset: { kind } }, text),
    vote && h("span", { class: "query-vote" }, vote),
    was && was.get(keyOf(one)) !== text && h("span", { class: "query-was" }, was.has(keyOf(one)) ? `was ${was.get(keyOf(one))}` : "was not a candidate"),
    h("span", { class: "query-reason" }, coded(one.validation.reason)),
    measured.length > 0 && h("dl", { class: "query-figures" }, measured.map(([term, value]) => [h("dt", {}, term), h("dd", { class: "number" }, value)])),
    one.transform && h("a", { class: "query-overlay", href: link("queries", answer.query_id, "matches", one.frame_id, { map: one.map }) }, "Overlay in 3-D"),
  ];
}

function similarity(share) {
  return [h("span", { class: "query-figure" }, h("span", { class: "muted" }, "similar "), percent(share)), bar(share)];
}

function bar(share) {
  return h("span", { class: "query-bar", "aria-hidden": "true" }, h("span", { style: { width: `${(100 * Math.min(1, Math.max(0, share ?? 0))).toFixed(1)}%` } }));
}

// what becomes of the frame that is looked at, beside the name of each row
function mark(lines, tiles, reasons, key, chosen) {
  for (const one of tiles) {
    one.element.classList.toggle("is-marked", key === one.key);
    one.element.classList.toggle("is-dim", key !== null && key !== one.key);
    one.button.setAttribute("aria-pressed", String(chosen === one.key));
  }
  let lost = key === null;
  for (const one of lines) {
    const fate = one.fates.get(key);
    const isLoss = !lost && fate === undefined && one.list.childElementCount > 0;
    lost ||= isLoss;
    const reason = reasons.get(key)?.reason ?? (one.name === "R" ? "it is not ranked" : "it is not among these");
    one.trace.dataset.lost = String(isLoss);
    const text = fate !== undefined ? `${shortId(key.slice(key.indexOf("/") + 1))}: ${fate}` : isLoss ? `Lost here: ${reason}` : "";
    put(one.trace, coded(text));
    one.trace.title = plain(text);
    const tile = fate !== undefined && chosen === key && tiles.find((each) => each.key === key && one.list.contains(each.element))?.element;
    // by hand: scrollIntoView would move the page under the pointer
    if (tile) one.list.scrollLeft = Math.max(0, tile.offsetLeft - (one.list.clientWidth - tile.clientWidth) / 2);
  }
}
