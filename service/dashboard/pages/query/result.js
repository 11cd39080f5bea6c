// An answer as it is shown: the verdict, plan and overlay, and folded below why it is so.
import { at, get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { count, degrees, frameLabel, metres, percent, shortId, things } from "../lib/format.js";
import { heatmap } from "../lib/heatmap.js";
import { coded } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { failed, loading } from "../lib/states.js";
import { choice } from "./choice.js";
import { funnel } from "./funnel.js";
import { overlayInset } from "./inset.js";
import { placesPanel } from "./places.js";
import { posePlan } from "./poseplan.js";
import { keepPanel } from "./keep.js";
import { reconstructionPanel } from "./reconstruction.js";
import { rows } from "./rows.js";
import { whyNot } from "./whynot.js";
import { deviation, differences, keyOf, mapOf, number, verdict } from "./words.js";

/** Frames of the ranking that are compared with each other at first, and at most. */
const FIRST = 50;
const MOST = 200;
const SHAPES = { found: "✓", ambiguous: "≈", not_found: "✕", unvalidated: "?" };

/** @typedef {{why: boolean, match: string | null}} Seen what of an answer is looked at: whether the reasons are unfolded, and the match that is laid on it. */

const shown = new WeakMap(); // element -> what ends the answer in it: a canvas of 3-D is not left to itself

/**
 * Show an answer in an element: the verdict, then where that is and what it was matched with, then why.
 * @param {Element} root @param {Object<string, any>} answer
 * @param {{signal: AbortSignal, turn?: AbortSignal, isOwnPage?: boolean, pictures: any, backdrops: any, ask: (frame: string) => Promise<any>,
 *   chosen?: string | null, before?: Object<string, any> | null, change?: (said: any) => void, pick?: () => Promise<string | null>,
 *   seen?: Seen, onseen?: (seen: Seen) => void}} how
 *   turn: aborted when a later answer is to be shown in its place; ask: again, explaining a frame; before: the answer that this one replaces; chosen: the frame that was
 *   marked in it; change, pick: see `whyNot`; seen: changed in place, and told of by onseen
 * @returns {Promise<{choice: any}>}
 */
export async function showAnswer(root, answer, how) {
  const { pictures, before = null, chosen = null, isOwnPage = false, seen = { why: false, match: null }, onseen = () => {} } = how;
  shown.get(root)?.abort();
  const own = new AbortController();
  shown.set(root, own);
  const signal = AbortSignal.any([own.signal, how.signal]);
  const looked = choice();
  const plan = posePlan(answer, { backdrops: how.backdrops, choice: looked, signal });
  const inset = overlayInset(answer, { pictures, choice: looked, signal, wanted: seen.match, onshow: (key) => { seen.match = key; onseen(seen); } });
  const why = reasons(answer, { ...how, seen, onseen, signal }, looked);
  put(root, lead(answer, before, isOwnPage), keepPanel(answer, signal), h("div", { class: "query-views" }, plan, inset),
    placesPanel(answer, { backdrops: how.backdrops, pictures, signal }),
    reconstructionPanel(answer, signal), why);
  if (chosen !== null) looked.choose(chosen);
  await why.ready;
  return { choice: looked };
}

/** The rows of the paper, the funnel, the heat map and "why not?", folded until somebody wants to know. */
function reasons(answer, how, looked) {
  const { counts, explained_frame: explained } = answer;
  const body = h("div", { class: "query-why-body" });
  let isFilled = false;
  const fill = async () => {
    if (isFilled) return;
    isFilled = true;
    await fillReasons(body, answer, how, looked);
  };
  const isOpen = how.seen.why || explained !== null;
  const fold = h("details", { class: "query-reasons", open: isOpen, onToggle: () => {
    if (fold.open) fill().catch((error) => { if (error.name !== "AbortError") throw error; });
    if (fold.open === how.seen.why) return;
    how.seen.why = fold.open;
    how.onseen(how.seen);
  } }, h("summary", {}, h("h2", {}, "Why this answer"),
    h("span", { class: "muted number" }, `${count(counts.compared)} compared, ${count(counts.ranked)} ranked, ${count(counts.selected)} selected, ${count(counts.validated)} validated, ${count(counts.accepted)} accepted`)), body);
  return Object.assign(fold, { ready: isOpen ? fill() : Promise.resolve() });
}

async function fillReasons(root, answer, { signal, turn = signal, pictures, before = null, ask, change, pick }, looked) {
  // the rows wait for it only where nothing else tells the ranking
  const alike = answer.explanations === null && answer.counts.ranked > 0 ? await similarities(answer, FIRST, turn).catch(passed) : null;
  const ranked = answer.explanations === null ? fromSimilarities(answer, alike) : { ranking: answer.explanations, told: true };
  const steps = funnel(answer);
  const map = h("section", { class: "card query-heat", "aria-label": "Similarity of the ranking" });
  put(root,
    answer.explanations === null && h("p", { class: "muted query-note" },
      "This query ran without explanations. Query again to see the distances of frames that were not selected, and why. ",
      again(answer)),
    rows(answer, ranked, { pictures, choice: looked, before }),
    whyNot(answer, { ask, choice: looked, funnel: steps, change, pick }),
    h("div", { class: "query-below" }, steps, map));
  heat(map, answer, { alike, ranked }, looked, turn);
}

/** To where it is asked again with other options. */
export function again(answer, text = "Query again") {
  return h("a", { href: link("maps", answer.maps[0], "query", { query: answer.query_id }) }, text);
}

function lead(answer, before, isOwnPage) {
  const changed = before && differences(before, answer);
  const { kind, title, cause, text, next, details } = verdict(answer);
  const pose = answer.location, several = answer.alternatives;
  return h("section", { class: "card query-verdict", dataset: { kind, status: answer.status }, "aria-label": "Verdict" },
    h("span", { class: "query-verdict-shape", "aria-hidden": "true" }, SHAPES[answer.status]),
    h("div", { class: "query-verdict-text" },
      h("p", {}, h("strong", {}, `${title}. `), cause && h("span", { class: "badge", dataset: { kind } }, cause), cause && " ", coded(text)),
      next && h("p", { class: "query-next" }, coded(next)),
      details.length > 0 && h("ul", { class: "query-verdict-details" }, details.map((one) => h("li", {}, coded(one)))),
      changed !== null && h("p", { class: "query-changed" }, h("span", { class: "muted" }, "Compared with the previous answer: "),
        changed.length ? changed.join("; ") : "nothing changed"),
      pose && poseOf(pose, answer.kind)),
    h("div", { class: "query-verdict-links" },
      (answer.status === "ambiguous" || answer.status === "not_found") && h("a", { class: "button", href: link("maps", mapOf(answer), "coverage") }, "Coverage of the map"),
      (pose || several.length > 0) && h("a", { class: "button", href: link("maps", mapOf(answer), "place", { query: answer.query_id }) }, "On the map"),
      !isOwnPage && h("a", { class: "button", href: link("queries", answer.query_id), title: "Can be shared while it is stored" }, `Answer ${shortId(answer.query_id)}`)));
}

function poseOf(location, kind) {
  const { translation: t, rotation: q, matrix, parent_frame: parent } = location.pose;
  const ahead = kind === "depth" && matrix.slice(0, 3).map((row) => number(row[2])).join(", ");
  const sure = deviation(location.uncertainty?.covariance);
  const free = location.uncertainty?.degenerate ?? [];
  return h("details", { class: "query-pose" }, h("summary", {}, "Full pose"),
    h("dl", { class: "query-facts" }, [
      ["Translation, m", [t.x, t.y, t.z].map((x) => x.toFixed(4)).join(", ")],
      ["Rotation x, y, z, w", [q.x, q.y, q.z, q.w].map((x) => x.toFixed(5)).join(", ")],
      ahead && ["Viewing direction", ahead],
      ["In the frame", parent], ["Of", location.pose.child_frame],
      sure && ["One standard deviation", `${metres(sure.m)}, ${degrees(sure.deg)} (worst axis)`],
      free.length > 0 && ["Poorly constrained", things(free.length, "direction")],
    ].filter(Boolean).map(([term, value]) => h("div", {}, h("dt", {}, term), h("dd", { class: "number" }, value)))));
}

async function similarities(answer, limit, signal) {
  return get(`${at("queries", answer.query_id)}/similarities`, { params: { limit }, signal });
}

// where they cannot be told any more, what is known is shown, and the heat map says why
function passed(error) {
  if (error.name === "AbortError" || error.status === 401) throw error;
  return null;
}

// without explanations the ranking is known by how alike each frame is to the query
function fromSimilarities(answer, alike) {
  if (alike === null || alike.frames.length === 0) return { ranking: answer.matches.toSorted((a, b) => a.rank - b.rank), told: true };
  const known = new Map(answer.matches.map((one) => [keyOf(one), one]));
  const taken = new Set(answer.matches.map((one) => one.rank));
  let last = 0;
  // frames deleted since are left out: the rank of a match is not another's
  const next = () => { do { last += 1; } while (taken.has(last)); return last; };
  const frames = alike.frames.map((one, i) => {
    const match = known.get(keyOf(one));
    if (match) last = match.rank; else next();
    return { ...one, name: alike.names[i], rank: last, similarity: alike.similarity[0][i + 1], ...match };
  });
  return { ranking: frames, told: frames.every((one) => one.distance !== undefined) };
}

function heat(root, answer, { alike, ranked }, looked, turn) {
  if (answer.counts.ranked === 0) { root.hidden = true; return; }
  const ranks = new Map(ranked.ranking.map((one) => [keyOf(one), one.rank]));
  const isSelected = new Set(answer.matches.filter((one) => one.selected).map(keyOf));
  const limits = [10, 20, FIRST, 100, MOST].filter((n, i, all) => n < answer.counts.ranked || all[i - 1] < answer.counts.ranked || i === 0);
  const field = h("select", { id: "heat-limit", onchange: () => load(Number(field.value)) }, limits.map((n) => h("option", { value: n, selected: n === FIRST }, n >= answer.counts.ranked ? `all ${answer.counts.ranked}` : `first ${n}`)));
  if (![...field.options].some((one) => one.selected && Number(one.value) === FIRST)) field.value = String(limits.at(-1));
  const body = h("div");
  /** @type {{point: (row: number | null) => void} | null} */
  let shown = null;
  let keys = [];
  let asked = 0; // the last that was asked for is the one to be shown
  looked.hear((key) => shown?.point(key === null || !keys.includes(key) ? null : keys.indexOf(key) + 1));

  async function load(limit) {
    const own = ++asked;
    put(body, loading("Comparing"));
    try {
      const found = await similarities(answer, limit, turn);
      if (own === asked) draw(found);
    } catch (error) {
      if (error.status === 401) throw error;
      if (own === asked && error.name !== "AbortError") put(body, failed(error, () => load(limit)));
    }
  }

  function draw({ frames, names, similarity }) {
    if (frames.length === 0) {
      put(body, h("p", { class: "muted" }, "No ranked frame is left to compare: the frames were deleted, or the map changed its model."));
      return;
    }
    keys = frames.map(keyOf);
    const marked = new Set(keys.flatMap((key, i) => (isSelected.has(key) ? [i + 1] : [])));
    const rank = (i) => ranks.get(keys[i]) ?? i + 1; // frames deleted since are left out
    shown = heatmap({
      values: similarity, marked,
      names: ["the query", ...frames.map((one, i) => `${rank(i)}: frame ${frameLabel({ ...one, name: names[i] })}${marked.has(i + 1) ? ", selected" : ""}`)],
      ticks: ["Q", ...frames.map((_, i) => String(rank(i)))],
      label: gist(similarity), format: percent, size: Math.max(240, Math.min(560, body.clientWidth)),
      onmove: (cell) => looked.point(cell === null ? null : keys[Math.max(...cell) - 1] ?? null),
    });
    put(body, shown);
  }

  put(root, h("div", { class: "toolbar query-heat-head" }, h("h3", {}, "Pairwise similarity"),
    h("label", { for: "heat-limit" }, h("span", { class: "muted" }, "Of the ranking "), field)),
  h("p", { class: "muted" }, "The query first, then its ranking, nearest first. ",
    isSelected.size > 0 ? "Bars beside the numbers mark the diverse selection, which avoids bright cells." : ""), body);
  if (alike !== null) draw(alike); else load(FIRST);
}

function gist(similarity) {
  const n = similarity.length;
  /** @type {[number, number] | null} */
  let pair = null;
  for (let i = 1; i < n; i += 1) for (let j = 1; j < i; j += 1) if (pair === null || similarity[i][j] > similarity[pair[0]][pair[1]]) pair = [j, i];
  const [, ...own] = similarity[0];
  const alike = pair === null ? "" : ` The two most alike are ${pair[0]} and ${pair[1]}, ${percent(similarity[pair[0]][pair[1]])}.`;
  return `Similarity of the query and ${own.length} frames of its ranking: to the query from ${percent(Math.max(...own))} down to ${percent(Math.min(...own))}.${alike}`;
}
