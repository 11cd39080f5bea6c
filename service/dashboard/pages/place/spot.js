// Frames that saw a spot of the surface, or that were taken in a box: with their pictures.

import { at, get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { frameLabel, frameTitle, metres, things, time } from "../lib/format.js";
import { picture } from "../lib/picture.js";
import { link } from "../lib/router.js";
import { failed } from "../lib/states.js";

const AT_ONCE = 12;

/**
 * @param {{map: string, signal: AbortSignal, onclose: () => void}} how
 * @returns {{element: HTMLElement, show: (asked: {title: string, none: string, params: Object<string, any>,
 *   inside?: (frame: any) => boolean}) => Promise<void>, close: () => void}} inside: whether a frame is
 *   meant, of those that the API tells
 */
export function sightings({ map, signal, onclose }) {
  const title = h("h2", { id: "place-spot" });
  const said = h("p", { class: "muted", role: "status" });
  const list = h("ul", { class: "place-frames" });
  const more = h("button", { class: "button", type: "button", hidden: true }, "More frames");
  const close = () => { turn += 1; element.hidden = true; onclose(); };
  const element = h("section", { class: "card paths-section", "aria-labelledby": "place-spot", hidden: true },
    h("div", { class: "paths-row" }, title, h("button", { class: "button quiet", type: "button", onClick: close }, "Close")), said, list, more);
  let turn = 0;

  /** @param {{title: string, none: string, params: Object<string, any>, inside?: (frame: any) => boolean}} asked */
  async function show({ title: text, none, params, inside = () => true }) {
    const own = turn += 1;
    element.hidden = false;
    put(title, text);
    put(list);
    put(said, "Looking for frames…");
    more.hidden = true;
    let cursor = null, found = 0;
    const next = async () => {
      more.disabled = true;
      try {
        let added = 0;
        do { // a box that is turned holds fewer than the one about it
          const page = await get(at("maps", map, "surface", "frames"), { params: { ...params, cursor, limit: AT_ONCE }, signal });
          if (own !== turn) return;
          const frames = page.items.filter(inside);
          list.append(...frames.map((one) => row(map, one, signal)));
          added += frames.length;
          cursor = page.next_cursor;
        } while (cursor !== null && added < AT_ONCE);
        found += added;
        put(said, found === 0 ? none : `${things(found, "frame")}${cursor === null ? "" : ", and more"}`);
      } catch (error) {
        if (error.name === "AbortError" || own !== turn) return;
        put(said, failed(error));
      }
      more.hidden = cursor === null;
      more.disabled = false;
    };
    more.onclick = next;
    await next();
  }

  return { element, show, close };
}

function row(map, one, signal) {
  const href = link("maps", map, "frames", one.frame_id);
  return h("li", {},
    h("a", { href, tabindex: -1, "aria-hidden": "true" }, picture(at("maps", map, "frames", one.frame_id, "preview.png"), { view: "depth", width: 160 },
      { alt: "", width: 120, height: 90, signal })),
    h("div", { class: "paths-told" },
      h("a", { href, title: frameTitle(one) }, frameLabel(one)),
      h("span", { class: "muted" }, one.session ?? "no session", one.robot !== null && one.robot !== one.session && ` · ${one.robot}`),
      h("span", { class: "muted" }, one.captured_at && ["taken ", time(one.captured_at)], one.distance_m !== null && `, from ${metres(one.distance_m)}`),
      h("a", { href: link("maps", map, "query", { frame: one.frame_id }), "aria-label": `Query with frame ${frameLabel(one)}` }, "Query with it")));
}
