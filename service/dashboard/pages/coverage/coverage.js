// Where a robot would get lost: results of coverage jobs as plans, begun, followed and compared here.
import { at, get, list, save, send } from "../lib/api.js";
import { h, once, put } from "../lib/dom.js";
import { count, metres, percent, time } from "../lib/format.js";
import { followJob, goesOn } from "../lib/products.js";
import { link } from "../lib/router.js";
import { may } from "../lib/session.js";
import { confirm, empty, toast } from "../lib/states.js";
import { flat, nameOf } from "../plan/axes.js";
import { cornersOf, laySurface, surfaceOf, unseen } from "../plan/backdrop.js";
import { Plan } from "../plan/plan.js";
import { beginCoverage, cancelCoverage } from "./measurement.js";
import { checkedIn, outcomeMark, outcomesIn, TRENDS } from "./outcomes.js";
import { areaCard, cellsTable, changesCard, countsCard, worstCard } from "./panels.js";
import { cellAt, drawCells, drawFrames, hit, keyOf } from "./sheet.js";

export const styles = ["plan/plan.css", "coverage/coverage.css"];

const MOST_ASKED = 12; // look-alikes whose places are asked for at once
const FOREVER_S = 1e9;

/** The page: #/maps/NAME/coverage?result=&since=&parent=&cell=&frame= */
export async function render(root, { params: { map }, search, signal, go, actions, about }) {
  const path = at("maps", map, "coverage");
  const [told, sessions, { frames }, surface] = await Promise.all([
    get(path, { params: { limit: 100 }, signal }), get(at("maps", map, "sessions"), { params: { limit: 1000 }, signal }), about, surfaceOf(map, signal)]);
  const page = new Page(root, { map, search, signal, go, all: told.items, surface,
    names: { sessions: distinct(sessions.items, "session"), robots: distinct(sessions.items, "robot") }, indexed: frames.indexed ?? 0 });
  actions(may("write", map) && page.indexed > 0 && h("button", { class: "button primary", type: "button", id: "cover-begin", onClick: () => page.begin() }, "Measure coverage…"));
  await page.show();
  for (const one of told.items.filter(goesOn)) page.follow(one.job_id);
}

const distinct = (items, key) => [...new Set(items.map((one) => one[key]).filter((one) => one !== null))].sort();

class Page {
  /** @type {any} the result that is shown, with its plans */
  shown = null;
  /** @type {any} against an earlier one */
  changes = null;
  /** @type {Object<string, any>[]} queried frames */
  frames = [];
  /** @type {Map<string, {parent: string, at: number[]} | null>} of frames that were not queried */
  places = new Map();
  /** @type {any} of the plan that is shown */
  axes = null;
  /** @type {any[]} queried frames on it, with where they stand */
  drawn = [];
  #turn = 0;

