// Ask a map: pick a frame or drop a file, and see the answer change with every option.
import { at, get } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { shortId } from "../lib/format.js";
import { link } from "../lib/router.js";
import { empty, failed, gone, loading, soon } from "../lib/states.js";
import { backdrops } from "../plan/backdrop.js";
import { ask } from "./asking.js";
import { controls } from "./controls.js";
import { fieldsOf, fromOptions, fromSearch, toOptions, toSearch } from "./options.js";
import { gallery } from "./picker.js";
import { showAnswer } from "./result.js";
import { chooser } from "./source.js";
import { thumbs } from "./thumbs.js";
import { verdict } from "./words.js";

export const styles = ["query/query.css", "query/alternatives.css", "plan/plan.css", "frames/source.css"];

/** Milliseconds after the last change until it is asked: a slider that is dragged asks once. */
const PAUSE_MS = 250;

/** @param {HTMLElement} root @param {Object<string, any>} context see main.js */
export async function render(root, { params, search, signal, go, about }) {
  const come = soon(root, "Loading the map");
  const [map, models, sessions, question] = await Promise.all([
    about, get("models", { signal }),
    get(`${at("maps", params.map)}/sessions`, { params: { limit: 100 }, signal }).catch(() => ({ items: [] })),
    search.get("query") ? get(`${at("queries", search.get("query"))}/question`, { signal }).catch(kept) : null,
  ]);
  come();
  const page = new Page({ root, params, search, signal, go, map, question, fields: fieldsOf(models.items.find((one) => one.label === map.model) ?? null),
    sessions: sessions.items.map((one) => one.session).filter(Boolean) });
  page.show();
}

// what is no longer stored cannot be asked again, but another frame can
function kept(error) {
  if (error.status !== 404) throw error;
  return undefined;
}

class Page {
  /** @type {ReturnType<typeof chooser>} */
  chooser;

  constructor({ root, params, search, signal, go, map, question, fields, sessions }) {
    this.root = root;
    this.map = params.map;
    this.signal = signal;
    this.go = go;
    this.isEmpty = !map.frames.indexed;
    const told = question ? fromOptions(question.options) : { said: null, rest: {} };
    const given = fromSearch(search);
    // of a kept query its own options, and over them what the address says
    this.said = told.said ? { ...told.said, ...toSearch(given) } : given;
    this.rest = told.rest;
    this.home = [params.map];
    this.maps = search.get("maps") === "*" ? "*" : search.get("maps")?.split(",") ?? question?.maps ?? this.home;
    this.asked = question?.maps ?? this.home;
    /** @type {import("./asking.js").Source | null} */
    this.source = null;
    if (question) this.source = { query: question.query_id, base: question.options, frame: question.frame ?? undefined };
    else if (search.get("frame")) this.source = { frame: { map: params.map, frame_id: search.get("frame") } };
    this.lost = question === undefined ? search.get("query") : null;
    this.pictures = thumbs(signal);
    this.backdrops = backdrops(signal);
    this.seen = { why: search.has("why"), match: search.get("match") };
    this.panel = controls(fields, this.said, { onchange: () => this.later(), sessions });
    this.result = h("div", { class: "query-result" });
    this.state = h("span", { class: "query-state", role: "status" });
    this.answer = null;
    this.choice = null;
    this.why = null; // the frame that is explained, with every answer
    this.running = null;
  }

  show() {
    this.chooser = chooser({ map: this.map, pictures: this.pictures, signal: this.signal, onchoose: (source) => this.take(source) });
    const several = h("select", { id: "ask-maps", onchange: () => {
      this.maps = several.value === "*" ? "*" : several.value.split(",");
      this.later(0);
    } }, h("option", { value: this.map }, "this map"),
    this.asked.join() !== this.map && h("option", { value: this.asked.join() }, `as in the query: ${this.asked.join(", ")}`),
    h("option", { value: "*" }, "all maps that you may read"));
    several.value = this.maps === "*" ? "*" : this.maps.join();
    const more = Object.keys(this.rest);
    put(this.root, h("div", { class: "query-page" },
      h("details", { class: "card query-panel", open: Object.values(this.said).some((value) => value !== null) }, h("summary", {}, h("h2", {}, "Options")),
        h("div", { class: "field query-field" }, h("label", { for: "ask-maps" }, "Maps"), several,
          h("small", { class: "muted" }, "Several maps give one ranking; they must use the same model.")),
        more.length > 0 && h("p", { class: "muted" }, `The filter also contains ${more.join(", ")}, from the original query.`),
        this.panel),
      this.state, h("div", { class: "query-main" }, this.chooser, this.result)));
    if (this.lost !== null) this.say(`Answer ${shortId(this.lost)} has expired. Pick a frame, or drop the file again.`);
    this.chooser.tell(this.source);
    if (this.source) this.run(); else this.nothing();
  }

