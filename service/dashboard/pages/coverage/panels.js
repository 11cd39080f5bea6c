// Beside the plan: what came of it in numbers, the worst areas, and what is in the one that is chosen.
import { h } from "../lib/dom.js";
import { count, degrees, metres, percent, shortId, things } from "../lib/format.js";
import { coded, sentence } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { checkedIn, outcomeMark, outcomeOf, outcomesIn, queriedIn, tally, TRENDS, worstCells } from "./outcomes.js";
import { keyOf } from "./sheet.js";

const MOST_WORST = 8, MOST_LISTED = 40;

/** How many frames have each outcome. @param {Object<string, any>} result */
export function countsCard(result) {
  const before = result.last_revision !== result.revision;
  return h("section", { class: "card cover-card", "aria-labelledby": "cover-counts" },
    h("h2", { id: "cover-counts" }, `${count(result.frames)} of ${count(result.map_frames)} frames queried`),
    h("ul", { class: "cover-counts" }, outcomesIn(result).map(({ name, text }) => h("li", { dataset: { outcome: name } },
      outcomeMark(name), h("span", {}, text), h("strong", { class: "number" }, count(result[name])),
      h("span", { class: "muted number" }, name === "unchecked" ? "" : percent(result[name] / Math.max(checkedIn(result), 1)))))),
    result.unchecked > 0 && h("p", { class: "muted" }, coded(outcomeOf("unchecked").next ?? "")),
    result.skipped > 0 && h("p", { class: "muted" }, `${count(result.skipped)} could not be queried: deleted, damaged or edited meanwhile.`),
    before && h("p", { class: "muted" }, "Frames came or went while it ran."));
}

/** What a cell is called: its middle. @param {Object<string, any>} cell @param {number} wide */
export const placeOfCell = ({ column, row }, wide) => `${((column + 0.5) * wide).toFixed(2)}, ${((row + 0.5) * wide).toFixed(2)} m`;

/**
 * Where robots get lost, the worst first; each leads to its cell.
 * @param {Object<string, any>[]} cells @param {number} wide
 * @param {string | null} chosen @param {(cell: string) => void} onchoose
 */
export function worstCard(cells, wide, chosen, onchoose) {
  const worst = worstCells(cells);
  return h("section", { class: "card cover-card", "aria-labelledby": "cover-worst" },
    h("h2", { id: "cover-worst" }, "Worst areas"),
    worst.length === 0 ? h("p", { class: "muted" }, "Every queried frame was found where it was taken.")
      : h("ol", { class: "cover-worst" }, worst.slice(0, MOST_WORST).map((cell) => h("li", {},
        h("button", { type: "button", class: "cover-area", "aria-pressed": keyOf(cell) === chosen, id: `cell-${keyOf(cell)}`, onClick: () => onchoose(keyOf(cell)) },
          outcomeMark(worstOf(cell)), h("span", { class: "number" }, placeOfCell(cell, wide)),
          h("span", { class: "muted" }, `${tally(cell)} · ${things(cell.frames, "frame")} there`))))),
    worst.length > MOST_WORST && h("p", { class: "muted" }, `and ${count(worst.length - MOST_WORST)} more: see the table.`));
}

const worstOf = (cell) => ["wrong", "not_found", "ambiguous"].find((name) => cell[name] > 0) ?? "found";

/**
 * The frames of a cell that were queried: what became of each, and what it is mistaken for.
 * @param {{map: string, cell: Object<string, any> | null, key: string, wide: number, frames: Object<string, any>[], chosen: string | null,
 *   onchoose: (frame: string) => void, onoverlay: (frame: Object<string, any>, other: string) => void, onclose: () => void}} what
 */
export function areaCard({ map, cell, key, wide, frames, chosen, onchoose, onoverlay, onclose }) {
  const [column, row] = key.split(",").map(Number);
  const sorted = frames.toSorted((a, b) => rankOf(b) - rankOf(a) || a.number - b.number);
  const counts = cell ? `${things(cell.frames, "frame")} there, ${count(queriedIn(cell))} queried: ${tally(cell)}.` : "No frame was taken here.";
  const next = [...new Set(frames.map((one) => outcomeOf(one.outcome).next))].filter((text) => text !== null);
  return h("section", { class: "card cover-card cover-chosen-area", "aria-labelledby": "cover-area", tabindex: "-1" },
    h("div", { class: "cover-head" }, h("h2", { id: "cover-area" }, `Area at ${placeOfCell({ column, row }, wide)}`),
      h("button", { class: "button quiet", type: "button", "aria-label": "Close the area", onClick: onclose }, "×")),
    h("p", { class: "muted" }, counts),
    next.map((text) => h("p", { class: "cover-next" }, coded(text))),
    h("ul", { class: "cover-frames" }, sorted.slice(0, MOST_LISTED).map((one) => frameItem(map, one, chosen, onchoose, onoverlay))),
    sorted.length > MOST_LISTED && h("p", { class: "muted" }, `and ${count(sorted.length - MOST_LISTED)} more.`));
}

