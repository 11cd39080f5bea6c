// Associations beside the picture: which one is drawn, what it came to, and how a new one is begun.

import { at, send } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { count, metres, degrees } from "../lib/format.js";
import { beginFrom, goesOn } from "../lib/products.js";
import { coded } from "../lib/prose.js";
import { confirm, sheet } from "../lib/states.js";
import { EDGES } from "./scene.js";

/** @param {Object<string, any>} edge of the API @returns {string} kind of EDGES */
export const kindOf = (edge) => (edge.consistent === null ? "unchecked" : edge.consistent ? "consistent" : "inconsistent");

/** Name of an association in a list. */
export function titleOf(one) {
  const sessions = one.request.sessions.map((name, i) => (one.request.robots?.[i] ? `${name} (${one.request.robots[i]})` : name));
  const what = sessions.length === 1 ? `${sessions[0]}, loops` : sessions.join(" – ");
  return one.state === "succeeded" ? `${what} · ${count(one.result.edges)} edges` : `${what} · ${one.state}`;
}

/**
 * @param {{associations: any[], chosen: any | null, edges: {edges: any[], more: boolean, drawn: number} | null,
 *   maywrite: boolean, onchoose: (id: string | null) => void, onbegin: () => void, onundo: () => void}} what
 */
export function associationsPanel({ associations, chosen, edges, maywrite, onchoose, onbegin, onundo }) {
  const select = h("select", { id: "paths-association", onChange: () => onchoose(select.value || null) },
    h("option", { value: "" }, associations.length ? "None" : "No associations yet"),
    associations.map((one) => h("option", { value: one.job_id, selected: one === chosen }, titleOf(one))));
  select.disabled = associations.length === 0;
  return h("section", { class: "card paths-section", "aria-labelledby": "paths-associations" },
    h("h2", { id: "paths-associations" }, "Associations"),
    h("label", { class: "field" }, h("span", {}, "Edges of"), select),
    chosen && told(chosen, edges),
    maywrite && chosen?.result?.joins.some((join) => join.root) && h("button", { class: "button", type: "button", id: "paths-undo", onClick: onundo }, "Undo join"),
    maywrite ? h("button", { class: "button", type: "button", id: "paths-begin", onClick: onbegin }, "New association…")
      : h("p", { class: "muted" }, "To start a new one, you need a key with write access."));
}

function told(one, edges) {
  if (goesOn(one)) return progress(one);
  if (one.state !== "succeeded") return h("p", { class: "paths-note" }, `It ${one.state === "cancelled" ? "was cancelled" : "failed"}. ${one.error ?? ""}`);
  const kinds = EDGES.map(({ kind }) => h("li", {},
    h("span", { class: "paths-line", dataset: { kind } }), h("span", {}, kind),
    h("span", { class: "number" }, count(one.result[kind]))));
  const joins = one.result.joins.map((join) => h("li", {},
    h("span", { class: "badge", dataset: { kind: join.transform === null || join.undone ? "warn" : join.strength === "strong" ? "good" : "neutral" } }, join.transform === null ? "not joined" : join.undone ? "undone" : `joined, ${join.strength}`),
    h("span", {}, h("span", { class: "mono" }, `${join.from_parent} → ${join.to_parent}`),
      h("span", { class: "muted" }, join.transform === null ? coded(` ${join.reason}`) : ` ${join.support} of ${join.votes} edges agree, within ${metres(join.spread_m)}, ${degrees(join.spread_deg)}${join.root ? `. All poses are in ${join.root} now` : ""}`))));
  return [
    h("ul", { class: "paths-kinds" }, kinds),
    edges && edges.drawn < one.result.edges && h("p", { class: "muted" },
      `${count(edges.drawn)} of ${count(one.result.edges)} are shown${edges.more ? "" : ": the others have an end that is not shown"}.`),
    joins.length > 0 && h("ul", { class: "paths-joins" }, joins),
  ];
}

function progress(one) {
  const { done = 0, total = null } = one.progress ?? {};
  const text = one.state === "queued" ? "Waiting for a worker" : total ? `${count(done)} of ${count(total)} frames queried` : "Starting";
  return h("div", { role: "status", class: "paths-progress" }, h("span", {}, text),
    h("progress", { max: total ?? 1, value: done, "aria-label": "Progress of the association" }));
}

/**
 * Ask which runs to associate, and begin it.
 * @param {string} map @param {import("./data.js").Run[]} runs @param {(begun: Object<string, any>) => void} onbegun
 */
export function begin(map, runs, onbegun) {
  const options = (first) => runs.map((one, i) => h("option", { value: i, selected: i === first }, one.robot === null || one.robot === one.session ? one.session : `${one.session} (${one.robot})`));
  const from = h("select", { name: "from" }, options(0));
  const to = h("select", { name: "to" }, h("option", { value: "" }, "itself (loop closures)"), options(1));
  const dialog = sheet({
    title: "New association",
    children: [
      h("p", { class: "muted" }, "Each frame of the first run is queried among the frames of the second; accepted matches become edges. This takes about 0.1 s per frame."),
      h("label", { class: "field" }, h("span", {}, "Query the frames of"), from),
      h("label", { class: "field" }, h("span", {}, "among the frames of"), to), h("p", { class: "field-error", role: "alert" }),
    ],
    buttons: h("button", { class: "button primary", type: "submit" }, "Start"),
  });
  beginFrom(dialog, at("maps", map, "associations"), () => {
    const chosen = [from, to].filter((one) => one.value !== "").map((one) => runs[Number(one.value)]);
    const robots = chosen.every((one) => one.robot !== null) ? chosen.map((one) => one.robot) : undefined;
    return { sessions: chosen.map((one) => one.session), robots };
  }, onbegun);
}

/**
 * Ask, and undo the join of an association.
 * @param {string} map @param {string} id @returns {Promise<boolean>} whether it was undone
 */
export async function undo(map, id) {
  const text = "Poses are again as they were sent, each in its own parent frame. The service does not join these frames again by itself.";
  if (!(await confirm({ title: "Undo this join?", text, action: "Undo join" }))) return false;
  await send("DELETE", at("maps", map, "associations", id, "join"));
  return true;
}
