// Sessions of a map: who took what in which run, and when; renamed, tagged and deleted as a whole,
// and deletions undone.
import { recentDeletions } from "../frames/changes.js";
import { at, get, watch } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { count, seconds, things } from "../lib/format.js";
import { link } from "../lib/router.js";
import { may } from "../lib/session.js";
import { empty } from "../lib/states.js";
import { rows } from "../operations/poll.js";

export const styles = ["sessions/sessions.css"];

const PAGE = 100;
const SOON_MS = 1000; // events come in bursts, and all frames of the map are counted for a look
const AGAIN_MS = 5000;
const COLUMNS = [["Session"], ["Robot"], ["Frames", 1], ["With pose", 1], ["Captured (UTC)"], ["Duration", 1], ["Tags"]];

/** The page: #/maps/NAME/sessions; see lib/router.js. */
export async function render(root, { params, signal, actions }) {
  const path = at("maps", params.map);
  const canWrite = may("write", params.map);
  const body = h("tbody", {});
  const card = h("div", { class: "card sessions-scroll", tabindex: "0", role: "region", "aria-label": "Sessions" }, h("table", { class: "table stack" },
    h("thead", {}, h("tr", {}, COLUMNS.map(([text, number]) => h("th", { scope: "col", class: number && "number" }, text)),
      h("th", { scope: "col" }, h("span", { class: "visually-hidden" }, "Actions")))), body));
  const summary = h("p", { class: "muted number" });
  const said = h("p", { class: "muted number", role: "status" });
  const more = h("button", { class: "button sessions-more", type: "button", onClick: () => older() }, "Show more sessions");
  /** @type {Object<string, any>[]} */
  let found = [];
  /** @type {string | null} */
  let cursor = null;
  let shown = 1; // pages
  /** @type {Timer} */
  let timer = null;
  let looks = 0;
  const deleted = canWrite ? recentDeletions(params.map, { signal, changed: () => look() }) : null;
  const show = rows(body, (one) => JSON.stringify([one.session, one.robot]), (one) => row(one));

  function row(one) {
    const { session, robot } = one;
    const frames = sum(one.frames), before = previous(one, found);
    const href = link("maps", params.map, { session, robot });
    const states = Object.entries(one.frames).filter(([state]) => state !== "indexed").map(([state, n]) => `${count(n)} ${state}`);
    const act = (name) => async () => (await import("./edit.js"))[name](params.map, one, found, { say: (text) => put(said, text), changed: look });
    const button = (text, name, kind = "") => h("button", {
      class: `button ${kind}`, type: "button", dataset: { part: name }, "aria-label": `${text} session ${session}`, onClick: act(name),
    }, text);
    return h("tr", {},
      h("th", { scope: "row" }, session === null && robot === null ? h("span", { class: "muted" }, "none") : h("a", { href }, session ?? "none")),
      h("td", {}, robot ?? "–"),
      h("td", { class: "number" }, count(frames), states.length > 0 && h("span", { class: "muted sessions-states" }, states.join(", "))),
      h("td", { class: "number" }, count(one.with_pose)),
      h("td", { class: "sessions-time" }, span(one.first_captured_at, one.last_captured_at)),
      h("td", { class: "number" }, one.first_captured_at === null ? "–" : seconds((Date.parse(one.last_captured_at) - Date.parse(one.first_captured_at)) / 1000)),
      h("td", {}, h("span", { class: "sessions-tags" }, one.tags.map((tag) => h("a", { class: "chip", href: link("maps", params.map, { session, robot, tag }) }, tag)))),
      // frames without a session cannot be named, and so not changed together
      h("td", {}, session !== null && h("span", { class: "sessions-actions" },
        before !== null && h("a", { class: "button", href: link("maps", params.map, "difference", { before, after: session, begin: canWrite ? 1 : null }), "aria-label": `Compare session ${session}` }, "Compare"),
        canWrite && [button("Rename", "renameSession"), button("Tag", "tagSession"), button("Delete", "deleteSession", "danger")])));
  }

  // as many pages as are shown, so that a row that changed stays where it is looked at
  async function look() {
    const turn = looks += 1;
    clearTimeout(timer);
    timer = null;
    const next = [];
    let after = null;
    for (let page = 0; page === 0 || (page < shown && after !== null); page += 1) {
      const told = await get(`${path}/sessions`, { params: { limit: PAGE, cursor: after }, signal });
      next.push(...told.items);
      after = told.next_cursor;
    }
    await deleted?.look();
    if (turn !== looks) return; // a newer one is under way, or was faster
    [found, cursor] = [next, after];
    draw();
  }

  async function older() {
    shown += 1;
    await look();
  }

  function draw() {
    if (!found.length) { put(root, said, deleted, empty({ title: "No sessions yet", text: "A session is what one robot took in one run. Uploads name it, by default after their folder or recording." })); return; }
    show(found);
    more.hidden = cursor === null;
    const frames = found.reduce((n, one) => n + sum(one.frames), 0);
    put(summary, cursor === null ? `${things(found.length, "session")} · ${things(frames, "frame")}` : `The first ${count(found.length)} sessions`);
    if (!card.isConnected) put(root, h("div", { class: "toolbar" }, summary, said), card, more, deleted);
  }

  async function again() {
    timer = null;
    try { await look(); } catch (error) {
      if (error.name === "AbortError") return;
      if (!(error.status === 0 || error.status === 429 || error.status >= 500)) throw error;
      timer = setTimeout(again, AGAIN_MS);
    }
  }

  const heard = () => { if (!signal.aborted) timer ??= setTimeout(again, SOON_MS); };
  signal.addEventListener("abort", () => clearTimeout(timer), { once: true });
  await look();
  actions(canWrite && h("a", { class: "button primary", href: link("maps", params.map, "upload") }, "Upload frames"));
  let began = false;
  watch({
    map: params.map, kinds: ["frame.", "events."], onevent: heard, signal,
    onstate: (state) => { if (state === "live" && !began) { began = true; heard(); } }, // what came between list and stream
  });
}

/** The session with poses that was taken last before another; null where there is no other one.
 * @param {Object<string, any>} one @param {Object<string, any>[]} all */
function previous(one, all) {
  const others = all.filter((other) => other.session !== null && other.session !== one.session && other.with_pose > 0);
  if (!one.with_pose || !others.length) return null;
  const earlier = others.filter((other) => (other.first_captured_at ?? "") < (one.first_captured_at ?? ""));
  const latest = (a, b) => ((b.first_captured_at ?? "") > (a.first_captured_at ?? "") ? b : a);
  return (earlier.length ? earlier : others).reduce(latest).session;
}

/** Frames in all states. @param {Object<string, number>} states */
function sum(states) {
  return Object.values(states).reduce((a, b) => a + b, 0);
}

/** From when until when; the day once where it is the same. */
function span(first, last) {
  if (first === null) return "–";
  const [from, until] = [first, last].map((iso) => new Date(iso).toISOString().slice(0, 19).split("T"));
  if (first === last) return from.join(" ");
  return `${from.join(" ")} – ${from[0] === until[0] ? until[1] : until.join(" ")}`;
}
