// The picture as tables, for who does not see it.

import { h } from "../lib/dom.js";
import { count, metres, percent, shortId, time } from "../lib/format.js";
import { link } from "../lib/router.js";
import { wayOf } from "./card.js";

const MOST_ROWS = 100;

/** @param {(import("./data.js").Path & {over: any[]})[]} paths @param {string} parent of the picture */
export function runsTable(paths, parent) {
  const rows = paths.map((one, i) => h("tr", {},
    h("td", { class: "number" }, i + 1), h("th", { scope: "row" }, one.session), h("td", {}, one.robot ?? "–"),
    h("td", { class: "mono" }, one.parent), h("td", {}, one.parent === parent ? "its own" : "joined"),
    h("td", { class: "number" }, count(one.posed)), h("td", { class: "number" }, count(one.ids.length)),
    h("td", { class: "number" }, count(one.leftOut - (one.posed - one.ids.length))),
    h("td", { class: "number" }, one.isVirtual ? "–" : wayOf(one.poses)),
    h("td", {}, one.stamps === "captured" ? time(iso(one.times[0])) : "–")));
  return h("div", { class: "paths-scroll", tabindex: "0", role: "region", "aria-label": "Runs shown" }, h("table", { class: "table" },
    h("caption", { class: "visually-hidden" }, "Runs shown"),
    h("thead", {}, h("tr", {}, [["No.", 1], ["Run"], ["Robot"], ["Parent frame"], ["Joined by"], ["Poses", 1], ["Drawn", 1], ["Without", 1], ["Path length", 1], ["Started"]]
      .map(([name, number]) => h("th", { scope: "col", class: number && "number" }, name)))),
    h("tbody", {}, rows)));
}

/** @param {string} map @param {Object<string, any>[]} edges @param {boolean} more than these */
export function edgesTable(map, edges, more) {
  const rows = edges.slice(0, MOST_ROWS).map((one) => h("tr", {},
    ...["from", "to"].map((side) => h("td", {}, h("a", { class: "mono", href: link("maps", map, "frames", one[`${side}_frame`]) }, shortId(one[`${side}_frame`])),
      h("span", { class: "muted" }, ` ${one[`${side}_session`] ?? ""}`))),
    h("td", {}, one.consistent === null ? "unchecked" : one.consistent ? "consistent" : "inconsistent"),
    h("td", {}, one.strength), h("td", { class: "number" }, percent(one.overlap)),
    h("td", { class: "number" }, metres(one.residual_m))));
  const rest = edges.length > MOST_ROWS || more;
  return h("div", { class: "paths-scroll", tabindex: "0", role: "region", "aria-label": "Edges of the association" }, h("table", { class: "table" },
    h("caption", { class: "visually-hidden" }, "Edges of the association"),
    h("thead", {}, h("tr", {}, [["From"], ["To"], ["Nearby loops"], ["Strength"], ["Overlap", 1], ["Residual", 1]]
      .map(([name, number]) => h("th", { scope: "col", class: number && "number" }, name)))),
    h("tbody", {}, rows)), rest && h("p", { class: "muted" }, `The first ${count(rows.length)}; GET …/edges has all of them.`));
}

const iso = (seconds) => (seconds === undefined ? null : new Date(1000 * seconds).toISOString());
