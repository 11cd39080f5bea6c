// Keys: who may do what. A secret is shown once, when its key is made.
import { at, get, send } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { time } from "../lib/format.js";
import { me } from "../lib/session.js";
import { confirm, empty, toast } from "../lib/states.js";
import { newKey } from "./newkey.js";
import { rows } from "./poll.js";

/** See operations.js. */
export async function renderTab(root, { signal, actions }) {
  const body = h("tbody", {});
  const table = h("table", { class: "table stack keys" }, h("thead", {}, h("tr", {}, ["Name", "Tenant", "Permissions", "Created", "Expires", "Last used", ""].map((text) => h("th", { scope: "col" }, text || h("span", { class: "visually-hidden" }, "Actions"))))), body);
  const card = h("div", { class: "card scroll" }, table);
  const none = h("div", { hidden: true }, empty({ title: "No key yet", text: "Without a key, the service answers only on its own machine. Give the first key admin access to all maps, so that it can create the others." }));
  const more = h("button", { class: "button", type: "button", hidden: true, onClick: () => older() }, "Show more keys");
  const show = rows(body, (one) => one.name, (one) => keyRow(one, () => first()));
  let found = [];
  let cursor = null;

  async function older() {
    const page = await get("keys", { params: { cursor }, signal });
    found = [...found, ...page.items];
    cursor = page.next_cursor;
    more.hidden = cursor === null;
    none.hidden = found.length > 0;
    card.hidden = found.length === 0;
    show(found);
  }
  async function first() {
    found = [];
    cursor = null;
    await older();
  }

  await first();
  actions(h("button", { class: "button primary", type: "button", onClick: () => newKey(signal, first, found.length === 0) }, "Create a key"));
  put(root, card, none, more);
}

function keyRow(key, changed) {
  const grants = Object.entries(key.grants).map(([map, scope]) => h("span", { class: "chip" }, map === "*" ? "all maps" : map, ": ", scope));
  const own = me()?.name === key.name;
  const withdraw = async () => {
    const text = [h("p", {}, "Requests with this key are rejected from now on. This cannot be undone."),
      own && h("p", {}, h("strong", {}, "This is the key that you are using now."))];
    if (!(await confirm({ title: `Revoke key ${key.name}`, text, word: key.name, action: "Revoke" }))) return;
    await send("DELETE", at("keys", key.name));
    toast(`Key ${key.name} was revoked`);
    await changed();
  };
  return h("tr", {},
    h("th", { scope: "row" }, key.name, own && h("span", { class: "muted" }, " (yours)")),
    h("td", {}, key.tenant),
    h("td", {}, h("span", { class: "chips" }, grants)),
    h("td", {}, time(key.created_at)),
    h("td", {}, key.expires_at === null ? h("span", { class: "muted" }, "never") : time(key.expires_at)),
    h("td", {}, key.last_used_at === null ? h("span", { class: "muted" }, "never") : time(key.last_used_at)),
    h("td", { class: "number" }, h("button", { class: "button danger", type: "button", dataset: { part: "withdraw" }, "aria-label": `Revoke ${key.name}`, onClick: withdraw }, "Revoke")));
}
