// How many frames each stage left, and how long it took: from the map to the accepted ones.
import { h } from "../lib/dom.js";
import { count, ms } from "../lib/format.js";

/** What each stage lets pass, and why the others stay behind. */
const STEPS = [
  ["map", "in the map", ""],
  ["passed", "pass the filter", "do not pass the filter"],
  ["compared", "compared", "were not compared"],
  ["ranked", "ranked", "are farther away"],
  ["selected", "selected", "resemble selected frames, or others were selected first"],
  ["validated", "validated", "were not tried"],
  ["accepted", "accepted", "failed validation"],
];
/** Why a stage let nothing pass, where it was left out. */
const OUT = { selected: "diversification was not requested", validated: "validation was not requested, or the deadline passed", accepted: "nothing was validated" };
/** At which step a frame is lost, by `lost_at`. */
export const LOST_AT = {
  query: "map", state: "map", filter: "passed", shortlist: "compared", ranking: "ranked", selection: "selected",
  turn: "validated", deadline: "validated", validation: "accepted",
};
const STAGES = [["prepare", "Prepare"], ["retrieve", "Retrieve"], ["diversify", "Diversify"], ["validate", "Validate"], ["locate", "Compare poses"], ["earlier", "Earlier frames"], ["explain", "Explain"]];

/**
 * The counts of an answer as steps.
 * @returns {HTMLElement & {lose: (at: string | null | undefined) => void}} lose: mark where a frame
 *   was lost; null where it was not, undefined for no frame
 */
export function funnel(answer) {
  const { counts } = answer;
  const most = Math.log1p(counts.map);
  const isWithout = (name) => (name === "selected" && counts.selected === 0 && counts.ranked > 0)
    || (name === "validated" && answer.status === "unvalidated" && counts.validated === 0)
    || (name === "accepted" && counts.validated === 0);
  /** @type {any} */
  let before = null;
  const steps = STEPS.map(([name, text, loss]) => {
    const n = counts[name];
    const isLeftOut = isWithout(name);
    const lost = before === null || isLeftOut ? 0 : before - n;
    if (!isLeftOut) before = n;
    const share = most > 0 ? Math.log1p(n) / most : 0;
    return h("li", { class: "query-step", dataset: { step: name, out: isLeftOut } },
      h("span", { class: "query-step-count number" }, isLeftOut && name !== "accepted" ? "–" : count(n)),
      h("span", { class: "query-step-name" }, text),
      h("span", { class: "query-step-bar", "aria-hidden": "true" }, h("span", { style: { width: `${(100 * (isLeftOut ? 0 : share)).toFixed(1)}%` } })),
      h("small", { class: "muted" }, isLeftOut ? OUT[name] : lost > 0 && `${count(lost)} ${wording(loss, lost)}`),
      h("strong", { class: "query-step-lost" }));
  });
  const element = h("section", { class: "card query-funnel", "aria-label": "Frames by stage" },
    h("h3", {}, "From the map to the match"),
    h("ol", { class: "query-steps" }, steps),
    h("small", { class: "muted" }, "Bars are logarithmic."),
    times(answer.milliseconds));
  return Object.assign(element, {
    lose(at) {
      const where = at === undefined ? null : at === null ? "accepted" : LOST_AT[at];
      for (const step of steps) {
        const isHere = step.dataset.step === where;
        step.dataset.lost = isHere ? (at === null ? "not" : "here") : "";
        /** @type {Element} */ (step.lastElementChild).textContent = isHere ? (at === null ? "passed" : "lost here") : "";
      }
    },
  });
}

function wording(loss, n) {
  return n === 1 ? loss.replace(/^are /, "is ").replace(/^were /, "was ").replace(/^do /, "does ") : loss;
}

/** Milliseconds by stage, as one bar. */
function times(spent) {
  const known = STAGES.filter(([name]) => spent[name] !== undefined);
  const total = known.reduce((sum, [name]) => sum + spent[name], 0) || 1;
  return h("div", { class: "query-times" },
    h("h4", {}, "Time ", h("span", { class: "number" }, ms(spent.total))),
    h("div", { class: "query-times-bar", "aria-hidden": "true" }, known.map(([name]) => h("span", {
      dataset: { stage: name }, title: `${name} ${ms(spent[name])}`, style: { flexGrow: (spent[name] / total).toFixed(4) } }))),
    h("dl", { class: "query-times-list" }, known.map(([name, text]) => h("div", { dataset: { stage: name } },
      h("dt", {}, text), h("dd", { class: "number" }, ms(spent[name]))))));
}
