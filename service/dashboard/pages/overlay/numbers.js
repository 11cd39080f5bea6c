// Beside the view: the verdict, what it was reached from, and how far it can be trusted.
import { h } from "../lib/dom.js";
import { count, degrees, frameLabel, metres, percent, shortId, things } from "../lib/format.js";
import { coded, sentence } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { voteOf } from "../query/alternatives.js";
import { statusOf } from "../query/words.js";
import { apart, axisName, deviations, freedom, isOptical, shiftOf, turnOf } from "./words.js";

const MEANT = {
  accepted: "Both directions agree on this transform, and the surfaces of both frames support it.",
  ambiguous: "It fits, but another pose fits as well or a direction is unconstrained: not counted as found.",
  rejected: "This is the best transform, but it is not reliable.",
};

/** Degrees that are next to none. */
const fine = (x) => (x < 1 ? `${x.toFixed(2)}°` : degrees(x));

/** @param {string} title @param {...any} children */
const card = (title, ...children) => h("section", { class: "card overlay-card" }, h("h2", {}, title), children);

/**
 * What came of it, in a word and a sentence, and which pose it speaks for.
 * @param {Object<string, any>} answer @param {Object<string, any>} details
 */
export function verdictCard(answer, details) {
  const { validation } = details, { kind, text } = statusOf(validation);
  const match = answer.matches.find((one) => one.frame_id === details.frame_id && one.map === details.map);
  const vote = match ? voteOf(answer, match) : null;
  const note = details.transform ? MEANT[validation.status] : "No transform was found.";
  return card("Verdict",
    h("p", {}, h("span", { class: "badge overlay-verdict", dataset: { kind } }, text)),
    h("p", { class: "overlay-reason" }, coded(sentence(validation.reason))),
    note && h("p", { class: "muted" }, note),
    vote && h("p", { class: "overlay-note" }, `The match speaks ${vote}${answer.status === "ambiguous" ? ": the answer is ambiguous" : " than the answer’s"}.`));
}

/** What the verdict was reached from. */
export function evidenceCard(details) {
  const v = details.validation, sampled = (details.query?.sampled ?? 0) + (details.match?.sampled ?? 0);
  const residual = v.residual ? `${metres(v.residual.translation_m)}, ${fine(v.residual.rotation_deg)}` : "–";
  const rows = [
    ["Overlap", percent(v.overlap), "of the points of both frames agree"],
    ["Plane overlap", percent(v.plane_overlap), "the same, with equal weight for every plane"],
    ["Inliers", sampled ? `${count(v.inliers)} of ${count(sampled)}` : count(v.inliers), "points on the surface of the other frame"],
    ["Violations", v.free_space_violations === null ? "–" : percent(v.free_space_violations),
      v.free_space_violations === null ? "free space is unknown without a viewpoint" : "of these and the inliers: the other sensor saw through them"],
    ["Residual", residual, "query to match and back, each refined alone"],
    v.search === "guided" ? ["Ambiguity", "–", "rivals are not searched: the map’s frames decide"] : v.ambiguity === 0 && v.status !== "accepted" ? ["Ambiguity", "–", "rivals are searched only if everything else agrees"]
      : ["Ambiguity", percent(v.ambiguity), "of both frames is explained by the best rival"],
    ["Found by", { plans: "plans", correspondences: "patches", guided: "other matches" }[v.search] ?? "–",
      v.search === "guided" ? "and the map’s poses, then refined and checked: no vote of its own" : v.directions?.length === 1 ? "in one direction only" : "in both directions"],
    ["Patches", details.patches ? count(details.patches.query.length) : "–", "pairs coincide"],
  ];
  if (!details.transform) return card("Evidence", h("p", { class: "muted" }, "There is no evidence without a transform."));
  return card("Evidence", h("dl", { class: "overlay-numbers" }, rows.map(([name, value, note]) => h("div", {},
    h("dt", {}, name), h("dd", { class: "number" }, value), h("dd", { class: "overlay-note" }, note)))));
}

/** Query to match. */
export function transformCard(details) {
  const { transform } = details;
  if (!transform) return null;
  const optical = isOptical(transform.parent_frame), { x, y, z } = transform.translation;
  return card("Transform",
    h("p", { class: "muted" }, "The query moves ", h("strong", {}, metres(shiftOf(transform.translation))), " and turns ",
      h("strong", {}, degrees(turnOf(transform.matrix))), ", in the match’s axes:"),
    axes(optical, [["Shift", [x, y, z].map(metres)]]),
    h("details", {}, h("summary", {}, "Matrix"),
      h("p", { class: "muted overlay-frames" }, h("span", { class: "mono" }, short(transform.parent_frame)), " ← ",
        h("span", { class: "mono" }, short(transform.child_frame))),
      h("pre", { class: "mono overlay-matrix", tabindex: 0, "aria-label": "4 by 4 matrix, row by row" },
        transform.matrix.map((row) => row.map((v) => v.toFixed(4).padStart(9)).join("")).join("\n"))));
}

