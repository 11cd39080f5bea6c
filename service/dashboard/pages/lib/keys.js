// Where a key is asked for, or the one of this tab is not enough.
import { get } from "./api.js";
import { h, put } from "./dom.js";
import { forgetKey, identify, key, me, setKey } from "./session.js";

const MAY = { read: "view and query", write: "upload and edit frames", admin: "change the map itself" };
// what the API says is for who writes requests by hand
const WRONG_KEY = "This key is unknown, revoked or expired. Check that you copied all of it, or ask for another.";

/**
 * A field for a key, and why it is there.
 * @param {Fault} problem of status 401 or 403
 * @param {() => void} taken what to do with a key that is good
 */
export function keyPage(problem, taken) {
  const refused = problem.status !== 401;
  const input = h("input", {
    id: "key", class: "mono", type: "password", autocomplete: "off", spellcheck: "false",
    placeholder: "sp_…", "aria-describedby": "key-why key-note",
  });
  const why = h("p", { id: "key-why", class: "field-error", role: "alert" }, !refused && key() !== null && WRONG_KEY);
  const button = h("button", { class: "button primary", type: "submit" }, "Use this key");
  const show = h("button", { class: "button", type: "button", "aria-pressed": false, onClick: () => {
    const hidden = input.type === "password";
    input.type = hidden ? "text" : "password";
    show.setAttribute("aria-pressed", String(hidden));
  } }, "Show");
  const form = h("form", { onSubmit: submit },
    h("div", { class: "field" }, h("label", { for: "key" }, refused ? "Another key" : "Key"), h("div", { class: "joined" }, input, show)),
    why, button);

  async function submit(event) {
    event.preventDefault();
    const before = key();
    const given = input.value.trim();
    // a header can hold no other characters, and fetch would break down over them
    if (!/^[\x21-\x7e]+$/.test(given)) { tell(given ? "This is not a key: it contains characters that keys do not have." : "Paste a key first."); return; }
    setKey(given);
    button.disabled = true;
    try {
      await identify(get);
      taken();
    } catch (error) {
      if (before === null) forgetKey(); else setKey(before);
      tell(error.status === 401 ? WRONG_KEY : error.message);
    } finally {
      button.disabled = false;
    }
  }

  function tell(text) {
    put(why, text);
    input.setAttribute("aria-invalid", "true");
    input.focus();
    input.select();
  }

  return h("section", { class: "card key-page" },
    h("h2", {}, heading(problem.status)),
    refused ? h("p", {}, problem.message)
      : h("p", {}, "Its operator can create one with ", h("code", {}, "sceneprint keys --create NAME"), "."),
    refused && grants(),
    form,
    h("p", { id: "key-note", class: "muted" }, "The key stays in this tab until you close it, and is sent only to this service."));
}

function heading(status) {
  if (status === 401) return "This service requires a key";
  return status === 403 ? "Your key does not allow this" : "It does not exist, or your key may not see it";
}

/** What the key of this tab may do. */
function grants() {
  const rows = Object.entries(me()?.grants ?? {}).map(([map, scope]) =>
    h("li", {}, h("strong", {}, map === "*" ? "all maps" : map), `: ${scope} (${MAY[scope]})`));
  return h("div", {}, h("p", {}, "The key ", h("strong", {}, me()?.name ?? ""), " may, by map:"), h("ul", {}, rows));
}