/** @param {Object<string, any>} frame */
const rankOf = ({ outcome }) => ["found", "unchecked", "ambiguous", "not_found", "wrong"].indexOf(outcome);

function frameItem(map, one, chosen, onchoose, onoverlay) {
  const { text } = outcomeOf(one.outcome), id = one.frame_id;
  const off = one.error_m !== null && one.outcome !== "not_found" ? ` Off by ${metres(one.error_m)}, ${degrees(one.error_deg)}.` : "";
  const toFrame = (frame) => h("a", { class: "mono", href: link("maps", map, "frames", frame), title: frame }, shortId(frame));
  return h("li", { dataset: { frame: id, chosen: chosen === id } },
    h("div", { class: "cover-head" }, h("span", {}, outcomeMark(one.outcome), h("strong", {}, text), " ", toFrame(id),
      one.session !== null && h("span", { class: "muted cover-session" }, ` ${one.session}`)),
    one.look_alikes.length > 0 && h("button", { class: "button quiet", type: "button", id: `links-${id}`, "aria-pressed": chosen === id, onClick: () => onchoose(id) }, "Show links")),
    h("p", { class: "cover-reason" }, coded(sentence(one.reason)), off),
    one.look_alikes.length > 0 && h("ul", { class: "cover-alike", "aria-label": "Look-alikes" }, one.look_alikes.map((other) => h("li", {},
      "Looks like ", toFrame(other), " ", h("button", { class: "button", type: "button", dataset: { overlay: other }, onClick: () => onoverlay(one, other) }, "Overlay")))),
    h("a", { class: "cover-again", href: link("maps", map, "query", { frame: id }) }, "Query with it"));
}

/** How cells changed. @param {Object<string, any>} changes of the API */
export function changesCard({ trends, result_before: a, result_after: b }) {
  const share = (result) => percent(result.found / Math.max(checkedIn(result), 1));
  return h("section", { class: "card cover-card", "aria-labelledby": "cover-changes" },
    h("h2", { id: "cover-changes" }, "Changes"),
    h("p", {}, "Found ", h("strong", { class: "number" }, share(a)), " before, ", h("strong", { class: "number" }, share(b)), " now."),
    h("ul", { class: "cover-counts" }, TRENDS.map(({ name, text, sign }) => h("li", { dataset: { trend: name } },
      h("span", { class: "cover-sign", dataset: { trend: name }, "aria-hidden": "true" }, sign), h("span", {}, text),
      h("strong", { class: "number" }, count(trends[name] ?? 0)), h("span", { class: "muted" }, (trends[name] ?? 0) === 1 ? "cell" : "cells")))));
}

/** All cells as a table. @param {Object<string, any>[]} cells @param {number} wide @param {(cell: string) => void} onchoose */
export function cellsTable(cells, wide, onchoose) {
  const outcomes = outcomesIn(...cells);
  const rows = cells.toSorted((a, b) => b.row - a.row || a.column - b.column).slice(0, 500).map((cell) => h("tr", {},
    h("th", { scope: "row" }, h("button", { class: "button quiet", type: "button", id: `row-${keyOf(cell)}`, onClick: () => onchoose(keyOf(cell)) }, placeOfCell(cell, wide))),
    h("td", { class: "number" }, count(cell.frames)), outcomes.map(({ name }) => h("td", { class: "number" }, count(cell[name])))));
  return h("div", { class: "cover-scroll", tabindex: "0", role: "region", "aria-label": "Cells of the plan" }, h("table", { class: "table" },
    h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Middle"), h("th", { scope: "col", class: "number" }, "Frames"),
      outcomes.map(({ text }) => h("th", { scope: "col", class: "number" }, text)))), h("tbody", {}, rows)),
  cells.length > 500 && h("p", { class: "muted" }, "The first 500 cells; the JSON file has all of them."));
}
