// How the service does, on one page: what waits, the last hour, what failed, what happens now.
import { get } from "../lib/api.js";
import { h, put, throttle } from "../lib/dom.js";
import { go, link } from "../lib/router.js";
import { may } from "../lib/session.js";
import { empty } from "../lib/states.js";
import { events } from "./events.js";
import { health } from "./health.js";
import { history } from "./history.js";
import { canRetry, jobRow, retryAllButton } from "./joblist.js";
import { CARDS } from "./machines.js";
import { mapField } from "./mapfield.js";
import { poll, rows } from "./poll.js";
import { tiles } from "./tiles.js";

const POLL_S = 5;
const SOON_MS = 800; // after an event: many come at once, and one look is enough for all
const FAILURES = 8;
const EVENTS = 12;
// all kinds but queries: robots that ask all the time would leave nothing else to be seen
const CHANGES = ["map.", "frame.", "import.", "association.", "key."];

/** See operations.js. */
export async function renderTab(root, { search, signal }) {
  const all = may("read");
  let map = search.get("map");
  if (map === null && !all) { // the service as a whole is not for this key: one of its maps is
    map = (await get("maps", { signal })).items[0]?.name ?? null;
    if (map === null) {
      put(root, empty({ title: "Nothing to show", text: "Your key cannot read any existing map, and figures of the whole service need a key for all maps." }));
      return;
    }
  }
  const whole = map === null;
  const line = health(signal);
  const failures = failureList(map, signal);
  const figures = h("div", {});
  const hour = history(whole);
  const columns = h("div", { class: "columns" });
  const show = rows(columns, ({ part }) => part, ({ part, ...stats }) => CARDS[part](stats));

  async function look() {
    const [stats] = await Promise.all([get("stats", { params: { map }, signal }), line.look(signal), failures.look()]);
    put(figures, tiles(whole, stats));
    hour.update(stats);
    show(["indexes", whole ? "workers" : "use", "bytes"].map((part) => ({ part, [part]: stats[part] })));
  }

  const again = await poll(look, POLL_S, signal, () => line.look(signal).catch(() => {}));
  failures.onchange = again;
  const feed = await events({ map, kind: CHANGES, limit: EVENTS, signal, onstate: line.live, onevent: throttle(again, SOON_MS, signal) });
  const choose = await mapField(map, signal, (name) => go(link("operations", { map: name })), all);
  put(root, h("div", { class: "toolbar spread" }, line.element, choose),
    !whole && h("p", { class: "muted" }, all ? "Figures of this map only. Workers, requests, query times and disk space cover all maps."
      : "Figures of this map only: workers, requests, query times and disk space need a key for all maps."),
    figures, hour.element, columns,
    failures.element,
    h("section", { class: "card", "aria-labelledby": "events" }, h("div", { class: "card-head" }, h("h2", { id: "events" }, "Recent events"),
      h("a", { href: link("operations", { tab: "events", map: whole ? null : map }) }, "All events")), feed));
}

/** What broke down or was refused, and has not been tried again since. */
function failureList(map, signal) {
  const list = h("ul", { class: "list jobs" });
  const none = h("p", { class: "muted" }, "No failed jobs, except those already retried.");
  const rest = h("a", { href: link("operations", { tab: "jobs", state: "dead", map }), hidden: true }, "More failures");
  const own = { onchange: () => {} };
  const show = rows(list, (job) => job.job_id, (job) => jobRow(job, () => own.onchange()));
  const [status, button] = retryAllButton(map, signal, () => own.onchange());
  return Object.assign(own, {
    element: h("section", { class: "card", "aria-labelledby": "failures" }, h("div", { class: "card-head" }, h("h2", { id: "failures" }, "Failures"),
      h("div", { class: "toolbar" }, status, button)), none, list, rest),
    async look() {
      const pages = await Promise.all(["dead", "failed"].map((state) => get("jobs", { params: { state, map, limit: 100 }, signal })));
      const left = pages.flatMap((page) => page.items).filter((job) => !job.followed_by);
      left.sort((a, b) => Date.parse(b.finished_at) - Date.parse(a.finished_at));
      const older = pages.map((page) => page.next_cursor !== null); // that were not looked at
      none.hidden = left.length > 0 || older.some(Boolean);
      rest.hidden = left.length <= FAILURES && !older.some(Boolean);
      button.hidden = !older[0] && !left.some((job) => job.state === "dead" && canRetry(job));
      show(left.slice(0, FAILURES));
    },
  });
}
