// Two sessions of a map compared: begun here, followed, and shown in one view.
import { at, bytes, get, send } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { count, metres } from "../lib/format.js";
import { coded } from "../lib/prose.js";
import { followJob, goesOn } from "../lib/products.js";
import { link } from "../lib/router.js";
import { may } from "../lib/session.js";
import { empty } from "../lib/states.js";
import { axesFor } from "../plan/axes.js";
import { parsePoints } from "../viewer/points.js";
import { createViewer } from "../viewer/viewer.js";

export const styles = ["overlay/overlay.css"];

/** What cells are, in the order of the file. */
const KINDS = [
  { name: "same", tint: "muted", text: () => "in both" },
  { name: "gone", tint: "query", text: ({ before }) => `gone: only in ${before}` },
  { name: "new", tint: "match", text: ({ after }) => `new: only in ${after}` },
  { name: "unseen_after", tint: "edge", text: ({ before, after }) => `in ${before}; ${after} did not look there` },
  { name: "unseen_before", tint: "edge", text: ({ before, after }) => `in ${after}; ${before} did not look there` },
];
const VIEWS = {
  before: ["same", "gone", "unseen_after"],
  difference: KINDS.map((kind) => kind.name),
  after: ["same", "new", "unseen_before"],
};
const NAMES = { before: "Before", difference: "Difference", after: "After" };

/** The page: #/maps/NAME/difference?before=&after=&show= */
export async function render(root, { params: { map }, search, signal, go, actions }) {
  const path = at("maps", map, "differences");
  const [sessions, told] = await Promise.all([
    get(at("maps", map, "sessions"), { params: { limit: 1000 }, signal }), get(path, { params: { limit: 1000 }, signal })]);
  actions(h("a", { class: "button", href: link("maps", map, "sessions") }, "To the sessions"));
  const names = [...new Set(sessions.items.filter((one) => one.session !== null && one.with_pose > 0).map((one) => one.session))];
  if (names.length < 2) {
    put(root, empty({ title: "There are no two sessions to compare", text: "Two sessions whose frames have poses in one parent frame can be compared." }));
    return;
  }
  const page = new Page(root, { map, path, signal, go, names, all: told.items, wanted: search });
  await (search.has("begin") ? page.compare() : page.show());
}

class Page {
  /** @type {Viewer | null} @typedef {import("../viewer/viewer.js").Viewer} Viewer */
  #viewer = null;
  #turn = 0;

