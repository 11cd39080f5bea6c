// Operations: how the service does, what failed, and what only its admins may. One tab at a time.
import { h, put } from "../lib/dom.js";
import { link } from "../lib/router.js";
import { may, me } from "../lib/session.js";

export const styles = ["lib/charts.css", "operations/operations.css"];

const TABS = [
  { tab: "", text: "Overview", load: () => import("./overview.js") },
  { tab: "jobs", text: "Jobs", load: () => import("./jobs.js") },
  { tab: "events", text: "Events", load: () => import("./events.js") },
  { tab: "keys", text: "Keys", load: () => import("./keys.js"), admin: true },
  { tab: "audit", text: "Audit", load: () => import("./audit.js"), admin: true },
];

/** See lib/router.js. */
export async function render(root, context) {
  const { search } = context;
  const mine = TABS.filter((one) => !one.admin || may("admin"));
  const shown = TABS.find((one) => one.tab === (search.get("tab") ?? "")) ?? TABS[0];
  const tabs = h("nav", { class: "tabs", "aria-label": "Operations" }, mine.map((one) =>
    h("a", { href: link("operations", { tab: one.tab, map: search.get("map") }), "aria-current": one === shown && "page" }, one.text)));
  const body = h("div", { class: "page" });
  const { renderTab } = await shown.load();
  await renderTab(body, context);
  put(root, tabs, me() !== null && !may("admin") && h("p", { class: "muted" },
    "Keys and the audit log need a key with admin access to all maps."), body);
  if (shown.tab !== "") context.title(shown.text);
}
