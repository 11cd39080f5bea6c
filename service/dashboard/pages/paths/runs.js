// The runs of a map in its picture: where they went, what joins them, and the query of an answer
// among them.

import { at } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { count, things } from "../lib/format.js";
import { followJob, goesOn } from "../lib/products.js";
import { plain } from "../lib/prose.js";
import { go } from "../lib/router.js";
import { may } from "../lib/session.js";
import { toast } from "../lib/states.js";
import { axesFor, uprightOf } from "../plan/axes.js";
import { multiply, ofRows } from "../viewer/matrix.js";
import { askedPanel } from "./asked.js";
import { associationsPanel, begin, kindOf, undo } from "./associations.js";
import { chooser } from "./card.js";
import { commonest, edgesOf, MOST_DRAWN, MOST_RUNS, pathOf } from "./data.js";
import { bridges, reach } from "./joined.js";
import { leftOut, legend } from "./legend.js";
import { placeOf } from "./shapes.js";
import { edgesTable, runsTable } from "./tables.js";

export class Runs {
  #paths = new Map(); // by run, as they were fetched
  /** @type {any[]} */
  #drawn = [];
  #hidden = new Set();
  /** @type {any} of the association that is drawn */
  #edges = null;
  #turn = 0;
  /** @type {import("./joined.js").Bridge[]} */
  #joins = [];
  /** @type {Map<string, any>} */
  #reached = new Map();

