// The map view: where all runs went, what joins them, and the query of an answer among them.

import { h, put } from "../lib/dom.js";
import { count } from "../lib/format.js";
import { plain } from "../lib/prose.js";
import { link } from "../lib/router.js";
import { may } from "../lib/session.js";
import { empty } from "../lib/states.js";
import { multiply, ofRows } from "../viewer/matrix.js";
import { answerOf, askedPanel } from "./asked.js";
import { associationsPanel, begin, follow, goesOn, kindOf } from "./associations.js";
import { chooser } from "./card.js";
import { associationsOf, edgesOf, MOST_DRAWN, MOST_RUNS, pathOf, runsOf, sessionsOf } from "./data.js";
import { bridges, reach } from "./joined.js";
import { leftOut, legend } from "./legend.js";
import { createScene } from "./scene.js";
import { placeOf } from "./shapes.js";
import { edgesTable, runsTable } from "./tables.js";

export const styles = ["paths/paths.css", "query/alternatives.css"];

export async function render(root, { params: { map }, search, signal, go }) {
  const query = search.get("query");
  const [sessions, associations, asked] = await Promise.all([
    sessionsOf(map, signal), associationsOf(map, signal),
    query ? answerOf(query, map, signal).catch(missing) : null,
  ]);
  const { runs, without } = runsOf(sessions.items);
  if (!runs.length) {
    put(root, nothing(map, without));
    return;
  }
  new Page(root, { map, search, signal, go, runs, without, more: sessions.more, associations, asked });
  await root.drawn;
}

/** An answer that is kept no more is no reason to show no map. */
function missing(error) {
  if (error.status !== 404) throw error;
  return { gone: true };
}

function nothing(map, without) {
  const text = without.length
    ? "Its frames have no poses or no session. Send `pose`, `session` and `captured_at` with a frame, or edit them."
    : "Upload frames with poses to see the paths of the robots here.";
  const upload = may("write", map) && h("a", { class: "button primary", href: link("maps", map, "upload") }, "Upload frames");
  const box = empty({ title: "There is no path to draw", text, actions: upload });
  const list = leftOut(without);
  if (list) box.append(list);
  return box;
}

class Page {
  #paths = new Map(); // by run, as they were fetched
  /** @type {ReturnType<typeof createScene>} */
  scene;
  /** @type {ReturnType<typeof chooser>} */
  card;
  /** @type {HTMLSelectElement} */
  parents;
  /** @type {HTMLSelectElement} */
  ups;
  /** @type {HTMLInputElement} */
  together;
  /** @type {HTMLElement} */
  said;
  /** @type {HTMLElement} */
  asks;
  /** @type {HTMLElement} */
  runsBox;
  /** @type {HTMLElement} */
  joinsBox;
  /** @type {HTMLElement} */
  words;
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

  constructor(root, told) {
    this.map = told.map;
    this.signal = told.signal;
    this.go = told.go;
    this.search = told.search;
    this.runs = told.runs;
    this.without = told.without;
    this.more = told.more; // whether the map has more runs than it told
    this.associations = told.associations;
    this.asked = told.asked?.gone ? null : told.asked;
    this.gone = Boolean(told.asked?.gone);
    this.#joins = bridges(this.associations);
    const { search } = told;
    const known = new Set(this.runs.map((one) => one.parent));
    this.parent = [search.get("parent"), this.asked?.parent, most(this.runs)].find((one) => known.has(one));
    this.joined = search.get("joined") !== "no";
    const wanted = search.get("association");
    const over = this.associations.find((one) => one.state === "succeeded");
    this.association = wanted === null ? over ?? null : this.associations.find((one) => one.association_id === wanted) ?? null;
    this.up = ["z", "y", "-y"].includes(search.get("up")) ? search.get("up") : null;
    this.#build(root);
    root.drawn = this.#draw();
    for (const one of this.associations.filter(goesOn)) this.#follow(one.association_id);
  }

