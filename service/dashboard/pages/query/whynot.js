// "Why not this frame?": asks again with `explain_frame`, and says where the frame was lost.
import { h, put } from "../lib/dom.js";
import { count, frameLabel, frameTitle, percent, shortId } from "../lib/format.js";
import { coded, sentence } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { failed, loading } from "../lib/states.js";
import { figures } from "./words.js";

/** What each place of loss means, and what would bring the frame further. */
const LOST = {
  state: ["It is not searched", "Only indexed frames can be found.", null],
  query: ["It is the query itself", "A frame does not find itself.", null],
  filter: ["Lost at the filter", "Only frames that pass the filter are searched.", () => [{ session: null, not_within_s: null }, "Query without the filter"]],
  shortlist: ["Lost at the index", "The search did not compare the frame.", () => [{ exact: true }, "Compare every frame"]],
  ranking: ["Lost in the ranking", "Other signatures are nearer.", null],
  selection: ["Lost in the selection", "Other ranked frames were selected as candidates.",
    (answer) => [{ candidates: Math.min(200, Math.max(2 * answer.counts.selected, answer.counts.ranked)) }, "Query with the whole ranking as candidates"]],
  turn: ["Others come before it", "Enough matches were accepted before it.", (answer) => [{ k: Math.min(50, answer.counts.accepted + 5) }, "Query for more matches"]],
  deadline: ["Lost to the deadline", "The deadline passed before it was tried.", () => [{ deadline_ms: null }, "Query without a deadline"]],
  validation: ["Lost at validation", "It does not fit the query.", null],
};

/**
 * @param {Object<string, any>} answer
 * @param {{ask: (frame: string) => Promise<any>, choice: any, funnel: any, change?: (said: any) => void,
 *   pick?: () => Promise<string | null>}} how ask: again, with that frame explained; change: other options,
 *   where there are controls; pick: lets a frame of the map be picked
 */
export function whyNot(answer, { ask, choice, funnel, change, pick }) {
  const typed = h("input", { type: "text", id: "why-frame", class: "mono", autocomplete: "off", spellcheck: "false", required: true, list: "why-known" });
  const result = h("div", { class: "query-why-result", role: "status" });
  const known = [...(answer.explanations ?? answer.matches)].map((one) => one.frame_id);
  const marked = h("button", { type: "button", class: "button", hidden: true, onclick: () => {
    typed.value = choice.chosen.slice(choice.chosen.indexOf("/") + 1);
    run();
  } });
  choice.hear((_, chosen) => {
    marked.hidden = chosen === null;
    put(marked, chosen && `Why not ${shortId(chosen.slice(chosen.indexOf("/") + 1))}, the marked one?`);
  });
  let turn = 0; // a later question is the one to be answered
  const tell = (told) => {
    funnel.lose(told.lost_at);
    put(result, explained(told, answer, change));
  };
  if (answer.explained_frame !== null) {
    typed.value = answer.explained_frame.frame_id;
    tell(answer.explained_frame);
  }

  async function run() {
    const id = typed.value.trim();
    if (!id) return;
    const own = ++turn;
    put(result, loading("Querying again"));
    try {
      const told = await ask(id);
      if (own !== turn) return;
      tell(told);
    } catch (error) {
      if (own !== turn || error.name === "AbortError") return;
      if (error.status === 401) throw error;
      funnel.lose(undefined);
      put(result, failed(error, run));
    }
  }

  return h("section", { class: "card query-why", "aria-label": "Why not this frame?" },
    h("h3", {}, "Why not this frame?"),
    h("p", { class: "muted" }, "Choose any frame of the map. It is compared exactly and aligned with the query."),
    h("form", { class: "toolbar", onsubmit: (event) => { event.preventDefault(); run(); } },
      h("label", { class: "field query-why-field", for: "why-frame" }, h("span", {}, "Frame id"), typed),
      h("datalist", { id: "why-known" }, known.map((value) => h("option", { value }))),
      h("button", { class: "button primary" }, "Why not?"),
      pick && h("button", { type: "button", class: "button", onclick: async () => {
        const id = await pick();
        if (id !== null) { typed.value = id; run(); }
      } }, "Pick a frame…"),
      marked),
    result);
}

function explained(told, answer, change) {
  const [title, text, remedy] = told.lost_at === null ? ["It is a match", "It passed every stage.", null] : LOST[told.lost_at] ?? [told.lost_at, "", null];
  const kind = told.lost_at === null ? "good" : "bad";
  const [said, offer] = remedy?.(answer) ?? [];
  const yes = (value) => (value === null ? "not checked" : value ? "yes" : "no");
  const facts = [
    ["State", told.state], ["Passes the filter", yes(told.passes_filter)],
    ["Exact rank", told.rank === null ? "–" : `${count(told.rank)} of ${count(told.of)}`],
    ["Distance", count(told.distance)], ["Similarity", percent(told.similarity)],
    ["Compared by the search", yes(told.shortlisted)], ["Ranked", yes(told.ranked)], ["A candidate", yes(told.selected)],
    ...(told.validation ? [["Aligned with the query", told.validation.status], ...figures(told.validation)] : []),
  ];
  return [
    h("div", { class: "query-why-head", dataset: { lost: told.lost_at ?? "none" } },
      h("span", { class: "badge", dataset: { kind } }, title),
      h("a", { class: "mono", href: link("maps", told.map, "frames", told.frame_id), title: frameTitle(told) }, frameLabel(told)),
      h("span", { class: "muted" }, `of map ${told.map}`)),
    h("p", {}, sentence(told.reason).startsWith(text.replace(/\.$/, "")) ? null : `${text} `, coded(sentence(told.reason))),
    change && offer && h("button", { type: "button", class: "button", onclick: () => change(said) }, offer),
    h("dl", { class: "query-facts" }, facts.map(([term, value]) => h("div", {}, h("dt", {}, term), h("dd", { class: "number" }, value)))),
  ];
}