  /**
   * @param {{map: string, signal: AbortSignal, search: URLSearchParams, scene: import("./scene.js").Scene,
   *   runs: import("./data.js").Run[], without: any[], more: boolean, associations: any[], asked: any,
   *   names: string[], onframe: (parent: string, reached: Map<string, any>, up: string | null,
   *   poses: (() => {origin: number[], up: any}) | null) => boolean, onchange: () => void,
   *   onreveal: () => void}} told more: whether the map has more runs than these; names: other parent
   *   frames that can be drawn, the best first; onframe: begins the picture of a parent frame, which
   *   it may put off until poses are there: false; onchange: the address follows; onreveal: a frame
   *   was chosen
   */
  constructor(told) {
    const { search } = told;
    this.map = told.map;
    this.signal = told.signal;
    this.scene = told.scene;
    this.runs = told.runs;
    this.without = told.without;
    this.more = told.more;
    this.associations = told.associations;
    this.asked = told.asked?.gone ? null : told.asked;
    this.gone = told.asked?.gone ?? null;
    this.onframe = told.onframe;
    this.onchange = told.onchange;
    this.onreveal = told.onreveal;
    this.#joins = bridges(this.associations);
    this.names = [...new Set([...told.names, ...this.runs.map((one) => one.parent)])];
    this.parent = [search.get("parent"), this.asked?.parent, told.names[0], commonest(this.runs)].find((one) => one && this.names.includes(one)) ?? "";
    this.joined = search.get("joined") !== "no";
    const wanted = search.get("association");
    const over = this.associations.find((one) => one.state === "succeeded");
    this.association = wanted === null ? over ?? null : this.associations.find((one) => one.job_id === wanted) ?? null;
    this.up = ["z", "y", "-y"].includes(search.get("up") ?? "") ? search.get("up") : null;
    this.card = chooser({
      map: this.map, signal: this.signal, onchoose: (one) => this.choose(one),
      onapproach: () => { const one = this.card.chosen; if (one) this.scene.approach(this.#drawn[one.path].world[one.place]); },
    });
    this.parents = h("select", { id: "paths-parent", onChange: () => this.show(this.parents.value) });
    this.together = h("input", { type: "checkbox", id: "paths-joined", checked: this.joined, onChange: () => { this.joined = this.together.checked; this.draw(); } });
    this.ups = h("select", { id: "paths-up", onChange: () => { this.up = this.ups.value || null; this.draw(); } },
      [["", "Auto"], ["z", "z"], ["y", "y"], ["-y", "−y"]].map(([value, text]) => h("option", { value, selected: (this.up ?? "") === value }, text)));
    this.said = h("p", { class: "visually-hidden", role: "status" });
    this.asks = h("div", { hidden: true });
    this.runsBox = h("div", {});
    this.joinsBox = h("div", {});
    this.words = h("details", { class: "card paths-words" });
    this.section = h("section", { class: "card paths-section", "aria-labelledby": "paths-runs" }, h("h2", { id: "paths-runs" }, "Runs"),
      h("div", { class: "paths-frames" }, h("label", { class: "field" }, h("span", {}, "Drawn in the frame"), this.parents),
        h("label", { class: "field" }, h("span", {}, "Up axis"), this.ups)),
      h("label", { class: "paths-check" }, this.together, h("span", {}, "Include frames joined to it by associations")),
      this.runsBox);
    for (const one of this.associations.filter(goesOn)) this.#follow(one.job_id);
  }

  /** Draw another parent frame. @param {string} parent */
  show(parent) {
    this.parent = parent;
    return this.draw();
  }

  /** Draw what the choices say; what was fetched before is not fetched again. */
  async draw() {
    const turn = this.#turn += 1;
    this.#reached = this.joined ? reach(this.parent, this.#joins) : reach(this.parent, []);
    const wanted = this.runs.filter((one) => this.#reached.has(one.parent));
    const shown = wanted.slice().sort((a, b) => (b.last ?? "").localeCompare(a.last ?? "")).slice(0, MOST_DRAWN)
      .sort((a, b) => a.number - b.number);
    const early = this.onframe(this.parent, this.#reached, this.up, null);
    const found = await Promise.all(shown.map((run) => this.#path(run, shown.length)));
    if (turn !== this.#turn || this.signal.aborted) return;
    const whole = found.filter((one) => one.ids?.length);
    this.#drawn = whole.map((one) => {
      const { matrix, over } = this.#reached.get(one.parent);
      return { ...one, over, world: one.poses.map((pose) => multiply(matrix, pose)) };
    });
    this.#hidden = new Set();
    if (!early) {
      const above = uprightOf(this.#drawn.map((one) => ({ poses: one.world, isCloud: one.isCloud }))), [first] = this.#drawn;
      this.onframe(this.parent, this.#reached, this.up, () => ({ origin: first ? placeOf(first.world[0]) : [0, 0, 0], up: { above, ahead: axesFor(above).y } }));
    }
    this.scene.show(this.#drawn);
    this.card.paths(this.#drawn);
    this.#ask();
    if (!early || this.scene.viewer.isFitted) this.scene.look("keep");
    this.#runs(wanted, shown, found);
    await this.#association();
    this.onchange();
  }

  async #path(run, share) {
    const key = `${run.number} ${Math.max(share, 4)}`; // few runs are fetched with the same share
    if (!this.#paths.has(key)) {
      try {
        this.#paths.set(key, await pathOf(this.map, run, Math.max(share, 4), this.signal));
      } catch (error) {
        if (error.status !== 422) throw error;
        return { ...run, why: plain(error.detail) };
      }
    }
    return this.#paths.get(key);
  }

  #runs(wanted, shown, found) {
    put(this.parents, this.names.slice().sort().map((one) => h("option", { value: one, selected: one === this.parent }, one)));
    const without = [...this.without];
    for (const one of found) {
      if (!one.ids?.length) without.push({ name: one.session, frames: one.frames, why: one.why ?? "the parent frame of its poses is not available" });
    }
    const say = (run, why) => without.push({ name: run.session, frames: run.frames, why });
    for (const run of wanted) if (!shown.includes(run)) say(run, `older than the ${MOST_DRAWN} runs drawn`);
    for (const run of this.runs) {
      if (!wanted.includes(run)) say(run, `poses in ${run.parent}, which no association joins to ${this.parent}`);
    }
    const list = h("div", { class: "paths-runs" });
    put(list, legend(this.#drawn, this.#hidden, () => this.scene.hide(this.#hidden)));
    const many = this.more && h("p", { class: "muted" }, `From the first ${count(MOST_RUNS)} runs of the map.`);
    put(this.runsBox, list, leftOut(without), many);
    put(this.said, `${things(this.#drawn.length, "run is", "runs are")} drawn in ${this.parent}, ${count(without.length)} not.`);
  }

  #ask() {
    this.asks.hidden = !this.asked && !this.gone;
    if (this.gone) {
      put(this.asks, h("section", { class: "card paths-section" }, h("h2", {}, "Query"),
        h("p", { class: "muted" }, "Its answer has expired: answers are stored while there is room. Query again to see it here.")));
      return;
    }
    if (!this.asked) { this.scene.ask(null); return; }
    const { asked } = this, join = this.#reached.get(asked.parent)?.matrix;
    const drawn = Boolean(join);
    put(this.asks, askedPanel(asked, {
      drawn, onshow: () => this.show(asked.parent),
      onclose: () => { this.asked = null; this.#ask(); this.onchange(); },
    }));
    const camera = this.#drawn.find((one) => one.camera)?.camera ?? null;
    this.scene.ask(drawn ? {
      pose: asked.pose && multiply(join, asked.pose), axes: asked.axes,
      alternatives: asked.alternatives.map((one) => multiply(join, ofRows(one.pose.matrix))),
      turn: join, camera: asked.kind === "cloud" ? null : camera,
      matches: asked.matches.filter((one) => this.#reached.has(one.parent))
        .map((one) => {
          const { matrix } = this.#reached.get(one.parent);
          return { pose: multiply(matrix, one.pose), voted: multiply(matrix, one.voted), camera: this.#cameraOf(one) };
        }),
    } : null);
  }

  // of the run that a match is from: a map can hold depth images and clouds; null of a cloud
  #cameraOf({ frame, parent }) {
    const run = this.#drawn.find((one) => one.ids.includes(frame)) ?? this.#drawn.find((one) => one.parent === parent);
    return run && !run.isCloud ? run.camera : null;
  }

  /** Fetch and draw the edges of the association that is chosen. */
  async #association() {
    const one = this.association;
    /** @type {Object<string, any> | null} */
    let told = null;
    if (one?.state === "succeeded") {
      if (this.#edges?.of !== one.job_id) {
        const found = await edgesOf(this.map, one.job_id, this.signal);
        if (one.job_id !== this.association?.job_id) return; // another was chosen meanwhile
        this.#edges = { of: one.job_id, ...found };
      }
      const drawn = this.#edges.edges.map((edge) => ({ kind: kindOf(edge), from: this.#end(edge.from_pose), to: this.#end(edge.to_pose) }))
        .filter((edge) => edge.from && edge.to);
      this.scene.edges(drawn);
      told = { ...this.#edges, drawn: drawn.length };
    } else {
      this.scene.edges([]);
    }
    this.#panel(told);
  }

  #panel(told) {
    put(this.joinsBox, associationsPanel({
      associations: this.associations, chosen: this.association, edges: told, maywrite: may("write", this.map),
      onchoose: async (id) => {
        this.association = this.associations.find((one) => one.job_id === id) ?? null;
        await this.#association();
        this.onchange();
        document.getElementById("paths-association")?.focus();
      },
      onbegin: () => begin(this.map, this.runs.filter((one, i, all) => all.findIndex((other) => other.session === one.session && other.robot === one.robot) === i), (begun) => this.#begun(begun)),
      // runs are other ones then: all is fetched again
      onundo: async () => { if (await undo(this.map, this.association.job_id)) go(location.hash, { replace: true }); },
    }));
    put(this.words, h("summary", {}, "Tables"), h("h3", {}, "Runs"), runsTable(this.#drawn, this.parent),
      told && [h("h3", {}, "Edges"), edgesTable(this.map, told.edges, told.more)]);
  }

  // where a frame of an edge is in the picture; null where it is not
  #end(pose) {
    const reached = pose && this.#reached.get(pose.parent_frame);
    return reached ? placeOf(multiply(reached.matrix, ofRows(pose.matrix))) : null;
  }

  #begun(one) {
    this.associations.unshift(one);
    this.association = one;
    this.#panel(null);
    this.scene.edges([]);
    this.#follow(one.job_id);
    this.onchange();
  }

  async #follow(id) {
    await followJob(at("maps", this.map, "associations", id), async (now) => {
      const place = this.associations.findIndex((one) => one.job_id === id);
      if (now === null) { this.associations.splice(place, 1); this.#panel(null); return; } // somebody deleted it
      const shown = this.association?.job_id === id;
      this.associations[place] = now;
      if (shown) this.association = now;
      if (now.state === "succeeded") {
        this.#joins = bridges(this.associations);
        await this.draw();
        put(this.said, `The association has succeeded: ${count(now.result.edges)} edges.`);
        return;
      }
      if (!goesOn(now)) toast(`The association ${now.state === "cancelled" ? "was cancelled" : "failed"}. ${now.error ?? ""}`, { kind: "bad" });
      if (shown) this.#panel(null);
    }, this.signal);
  }

  /** Mark a frame and tell of it. @param {{path: number, place: number} | null} one */
  choose(one) {
    this.card.show(one);
    this.scene.select(one);
    if (one) this.onreveal();
  }

  /** Other parent frames can be drawn. @param {string[]} names */
  add(names) {
    this.names = [...new Set([...this.names, ...names])];
    if (!this.parent) this.parent = this.names[0];
  }

  /** Poses of a parent frame in that of the picture; null of one that is not drawn. @param {string} parent
   * @returns {number[] | null} */
  reached(parent) { return this.#reached.get(parent)?.matrix ?? null; }

  /** A camera of the map, to draw one of which nothing else is known. */
  get camera() { return this.#drawn.find((one) => one.camera)?.camera ?? null; }

  /** What is drawn, for the address. */
  get search() {
    return {
      query: this.asked?.id ?? this.gone, parent: this.parent, joined: this.joined ? null : "no", up: this.up,
      association: this.association?.job_id ?? (this.associations.length ? "none" : null),
    };
  }
}