  #build(root) {
    const stage = h("div", { class: "paths-stage" });
    this.scene = createScene(stage, { signal: this.signal, onpick: (path, place) => this.#choose({ path, place }) });
    this.card = chooser({
      map: this.map, signal: this.signal, onchoose: (one) => this.#choose(one),
      onapproach: () => { const one = this.card.chosen; if (one) this.scene.approach(this.#drawn[one.path].world[one.place]); },
    });
    const button = (text, onClick) => h("button", { class: "button", type: "button", onClick }, text);
    this.parents = h("select", { id: "paths-parent", onChange: () => { this.parent = this.parents.value; this.#draw(); } });
    this.together = h("input", { type: "checkbox", id: "paths-joined", checked: this.joined, onChange: () => { this.joined = this.together.checked; this.#draw(); } });
    this.ups = h("select", { id: "paths-up", onChange: () => { this.up = this.ups.value || null; this.#draw(); } },
      [["", "Up axis: auto"], ["z", "Up axis: z"], ["y", "Up axis: y"], ["-y", "Up axis: −y"]].map(([value, text]) => h("option", { value, selected: (this.up ?? "") === value }, text)));
    this.ups.setAttribute("aria-label", "Up axis");
    this.said = h("p", { class: "visually-hidden", role: "status" });
    this.asks = h("div", { hidden: true });
    this.runsBox = h("div", {});
    this.joinsBox = h("div", {});
    this.words = h("details", { class: "card paths-words" });
    put(root, h("div", { class: "paths" },
      h("div", { class: "paths-main" },
        h("div", { class: "toolbar" }, button("Fit", () => this.scene.look("keep")), button("From the side", () => this.scene.look("side")),
          button("From above", () => this.scene.look("top")), h("div", { class: "paths-up" }, this.ups)),
        stage, this.card.element, this.words),
      h("div", { class: "paths-side" }, this.asks,
        h("section", { class: "card paths-section", "aria-labelledby": "paths-runs" }, h("h2", { id: "paths-runs" }, "Runs"),
          h("label", { class: "field" }, h("span", {}, "Drawn in the frame"), this.parents),
          h("label", { class: "paths-check" }, this.together, h("span", {}, "and frames joined to it by associations")),
          this.runsBox),
        this.joinsBox), this.said));
  }

  /** Draw what the choices say; what was fetched before is not fetched again. */
  async #draw() {
    const turn = this.#turn += 1;
    this.#reached = this.joined ? reach(this.parent, this.#joins) : reach(this.parent, []);
    const wanted = this.runs.filter((one) => this.#reached.has(one.parent));
    const shown = wanted.slice().sort((a, b) => (b.last ?? "").localeCompare(a.last ?? "")).slice(0, MOST_DRAWN)
      .sort((a, b) => a.number - b.number);
    const found = await Promise.all(shown.map((run) => this.#path(run, shown.length)));
    if (turn !== this.#turn || this.signal.aborted) return;
    const whole = found.filter((one) => one.ids?.length);
    this.#drawn = whole.map((one) => {
      const { matrix, over } = this.#reached.get(one.parent);
      return { ...one, over, world: one.poses.map((pose) => multiply(matrix, pose)) };
    });
    this.#hidden = new Set();
    const poses = this.#drawn.reduce((sum, one) => sum + one.ids.length, 0);
    this.scene.show(this.#drawn, `Paths of ${count(this.#drawn.length)} runs, ${count(poses)} poses`, this.up);
    this.card.paths(this.#drawn);
    this.#ask();
    this.scene.look("side");
    this.#runs(wanted, shown, found);
    await this.#association();
    this.#address();
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
    const names = [...new Set(this.runs.map((one) => one.parent))].sort();
    put(this.parents, names.map((one) => h("option", { value: one, selected: one === this.parent }, one)));
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
    put(this.said, `${count(this.#drawn.length)} runs are drawn in ${this.parent}, ${count(without.length)} are not.`);
  }

  #ask() {
    this.asks.hidden = !this.asked && !this.gone;
    if (this.gone) {
      put(this.asks, h("section", { class: "card paths-section" }, h("h2", {}, "Query"),
        h("p", { class: "muted" }, "Its answer has expired: answers are stored for an hour. Query again to see it here.")));
      return;
    }
    if (!this.asked) { this.scene.ask(null); return; }
    const { asked } = this, join = this.#reached.get(asked.parent)?.matrix;
    const drawn = Boolean(join);
    put(this.asks, askedPanel(asked, {
      drawn, onshow: () => { this.parent = asked.parent; this.#draw(); },
      onclose: () => { this.asked = null; this.#ask(); this.#address(); },
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
      if (this.#edges?.of !== one.association_id) {
        const found = await edgesOf(this.map, one.association_id, this.signal);
        if (one.association_id !== this.association?.association_id) return; // another was chosen meanwhile
        this.#edges = { of: one.association_id, ...found };
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
        this.association = this.associations.find((one) => one.association_id === id) ?? null;
        await this.#association();
        this.#address();
        document.getElementById("paths-association")?.focus();
      },
      onbegin: () => begin(this.map, this.runs.filter((one, i, all) => all.findIndex((other) => other.session === one.session && other.robot === one.robot) === i), (begun) => this.#begun(begun)),
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
    this.#follow(one.association_id);
    this.#address();
  }

  async #follow(id) {
    await follow(this.map, id, async (now) => {
      const place = this.associations.findIndex((one) => one.association_id === id);
      const shown = this.association?.association_id === id;
      this.associations[place] = now;
      if (shown) this.association = now;
      if (now.state === "succeeded") {
        this.#joins = bridges(this.associations);
        await this.#draw();
        put(this.said, `The association has succeeded: ${count(now.result.edges)} edges.`);
      } else if (shown) {
        this.#panel(null);
      }
    }, this.signal);
  }

  #choose(one) {
    this.card.show(one);
    this.scene.select(one);
  }

  /** The address says what is shown, so that it survives a reload. */
  #address() {
    const search = {
      query: this.asked?.id ?? (this.gone ? this.search.get("query") : null), parent: this.parent,
      joined: this.joined ? null : "no", up: this.up,
      association: this.association?.association_id ?? (this.associations.length ? "none" : null),
    };
    this.go(link("maps", this.map, "paths", search), { replace: true, quiet: true });
  }
}

/** The frame that most frames have poses in. @param {import("./data.js").Run[]} runs */
function most(runs) {
  const counts = new Map();
  for (const one of runs) counts.set(one.parent, (counts.get(one.parent) ?? 0) + one.frames);
  return [...counts].sort((a, b) => b[1] - a[1] || a[0].localeCompare(b[0]))[0][0];
}