  constructor(root, { map, path, signal, go, names, all, wanted }) {
    this.map = map;
    this.path = path;
    this.signal = signal;
    this.go = go;
    this.all = all; // comparisons, the newest first
    this.seen = {
      before: names.includes(wanted.get("before")) ? wanted.get("before") : names[0],
      after: names.includes(wanted.get("after")) ? wanted.get("after") : names[1],
      show: wanted.get("show") in VIEWS ? wanted.get("show") : "difference",
    };
    const choice = (side, text) => h("label", { class: "field" }, h("span", {}, text),
      h("select", { id: `difference-${side}`, onChange: (event) => { this.seen[side] = event.target.value; this.#address(); this.show(); } },
        names.map((name) => h("option", { value: name, selected: name === this.seen[side] }, name))));
    this.button = h("button", { class: "button primary", type: "button", id: "difference-begin", onClick: () => this.begin() }, "Compare");
    this.said = h("p", { class: "muted number", role: "status" });
    this.body = h("div", {});
    put(root, h("div", { class: "toolbar" }, choice("before", "Before"), choice("after", "After"), may("write", map) && this.button, this.said), this.body);
    signal.addEventListener("abort", () => this.#viewer?.destroy(), { once: true });
  }

  /** Compare the two sessions unless they are compared already. */
  compare() {
    this.#address(); // what is loaded again begins nothing
    return this.#newest() ? this.show() : this.begin();
  }

  #newest() {
    return this.all.find(({ request: { before, after } }) => before === this.seen.before && after === this.seen.after);
  }

  /** Show the newest comparison of the two sessions, or that there is none. */
  async show() {
    const turn = this.#turn += 1, { before, after } = this.seen, one = this.#newest();
    this.#viewer?.destroy();
    this.#viewer = null;
    this.button.disabled = before === after || Boolean(one && goesOn(one));
    put(this.said, this.#status(one));
    if (one?.state === "succeeded") {
      const data = await bytes(`${this.path}/${one.job_id}/points`, { signal: this.signal });
      if (turn === this.#turn && !this.signal.aborted) this.#draw(one, parsePoints(data));
      return;
    }
    if (one && goesOn(one)) put(this.body);
    else if (one) put(this.body, empty({ title: "The comparison did not succeed", text: coded(one.error ?? one.state) }));
    else put(this.body, empty({ title: "Not compared yet", text: before === after ? "Choose two sessions." : `Compare ${before} with ${after} to see what is gone and what is new.` }));
    if (one && goesOn(one)) this.#follow(one.job_id, turn); // the page is there meanwhile
  }

  async begin() {
    const { before, after } = this.seen;
    this.button.disabled = true;
    try {
      const { data } = await send("POST", this.path, { json: { before, after } });
      this.all = [data, ...this.all];
    } catch (error) {
      if (error.status !== 422) throw error;
      this.button.disabled = false;
      const apart = (error.errors ?? []).some((one) => one.reason === "no parent frame in common");
      put(this.body, empty({ title: "These sessions cannot be compared", text: coded(error.detail),
        actions: apart && h("button", { class: "button primary", type: "button", id: "difference-join", onClick: () => this.join() }, "Join them, and compare") }));
      return;
    }
    await this.show();
  }

  /** Associate the two sessions, and compare them where that joins them. */
  async join() {
    const path = at("maps", this.map, "associations"), { before, after } = this.seen, turn = this.#turn;
    const refused = (text) => put(this.body, empty({ title: "These sessions are not joined", text: coded(text) }));
    put(this.body);
    try {
      const { data } = await send("POST", path, { json: { sessions: [after, before] } });
      put(this.said, "Joining: waiting for a worker…");
      await followJob(`${path}/${data.job_id}`, (now) => {
        if (turn !== this.#turn) return;
        if (now && goesOn(now)) {
          if (now.progress?.total) put(this.said, `Joining: ${count(now.progress.done)} of ${count(now.progress.total)} frames`);
          return;
        }
        put(this.said);
        const joins = now?.result?.joins ?? [];
        if (joins.some((one) => one.root !== null)) this.begin();
        else refused(now?.error ?? joins[0]?.reason ?? "No edge connects their frames.");
      }, this.signal);
    } catch (error) {
      if (error.status !== 422) throw error;
      refused(error.detail);
    }
  }

  async #follow(id, turn) {
    await followJob(`${this.path}/${id}`, (now) => {
      this.all = this.all.flatMap((one) => (one.job_id !== id ? [one] : now ? [now] : []));
      if (turn !== this.#turn) return;
      if (now && goesOn(now)) put(this.said, this.#status(now));
      else this.show();
    }, this.signal);
  }

  #status(one) {
    if (!one) return "";
    const { progress, result } = one;
    if (goesOn(one)) return progress?.total ? `Comparing: ${count(progress.done)} of ${count(progress.total)} steps` : "Waiting for a worker…";
    return result && `${count(result.frames_before)} and ${count(result.frames_after)} frames, cells of ${metres(result.cell_m)}`;
  }

  #draw(one, points) {
    const canvas = h("canvas", { class: "overlay-canvas" });
    const legend = h("div", {}), bar = h("div", { class: "overlay-bar" });
    put(this.body, h("section", { class: "card overlay-view", "aria-label": "The view" }, bar, h("div", { class: "overlay-stage" }, canvas), legend));
    const viewer = this.#viewer = createViewer(canvas, { label: `Difference of ${one.request.before} and ${one.request.after}`, up: "z" });
    canvas.viewer = viewer; // for who measures it
    const middle = points.extent.map((x) => -x / 2), matrix = upright(one.result.up);
    let at = points.offset;
    for (const { name, tint } of KINDS) {
      const own = { ...points, count: one.result[name], offset: at, origin: middle };
      at += own.count * points.stride;
      if (own.count) viewer.cloud(name, { points: own, matrix, colour: "tint", tint, size: one.result.cell_m });
    }
    const shown = () => {
      const { show } = this.seen, wanted = VIEWS[show];
      for (const { name } of KINDS) if (viewer.has(name)) viewer.cloud(name, { visible: wanted.includes(name) });
      for (const button of bar.querySelectorAll("[data-show]")) button.setAttribute("aria-pressed", String(button.getAttribute("data-show") === show));
      put(legend, h("ul", { class: "overlay-legend", "aria-label": "Legend" }, KINDS.filter(({ name }) => wanted.includes(name)).map((kind) =>
        h("li", { dataset: { kind: kind.name } }, h("span", { class: "overlay-swatch", style: { background: `var(--${kind.tint})` } }),
          h("span", {}, kind.text(one.request), h("span", { class: "muted" }, ` ${count(one.result[kind.name])} cells`))))),
      h("p", { class: "muted overlay-keys" }, "Drag to turn, with Shift to move, wheel or pinch to zoom."));
    };
    put(bar, h("div", { class: "overlay-row" },
      h("div", { class: "overlay-group", role: "group", "aria-label": "Sessions" }, Object.entries(NAMES).map(([show, text]) =>
        h("button", { class: "button", type: "button", dataset: { show }, onClick: () => { this.seen.show = show; this.#address(); shown(); } }, text))),
      h("button", { class: "button", type: "button", onClick: () => viewer.fit() }, "Show all")));
    shown();
    viewer.fit(KINDS.map(({ name }) => name).filter((name) => viewer.has(name)));
  }

  #address() {
    const { before, after, show } = this.seen;
    this.go(link("maps", this.map, "difference", { before, after, show: show === "difference" ? null : show }), { replace: true, quiet: true });
  }
}

/** What turns a direction up: 16 numbers, column-major. @param {number[]} up unit vector */
function upright(up) {
  const { x, y } = axesFor(up);
  return [0, 1, 2].flatMap((k) => [x[k], y[k], up[k], 0]).concat(0, 0, 0, 1);
}
