// Who changed what.
import { get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { time } from "../lib/format.js";
import { go, link } from "../lib/router.js";
import { empty } from "../lib/states.js";
import { mapField } from "./mapfield.js";

/** See operations.js. */
export async function renderTab(root, { search, signal }) {
  const asked = { actor: search.get("actor"), map: search.get("map") };
  const to = (change) => link("operations", { tab: "audit", ...asked, ...change });
  const body = h("tbody", {});
  const table = h("table", { class: "table stack audit" }, h("thead", {}, h("tr", {}, ["When", "Who", "What", "Map", "Target", "From", "More"].map((text) => h("th", { scope: "col" }, text)))), body);
  const card = h("div", { class: "card scroll" }, table);
  const none = h("div", { hidden: true }, empty({ title: "No changes", text: "Changes appear here with their author." }));
  const more = h("button", { class: "button", type: "button", hidden: true, onClick: () => older() }, "Show older changes");
  const actor = h("input", { type: "search", value: asked.actor ?? "", placeholder: "Key", "aria-label": "Name of the key" });
  let cursor = null;

  async function older() {
    const page = await get("audit", { params: { ...asked, cursor }, signal });
    body.append(...page.items.map(changeRow));
    cursor = page.next_cursor;
    more.hidden = cursor === null;
    none.hidden = body.children.length > 0;
    card.hidden = body.children.length === 0;
  }

  await older();
  put(root, h("form", { class: "toolbar spread", onSubmit: (event) => { event.preventDefault(); go(to({ actor: actor.value.trim() })); } },
    h("p", { class: "muted" }, "Changes, uploads and refused requests."),
    h("div", { class: "toolbar" }, h("span", { class: "inline-field" }, actor), h("button", { class: "button", type: "submit" }, "Find"),
      await mapField(asked.map, signal, (map) => go(to({ map }))))),
  card, none, more);
}

function changeRow(one) {
  const data = Object.keys(one.data).length > 0 && JSON.stringify(one.data);
  return h("tr", {}, h("td", {}, time(one.at)),
    h("th", { scope: "row" }, one.actor ?? h("span", { class: "muted" }, "no key required")),
    h("td", {}, one.action), h("td", {}, one.map ?? "–"),
    h("td", { class: "mono cut", title: one.target }, one.target ?? "–"), h("td", { class: "mono" }, one.address ?? "–"),
    h("td", { class: "mono cut", title: data || null }, data || "–"));
}
