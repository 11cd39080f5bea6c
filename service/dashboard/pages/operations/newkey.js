// Making a key, and showing its secret the one time that it can be shown.
import { get, send } from "../lib/api.js";
import { copyFrom, h } from "../lib/dom.js";
import { saveFrom } from "../lib/form.js";
import { sheet, toast } from "../lib/states.js";

const SCOPES = [["read", "read: view and query"], ["write", "write: also upload and edit frames"], ["admin", "admin: also change the map itself"]];

/**
 * Ask for a name and grants, and make the key.
 * @param {AbortSignal} signal @param {() => Promise<void>} made
 * @param {boolean} isFirst it creates the others, so that it is offered all maps and everything
 */
export async function newKey(signal, made, isFirst) {
  const names = (await get("maps", { signal })).items.map((one) => one.name);
  const name = h("input", { required: true, maxlength: "128", autocomplete: "off", spellcheck: "false", placeholder: "robot-7" });
  const expires = h("input", { type: "datetime-local" });
  const lines = h("div", { class: "grants" });
  const add = (map, scope = "read") => lines.append(grantLine(map, scope));
  const dialog = sheet({ title: "Create a key", buttons: h("button", { class: "button primary", type: "submit" }, "Create key"), children: [
    h("label", { class: "field" }, h("span", {}, "Name of its user"), name),
    h("fieldset", { class: "grants-set" }, h("legend", {}, "Permissions"), lines,
      h("datalist", { id: "key-maps" }, ["*", ...names].map((one) => h("option", { value: one }))),
      h("p", { class: "muted" }, "* stands for all maps and everything outside of maps."),
      h("button", { class: "button quiet", type: "button", onClick: () => add("") }, "Another map")),
    h("label", { class: "field" }, h("span", {}, "Expires (never, if empty)"), expires), h("p", { class: "field-error", role: "alert" }),
  ] });
  if (isFirst) add("*", "admin"); else add(names[0] ?? "*");
  saveFrom(dialog, async () => {
    const grants = {};
    for (const line of lines.children) {
      const map = /** @type {HTMLInputElement} */ (line.querySelector("input")).value.trim();
      if (map) grants[map] = /** @type {HTMLSelectElement} */ (line.querySelector("select")).value;
    }
    const until = expires.value ? new Date(expires.value).toISOString() : null;
    const { data } = await send("POST", "keys", { json: { name: name.value.trim(), grants, expires_at: until } }); // even if the page is left: only this answer has the secret
    dialog.close();
    secret(data);
    if (!signal.aborted) await made();
  });
}

function grantLine(map, scope) {
  const line = h("div", { class: "joined" },
    h("input", { class: "mono", "aria-label": "Map", list: "key-maps", value: map, autocomplete: "off", spellcheck: "false", placeholder: "name of a map, or *" }),
    h("select", { "aria-label": "Scope" }, SCOPES.map(([value, text]) => h("option", { value, selected: value === scope }, text))),
    h("button", { class: "button quiet", type: "button", "aria-label": "Remove this map", onClick: () => { if (line.parentElement && line.parentElement.children.length > 1) line.remove(); } }, "×"));
  return line;
}

/** The secret, until the dialog is closed: then it is nowhere. */
function secret(key) {
  const field = h("input", { class: "mono", readonly: true, value: key.secret, "aria-label": "Secret", onFocus: () => field.select() });
  const copy = h("button", { class: "button", type: "button", onClick: async () => toast(await copyFrom(field) ? "Copied" : "Selected: press Ctrl+C to copy") }, "Copy");
  const dialog = sheet({ title: `Key ${key.name} was created`, cancel: "I have stored it", buttons: null, children: [
    h("p", {}, h("strong", {}, "The secret is shown only once."), " The service stores only its hash. Send it as ", h("code", {}, "Authorization: Bearer SECRET"), "."),
    h("div", { class: "joined" }, field, copy)] });
  dialog.addEventListener("close", () => { field.value = ""; });
}
