// Keep an answer until it is released, and the link that shares it.
import { at, get, send } from "../lib/api.js";
import { copyFrom, h, once, put } from "../lib/dom.js";
import { time } from "../lib/format.js";
import { link } from "../lib/router.js";
import { may } from "../lib/session.js";
import { toast } from "../lib/states.js";

/** A button that keeps an answer; of one that is kept its link, and a button that releases it. @param {AbortSignal} signal */
export function keepPanel(answer, signal) {
  const query = at("queries", answer.query_id), path = `${query}/keep`;
  const mayKeep = answer.maps.length > 0 && answer.maps.every((map) => may("write", map));
  const place = h("div", { class: "toolbar query-keep", role: "group", "aria-label": "Keep this answer" });
  const said = h("span", { class: "visually-hidden", role: "status" });
  const panel = h("div", {}, said, place);

  const keep = once(async () => {
    const { data } = await send("PUT", path, { json: {}, signal });
    draw(data);
    put(said, "The answer is kept.");
    place.querySelector("button")?.focus();
  });
  const release = once(async () => {
    await send("DELETE", path, { signal });
    draw(await get(`${query}/question`, { signal }).catch((error) => {
      if (error.status !== 404) throw error;
      return { kept_at: null, expires_at: null }; // its time was over
    }));
    toast("The answer is no longer kept.");
  });

  /** @param {Object<string, any>} told the record of the query */
  function draw(told) {
    if (!told.kept_at) {
      put(place, mayKeep && h("button", { class: "button", type: "button", onClick: keep }, "Keep answer"),
        told.expires_at && h("span", { class: "muted" }, "This answer expires ", time(told.expires_at), "."));
      return;
    }
    put(place, h("button", { class: "button", type: "button", onClick: copy }, "Copy link"),
      mayKeep && h("button", { class: "button quiet", type: "button", onClick: release }, "Release"),
      h("span", { class: "muted" }, told.title ? `Kept as “${told.title}”` : "Kept", " until it is released."));
  }

  async function copy() {
    const field = h("input", { class: "mono", readonly: true, value: new URL(link("queries", answer.query_id), location.href).href, "aria-label": "Link to this answer" });
    place.querySelector("input")?.remove();
    if (await copyFrom(field)) { toast("The link was copied."); return; }
    place.append(field);
    field.focus();
    field.select();
  }

  get(`${query}/question`, { signal }).then(draw, (error) => {
    if (error.name === "AbortError" || error.status === 404) return; // it was not stored
    throw error;
  });
  return panel;
}
