// An answer by its id, as a robot or a colleague tells it: while it is stored.
import { at, get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { shortId, time } from "../lib/format.js";
import { link } from "../lib/router.js";
import { empty, soon } from "../lib/states.js";
import { backdrops } from "../plan/backdrop.js";
import { repeat } from "./asking.js";
import { pickFrame } from "./picker.js";
import { again, showAnswer } from "./result.js";
import { thumbs } from "./thumbs.js";
import { mapOf } from "./words.js";

export const styles = ["query/query.css", "query/alternatives.css", "plan/plan.css"];

/** @param {HTMLElement} root @param {Object<string, any>} context see main.js */
export async function render(root, { params, search, signal, go, title, actions, home }) {
  title(`Answer ${shortId(params.query)}`);
  const come = soon(root, "Loading the answer");
  let answer;
  let question;
  try {
    [answer, question] = await Promise.all([
      get(at("queries", params.query), { signal }), get(`${at("queries", params.query)}/question`, { signal })]);
  } catch (error) {
    come();
    if (error.status !== 404) throw error;
    put(root, notKept());
    return;
  }
  come();
  home(mapOf(answer));
  const other = again(answer, "Query with other options");
  other.className = "button primary";
  actions(other);
  const pictures = thumbs(signal), seen = { why: search.has("why"), match: search.get("match") };
  const body = h("div", { class: "query-answer" });
  put(root, h("div", { class: "query-page is-answer" }, asked(question), body));
  await showAnswer(body, answer, {
    signal, pictures, backdrops: backdrops(signal), isOwnPage: true, seen,
    onseen: ({ why, match }) => go(link("queries", params.query, { why: why ? "open" : null, match }), { replace: true, quiet: true }),
    ask: async (frame) => (await repeat(answer.query_id, answer.maps, { ...question.options, explain_frame: frame, explain: null, keep: false, record: false }, signal)).explained_frame,
    pick: answer.maps.length === 1 ? () => pickFrame(answer.maps[0], { pictures, signal, title: "Why not this frame?" }) : undefined,
  });
}

function asked(question) {
  const { options } = question;
  const said = Object.entries(options).filter(([name]) => !["explain", "explain_frame", "keep", "record"].includes(name));
  const who = [question.robot && `robot ${question.robot}`, question.session && `session ${question.session}`].filter(Boolean);
  return h("p", { class: "muted query-note" },
    "Asked ", time(question.at), " of ", question.maps.map((name, i) => [i > 0 && ", ", h("a", { href: link("maps", name) }, name)]),
    question.frame ? [" with frame ", h("a", { class: "mono", href: link("maps", question.frame.map, "frames", question.frame.frame_id) }, shortId(question.frame.frame_id))]
      : ` with an uploaded ${question.kind === "cloud" ? "cloud" : "depth image"}`,
    who.length > 0 && ` of ${who.join(", ")}`, ". ",
    said.length ? ["Options: ", h("span", { class: "mono" }, said.map(([name, value]) => `${name} ${typeof value === "object" ? JSON.stringify(value) : value}`).join(", ")), "."]
      : "Default options.");
}

function notKept() {
  return empty({
    title: "This answer has expired",
    text: "Answers expire after some weeks, or earlier if space runs out. The id may also be wrong, or your key may not see it. Send the frame again from the page of its map.",
    actions: h("a", { class: "button", href: "#/" }, "All maps"),
  });
}
