// All jobs, the newest first: by state, kind and map.
import { get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { count } from "../lib/format.js";
import { go, link } from "../lib/router.js";
import { may, me } from "../lib/session.js";
import { empty } from "../lib/states.js";
import { jobRow, retryAllButton } from "./joblist.js";
import { mapField } from "./mapfield.js";
import { poll, rows } from "./poll.js";

const STATES = ["queued", "running", "dead", "failed", "cancelled", "succeeded"];
const KINDS = ["sign", "import", "import-map", "import-bag", "associate", "coverage", "difference", "surface", "reconstruct", "reencode"];
const AT_ONCE = 50;
const POLL_S = 5;

/** See operations.js. */
export async function renderTab(root, { search, signal }) {
  const asked = { state: search.get("state"), kind: search.get("kind"), map: search.get("map") };
  const to = (change) => link("operations", { tab: "jobs", ...asked, ...change });
  const list = h("ul", { class: "list jobs" });
  const more = h("button", { class: "button", type: "button", hidden: true, onClick: () => { pages += 1; again(); } }, "Show older jobs");
  const nothing = h("div", { hidden: true }, empty({ title: "No jobs", text: "Jobs appear here as soon as frames are uploaded." }));
  const show = rows(list, (job) => job.job_id, (job) => jobRow(job, () => again()));
  const { element: states, tell } = filters(asked.state, to);
  const kind = h("select", { id: "jobs-kind", onChange: () => go(to({ kind: kind.value })) },
    h("option", { value: "" }, "All kinds"), KINDS.map((one) => h("option", { value: one, selected: one === asked.kind }, one)));
  const [status, button] = retryAllButton(asked.map, signal, () => again());
  const writes = asked.map === null ? mayAny("write") : may("write", asked.map);
  let pages = 1;

  async function look() {
    const items = [];
    /** @type {string | null} */
    let cursor = null;
    for (let page = 0; page < pages; page += 1) {
      const found = await get("jobs", { params: { ...asked, cursor, limit: AT_ONCE }, signal });
      items.push(...found.items);
      cursor = found.next_cursor;
      if (cursor === null) break;
    }
    more.hidden = cursor === null;
    nothing.hidden = items.length > 0;
    show(items);
    const known = await counts(asked.map, signal);
    tell(known);
    button.hidden = !writes || (known !== null && !known.dead);
  }

  const again = await poll(look, POLL_S, signal);
  put(root, h("div", { class: "toolbar spread" }, states,
    h("div", { class: "toolbar" }, h("label", { class: "inline-field" }, h("span", { class: "visually-hidden" }, "Kind"), kind),
      await mapField(asked.map, signal, (map) => go(to({ map }))),
      status, button)), list, nothing, more);
}

/** Whether the key may do that with any map. */
const mayAny = (scope) => may(scope) || Object.keys(me()?.grants ?? {}).some((map) => may(scope, map));

/** How many jobs are in each state; null for who may not have them counted. */
async function counts(map, signal) {
  if (map === null && !may("read")) return null;
  return (await get("stats", { params: { map, minutes: 1 }, signal })).jobs;
}

/** Links to the states, made once so that they keep the focus, and the numbers in them. */
function filters(state, to) {
  const chips = new Map([null, ...STATES].map((one) => [one, h("span", { class: "chip number", dataset: { figure: one ?? "all" }, hidden: true })]));
  const links = [...chips].map(([one, chip]) => h("a", {
    class: "button quiet filter", href: to({ state: one }), "aria-current": one === state && "true",
  }, one ?? "all", chip));
  return {
    element: h("nav", { class: "toolbar", "aria-label": "States" }, links),
    tell(known) {
      if (known === null) return;
      const all = Object.values(known).reduce((sum, n) => sum + n, 0);
      for (const [one, chip] of chips) {
        chip.hidden = false;
        put(chip, count(one === null ? all : known[one] ?? 0));
      }
    },
  };
}