  constructor(root, { map, search, signal, go, all, surface, names, indexed }) {
    this.map = map;
    this.signal = signal;
    this.go = go;
    this.all = all; // coverage jobs, the newest first
    this.surface = surface;
    this.isTabled = false; // whether the table of cells is unfolded
    this.laid = ""; // the parent frame whose surface is under the plan
    this.names = names;
    this.indexed = indexed;
    this.area = h("div", {});
    this.path = at("maps", map, "coverage");
    /** @type {Object<string, string | null>} what the address says */
    this.seen = Object.fromEntries(["result", "since", "parent", "cell", "frame"].map((name) => [name, search.get(name)]));
    this.running = h("div", { class: "cover-running" });
    this.body = h("div", { class: "cover-body" });
    this.plan = new Plan({ label: "Plan of the map", signal, onpick: (where, view) => this.#pick(where, view) });
    put(root, this.running, this.body);
  }

  /** The results that are over, the newest first. */
  get results() { return this.all.filter((one) => one.state === "succeeded"); }

  async show() {
    const turn = this.#turn += 1;
    this.#progress();
    const wanted = this.results.find((one) => one.job_id === this.seen.result) ?? this.results[0];
    if (!wanted) { put(this.body, this.#nothing()); return; }
    const id = wanted.job_id;
    const [shown, frames, changes] = await Promise.all([
      get(`${this.path}/${id}`, { signal: this.signal }), list(`${this.path}/${id}/frames`, { signal: this.signal }), this.#changesOf(id)]);
    if (turn !== this.#turn || this.signal.aborted) return;
    Object.assign(this, { shown, frames: frames.items, changes });
    this.#draw();
  }

  async #changesOf(id) {
    if (!this.seen.since || this.seen.since === id) return null;
    try {
      return await get(`${this.path}/${id}/changes`, { params: { since: this.seen.since }, signal: this.signal });
    } catch (error) {
      if (![404, 409, 422].includes(error.status)) throw error;
      toast(error.detail, { kind: "bad" });
      this.seen.since = null;
      return null;
    }
  }

  #nothing() {
    const isBusy = this.all.some(goesOn);
    return empty({
      title: isBusy ? "No result yet" : "Coverage has not been measured",
      text: this.indexed === 0 ? "The map has no indexed frame. Upload frames of the place first."
        : ["It tells where in this map a robot would be found, mistaken for elsewhere, or lost. A job queries the map’s own frames against the rest of it; nothing is changed.",
          !may("write", this.map) && " Your key can only read this map; measuring needs the scope “write”."],
      actions: !isBusy && may("write", this.map) && this.indexed > 0 && h("button", { class: "button primary", type: "button", onClick: () => this.begin() }, "Measure coverage…"),
    });
  }

  /** The plan that is shown: of the parent frame that was chosen. */
  get planned() { return this.shown.plans.find((one) => one.parent_frame === this.seen.parent) ?? this.shown.plans[0] ?? null; }

  #draw() {
    const { result } = this.shown, planned = this.planned;
    const isInside = this.body.contains(document.activeElement), focused = document.activeElement?.id;
    const cells = planned?.cells ?? [], wide = result.cell_m;
    const choose = (cell) => this.#choose({ cell, frame: null });
    const side = [countsCard(result), this.changes && changesCard(this.changes),
      planned && worstCard(cells, wide, this.seen.cell, choose)];
    this.area = h("div", { id: "cover-area-place" });
    put(this.body, this.#toolbar(), h("div", { class: "cover" },
      h("div", { class: "cover-main" }, planned ? this.#sheet(planned) : h("p", { class: "card muted" }, "The queried frames have no poses, so there is no plan. Send a pose with frames to see where they were taken."),
        planned && this.#table(cells, wide, choose)),
      h("div", { class: "cover-side" }, this.area, side)));
    this.#area();
    this.#address();
    // where that was is drawn anew: the keyboard goes on from there, or from the plan
    if (isInside) (document.getElementById(focused ?? "") ?? this.plan.svg).focus({ preventScroll: true });
  }

  #table(cells, wide, choose) {
    const fold = h("details", { class: "card", open: this.isTabled, onToggle: () => { this.isTabled = fold.open; } },
      h("summary", {}, "Cells as a table"), cellsTable(cells, wide, choose));
    return fold;
  }

  #sheet(planned) {
    const { result } = this.shown, wide = result.cell_m;
    const right = nameOf(planned.x_axis), top = nameOf(planned.y_axis);
    const whence = { map: "", frames: "", cameras: " Up is guessed from the cameras: give the map its up vector if this is a side view." }[planned.up_from];
    const changed = this.changes?.plans.find((one) => one.parent_frame === planned.parent_frame);
    this.axes = { x: planned.x_axis, y: planned.y_axis };
    this.drawn = this.frames.filter((one) => one.position && one.parent_frame === planned.parent_frame)
      .map((one) => ({ ...one, at: this.#flat(one.position) }));
    this.#links(); // beneath the numbers of cells
    drawCells(this.plan, changed ? changed.cells : planned.cells, wide, this.seen.cell);
    this.plan.label(`Plan of ${planned.parent_frame}: ${outcomesIn(result).map(({ name, text }) => `${result[name]} ${text.toLowerCase()}`).join(", ")}`);
    put(this.plan.about, `${planned.parent_frame}${right && top ? ` · ${right} → ${top} ↑` : ""}`);
    const corners = /** @type {import("../plan/plan.js").Place[]} */ (planned.cells.flatMap(({ column, row }) => [[column * wide, row * wide], [(column + 1) * wide, (row + 1) * wide]]));
    const fused = this.surface.parents.find((one) => one.parent_frame === planned.parent_frame) ?? null;
    this.plan.bounds([...corners, ...cornersOf(fused, corners)]);
    this.#lay(planned.parent_frame, fused);
    const several = this.shown.plans.length > 1 && h("label", { class: "cover-field" }, h("span", { class: "muted" }, "Parent frame"),
      h("select", { id: "cover-parent", onChange: (event) => this.#look({ parent: event.target.value, cell: null, frame: null }) },
        this.shown.plans.map((one) => h("option", { value: one.parent_frame, selected: one === planned }, one.parent_frame))));
    return h("section", { class: "card cover-plan", "aria-label": "Plan" }, several, this.plan.element,
      h("ul", { class: "plan-key", "aria-label": "Legend" }, changed
        ? TRENDS.map(({ name, text, sign }) => h("li", {}, h("span", { class: "cover-sign", dataset: { trend: name }, "aria-hidden": "true" }, sign), text))
        : outcomesIn(result).map(({ name, text }) => h("li", {}, outcomeMark(name), text))),
      h("p", { class: "muted cover-note" }, `Cells of ${metres(wide)}; the number is how many frames of the map were taken there. Click a cell or a frame. Drag to move.${whence}`));
  }

  /** The surface under the cells, where it is known. */
  #lay(parent, fused) {
    if (this.laid === parent) return;
    this.laid = parent;
    this.plan.picture(null);
    if (fused) laySurface(this.plan, this.axes, this.map, fused, this.signal).catch(unseen);
  }

  #flat(place) { return flat(this.axes, [place.x, place.y, place.z]); }

  #toolbar() {
    const { job_id: id, created_at: when } = this.shown, same = JSON.stringify(this.shown.request);
    const name = (one) => `${one.created_at.slice(0, 16).replace("T", " ")} · ${percent(one.result.found / Math.max(checkedIn(one.result), 1))} of ${count(one.result.frames)} found`;
    const earlier = this.results.filter((one) => one.created_at < when && JSON.stringify(one.request) === same);
    return h("div", { class: "toolbar cover-bar" },
      h("label", { class: "cover-field" }, h("span", { class: "muted" }, "Result"),
        h("select", { id: "cover-result", onChange: (event) => this.#look({ result: event.target.value, since: null, cell: null, frame: null }) },
          this.results.map((one) => h("option", { value: one.job_id, selected: one.job_id === id }, name(one))))),
      earlier.length > 0 && h("label", { class: "cover-field" }, h("span", { class: "muted" }, "Compare with"),
        h("select", { id: "cover-since", onChange: (event) => this.#look({ since: event.target.value || null }) },
          h("option", { value: "" }, "nothing"),
          earlier.map((one) => h("option", { value: one.job_id, selected: one.job_id === this.seen.since }, name(one))))),
      h("span", { class: "muted cover-when" }, "measured ", time(this.shown.finished_at)),
      h("div", { class: "toolbar", role: "group", "aria-label": "Download" },
        h("button", { class: "button", type: "button", onClick: () => save(`${this.path}/${id}`, { name: `coverage-${this.map}.json` }) }, "JSON"),
        may("write", this.map) && h("button", { class: "button danger", type: "button", onClick: once(() => this.#remove(id)) }, "Delete")));
  }

  #pick(where, view) {
    const { frame, cell } = hit(where, view, this.drawn, this.shown.result.cell_m);
    this.#choose(frame ? { frame: frame.frame_id, cell: cellAt(frame.at, this.shown.result.cell_m) } : { cell: this.seen.cell === cell && !this.seen.frame ? null : cell, frame: null });
  }

  #choose(seen) {
    Object.assign(this.seen, seen);
    this.#draw();
    if (innerWidth < 1100 && this.seen.cell) this.area.scrollIntoView({ block: "nearest" }); // it is below the plan there
  }

  /** What is in the cell that is chosen. */
  #area() {
    const { cell: key, frame } = this.seen, planned = this.planned;
    if (!key || !planned) { put(this.area); return; }
    const wide = this.shown.result.cell_m;
    put(this.area, areaCard({
      map: this.map, key, wide, chosen: frame, cell: planned.cells.find((one) => keyOf(one) === key) ?? null,
      frames: this.drawn.filter((one) => cellAt(one.at, wide) === key),
      onchoose: (id) => this.#choose({ frame: this.seen.frame === id ? null : id }),
      onoverlay: (one, other) => this.#overlay(one, other), onclose: () => this.#choose({ cell: null, frame: null }),
    }));
  }

  /** Lines to look-alikes: of the chosen frame, or of all in the chosen cell. */
  async #links() {
    const wide = this.shown.result.cell_m, { cell, frame } = this.seen;
    const from = this.drawn.filter((one) => (frame ? one.frame_id === frame : cell !== null && cellAt(one.at, wide) === cell));
    const known = new Map(this.drawn.map((one) => [one.frame_id, one.at]));
    const missing = [...new Set(from.flatMap((one) => one.look_alikes))].filter((id) => !known.has(id) && !this.places.has(id)).slice(0, MOST_ASKED);
    const draw = () => drawFrames(this.plan, this.drawn, from.flatMap((one) => one.look_alikes.flatMap((id) => {
      const place = this.places.get(id), to = known.get(id) ?? (place && place.parent === this.planned?.parent_frame ? flat(this.axes, place.at) : null);
      return to ? [{ from: one.at, to }] : [];
    })));
    draw();
    if (missing.length === 0) return;
    const turn = this.#turn;
    await Promise.all(missing.map(async (id) => {
      const pose = (await get(at("maps", this.map, "frames", id), { signal: this.signal }).catch(() => null))?.pose;
      this.places.set(id, pose ? { parent: pose.parent_frame, at: pose.matrix.slice(0, 3).map((row) => row[3]) } : null);
    }));
    if (turn === this.#turn && !this.signal.aborted && this.seen.cell === cell && this.seen.frame === frame) draw();
  }

  /** Query with a frame as the job did, and lay it on what it is mistaken for. */
  async #overlay(one, other) {
    const { request: asked } = this.shown, left = asked.other_sessions ? FOREVER_S : asked.not_within_s;
    const json = { frame_id: one.frame_id, seed: asked.seed, record: false, ...(left > 0 ? { filter: { not_within_s: left } } : {}) };
    let answer;
    try {
      answer = (await send("POST", `${at("maps", this.map)}/queries`, { json, signal: this.signal })).data;
    } catch (error) {
      if (error.status !== 422) throw error; // a frame without a time cannot leave out those near it
      answer = (await send("POST", `${at("maps", this.map)}/queries`, { json: { ...json, filter: undefined }, signal: this.signal })).data;
    }
    const isThere = answer.matches.some((match) => match.frame_id === other && match.transform);
    this.go(isThere ? link("queries", answer.query_id, "matches", other, { map: this.map }) : link("queries", answer.query_id));
  }

  #look(seen) {
    Object.assign(this.seen, seen);
    return this.show();
  }

  #address() {
    const newest = this.results[0]?.job_id, { job_id: id } = this.shown;
    this.go(link("maps", this.map, "coverage", { ...this.seen, result: id === newest ? null : id }), { replace: true, quiet: true });
  }

  /** Jobs that go on, and what can be done about them. */
  #progress() {
    put(this.running, this.all.filter(goesOn).map((one) => {
      const { done = 0, total = null } = one.progress ?? {};
      const text = one.state === "queued" && !done ? "Coverage waits for a worker" : total === null ? "Measuring coverage" : `Measuring coverage: ${count(done)} of ${count(total)} frames queried`;
      return h("section", { class: "card cover-progress", "aria-label": "Coverage under way" },
        h("span", { role: "status" }, text), h("progress", { max: total ?? 1, value: done, "aria-label": "Progress" }),
        may("write", this.map) && h("button", { class: "button", type: "button", onClick: once(() => cancelCoverage(one.job_id)) }, "Cancel"));
    }));
  }

  begin() {
    beginCoverage(this.map, this.names, (begun) => {
      this.all.unshift(begun);
      if (this.results.length === 0) put(this.body, this.#nothing());
      this.#progress();
      this.follow(begun.job_id);
    });
  }

  async follow(id) {
    await followJob(`${this.path}/${id}`, (now) => {
      const place = this.all.findIndex((one) => one.job_id === id);
      if (now === null) { this.all.splice(place, 1); this.show(); return; }
      this.all[place] = now;
      if (goesOn(now)) { this.#progress(); return; }
      if (now.state === "succeeded") { toast("Coverage was measured."); this.#look({ result: id, since: null, cell: null, frame: null }); return; }
      toast(now.state === "cancelled" ? "The measurement was cancelled." : `The measurement failed. ${now.error ?? ""}`, { kind: now.state === "cancelled" ? "good" : "bad" });
      this.show();
    }, this.signal);
  }

  async #remove(id) {
    if (!(await confirm({ title: "Delete this result?", text: "Its counts, plan and frames are deleted. The map’s frames stay.", action: "Delete result" }))) return;
    await send("DELETE", `${this.path}/${id}`);
    this.all = this.all.filter((one) => one.job_id !== id);
    toast("The result was deleted.");
    await this.#look({ result: null, since: null, cell: null, frame: null });
    if (document.activeElement === document.body) document.getElementById("title").focus({ preventScroll: true });
  }
}