const short = (name) => {
  const dot = name.lastIndexOf(".");
  return dot > 0 ? `${shortId(name.slice(0, dot))}${name.slice(dot)}` : name;
};

function axes(optical, rows) {
  return h("table", { class: "table overlay-axes" },
    h("thead", {}, h("tr", {}, h("td", {}), [0, 1, 2].map((k) => h("th", { scope: "col", class: "number" }, axisName(k, optical))))),
    h("tbody", {}, rows.map(([name, values]) => h("tr", {}, h("th", { scope: "row" }, name),
      values.map((value) => h("td", { class: "number" }, value))))));
}

/** How far off it may be. */
export function uncertaintyCard(details) {
  const { uncertainty, transform } = details;
  if (!uncertainty || !transform) {
    return card("Uncertainty", h("p", { class: "muted" }, "Available only for accepted matches."));
  }
  const optical = isOptical(transform.parent_frame), sigma = deviations(uncertainty.covariance);
  const free = uncertainty.degenerate;
  return card("Uncertainty",
    h("p", { class: "muted" }, "One standard deviation, along the match’s axes."),
    axes(optical, [["Shift", sigma.slice(0, 3).map((s) => `± ${metres(s)}`)],
      ["Turn", sigma.slice(3).map((s) => `± ${fine((s * 180) / Math.PI)}`)]]),
    free.length
      ? h("div", {}, h("p", {}, h("span", { class: "badge", dataset: { kind: "warn" } }, things(free.length, "free direction"))),
        h("ul", { class: "overlay-free" }, free.map((one) => h("li", {}, freedom(one, optical)))))
      : h("p", { class: "muted" }, "All six directions are constrained."));
}

/**
 * Another pose that explains the frames.
 * @param {Object<string, Object<string, any>>} tallies of `tally`, by pose; the rival's may be missing yet
 */
export function rivalCard(details, tallies) {
  const { rival, transform, validation } = details;
  if (!rival) return null;
  const away = transform && apart(rival, transform);
  const share = (pose, name) => (tallies[pose] ? percent(tallies[pose][name] / Math.max(tallies[pose].total, 1)) : "…");
  const rows = [["On the surface of the other", "agree"], ["Violations", "violations"]];
  return card("Rival pose",
    h("p", {}, "Another pose explains ", h("strong", {}, percent(validation.ambiguity)), " of both frames, with equal weight for every plane",
      away && [", ", h("strong", {}, metres(away.metres)), " and ", h("strong", {}, degrees(away.degrees)), " from the pose that was found"], "."),
    h("table", { class: "table" },
      h("thead", {}, h("tr", {}, h("td", {}, "Share of all points"), h("th", { scope: "col", class: "number" }, "Found"), h("th", { scope: "col", class: "number" }, "Rival"))),
      h("tbody", {}, rows.map(([name, key]) => h("tr", {}, h("th", { scope: "row" }, name),
        h("td", { class: "number" }, share("aligned", key)), h("td", { class: "number" }, share("rival", key)))))));
}

/** Who was compared. @param {Object<string, any> | null} frame */
export function framesCard(answer, details, frame, query) {
  const asked = answer.frame;
  const row = (side, name, href, note) => h("li", { dataset: { side } },
    h("span", { class: "overlay-swatch", "aria-hidden": "true" }), h("span", {}, h("strong", {}, side === "query" ? "Query" : "Match"), " ",
      href ? h("a", { class: "mono", href }, name) : name, note && h("span", { class: "overlay-note" }, note)));
  const told = (one) => [one?.session && `session ${one.session}`, one?.robot && `robot ${one.robot}`].filter(Boolean).join(", ");
  return card("Frames", h("ul", { class: "overlay-who" },
    row("query", asked ? shortId(asked.frame_id) : "an upload, not stored in a map",
      asked && link("maps", asked.map, "frames", asked.frame_id), asked && [`map ${asked.map}`, told(query)].filter(Boolean).join(", ")),
    row("match", frameLabel(details), link("maps", details.map, "frames", details.frame_id),
      [`map ${details.map}`, told(frame)].filter(Boolean).join(", "))));
}