  nothing() {
    const upload = h("a", { class: "button primary", href: link("maps", this.map, "upload") }, "Upload frames");
    put(this.result, this.isEmpty
      ? empty({ title: "Nothing to search yet", text: "No frame of this map is indexed. Files dropped here are queries; they are not added to the map.", actions: upload })
      : h("section", { class: "card query-start", "aria-label": "Pick a frame" }, h("h2", {}, "Where was this taken?"),
        h("p", { class: "muted" }, "Pick a frame of the map (it will not find itself), or drop a depth image or point cloud above. Each change of an option runs the query again."),
        gallery(this.map, { pictures: this.pictures, signal: this.signal, onpick: (id) => this.take({ frame: { map: this.map, frame_id: id } }) })));
  }

  /** Another query: what was answered to the one before says nothing of it. */
  take(source) {
    this.source = source;
    this.rest = {};
    this.why = this.seen.match = null;
    this.answer = null;
    this.chooser.tell(source);
    put(this.result);
    this.run();
  }

  later(pause = PAUSE_MS) {
    clearTimeout(this.timer);
    if (this.source) this.timer = setTimeout(() => this.run(), pause);
  }

  change(said) {
    Object.assign(this.said, said);
    if (said.session === null) this.rest = {};
    this.panel.refill();
    this.later(0);
  }

  /** Ask as things are now; an answer that has not come by then is not waited for. */
  async run() {
    clearTimeout(this.timer);
    this.running?.abort();
    if (this.signal.aborted) return;
    const own = this.running = new AbortController();
    const signal = AbortSignal.any([own.signal, this.signal]);
    this.follow(); // not with every step of a slider: a browser takes 200 addresses in 30 s
    this.say("Asking…");
    this.result.setAttribute("aria-busy", "true");
    if (this.answer === null) put(this.result, loading("Asking"));
    const source = /** @type {import("./asking.js").Source} */ (this.source);
    try {
      const options = { ...toOptions(this.said, this.rest), explain: true, explain_frame: this.why, record: false }; // no robot asks
      const answer = await this.answered(source, options, signal);
      this.follow(answer);
      this.panel.refuse([]);
      const shown = await showAnswer(this.result, answer, {
        signal: this.signal, turn: signal, pictures: this.pictures, backdrops: this.backdrops, seen: this.seen, onseen: () => this.follow(answer), before: this.answer, chosen: this.choice?.chosen ?? null,
        ask: async (frame) => {
          const told = await ask(source, this.maps, { ...options, explain: null, explain_frame: frame, keep: false, record: false }, this.signal);
          if (this.source === source) this.why = frame; // another may have been taken meanwhile
          return told.explained_frame;
        },
        change: (said) => this.change(said),
        pick: this.maps !== "*" && this.maps.length === 1 ? () => this.chooser.pick("Why not this frame?") : undefined,
      });
      this.answer = answer;
      this.choice = shown.choice;
      const { title, text } = verdict(answer);
      this.say(h("span", { class: "visually-hidden" }, `${title}. ${text}`));
    } catch (error) {
      if (error.name === "AbortError") return;
      if (error.status === 401) throw error;
      this.say("");
      if (error.status === 0) {
        put(this.result, gone(() => this.run(), signal));
        return;
      }
      this.panel.refuse(error.errors ?? []);
      this.answer = null;
      put(this.result, failed(error, () => this.run()));
    } finally {
      if (this.running === own) this.result.setAttribute("aria-busy", "false");
    }
  }

  async answered(source, options, signal) {
    try {
      return await ask(source, this.maps, options, signal);
    } catch (error) {
      if (error.type !== "unknown-frame" || this.why === null) throw error;
      this.why = null; // no map that is asked by now has the frame that was explained
      return ask(source, this.maps, { ...options, explain_frame: null }, signal);
    }
  }

  /** The address that asks the same. A file is in no address: the answer to it is. */
  follow(answer) {
    const source = this.source;
    if (!source) return;
    const query = source.query ?? (source.file ? answer?.query_id : undefined);
    const maps = this.maps === "*" || this.maps.join() !== this.map ? { maps: this.maps === "*" ? "*" : this.maps.join() } : {};
    const own = query ? { query } : source.frame ? { frame: source.frame.frame_id } : {};
    this.go(link("maps", this.map, "query", { ...own, ...maps, ...toSearch(this.said), why: this.seen.why ? "open" : null, match: this.seen.match }), { replace: true, quiet: true });
  }

  say(text) { put(this.state, text); }
}
