// A query laid on a match: what is drawn for each pose, colour and toggle.

import { between, identity, ofRows, transformed } from "../viewer/matrix.js";
import { OUTSIDE, VIOLATION, pointAt } from "../viewer/points.js";
import { crosses, frustum, links } from "../viewer/shapes.js";

const TURN_MS = 450;
/** Length of a cross, of a frustum and of a free direction, as shares of what is seen. */
const CROSS = 0.016, CAMERA = 0.07, POINT = 0.7;
const MOST_CROSSES = 2000;
/** Half the surface of a box. */
const box = ([a, b, c]) => a * b + b * c + a * c;
const STRIDE = 25; // of all points that violate, as evidence counts every 25th

/**
 * @typedef {object} Shown
 * @property {"before" | "aligned" | "rival"} pose that is shown, or being turned to
 * @property {number} share of the way to `turned`
 * @property {"source" | "normal" | "residual"} colour
 * @property {Set<string>} hidden of query, match, patches, violations, cameras, free
 */

export class Scene {
  /**
   * @param {import("../viewer/viewer.js").Viewer} viewer
   * @param {Object<string, any>} details of the match, as the API tells them
   * @param {Object<string, {query: import("../viewer/points.js").Points, match: any}>} sets points
   *   with residuals, by pose
   * @param {{query: Object<string, any> | null, match: Object<string, any> | null}} cameras intrinsics
   * @param {Shown} shown @param {() => void} changed the share or the pose has
   */
  constructor(viewer, details, sets, cameras, shown, changed) {
    this.viewer = viewer;
    this.details = details;
    this.sets = sets;
    this.shown = shown;
    this.changed = changed;
    this.goals = { before: identity() };
    if (details.transform) this.goals.aligned = ofRows(details.transform.matrix);
    if (details.rival) this.goals.rival = ofRows(details.rival.matrix);
    /** What `share` leads to. @type {Shown["pose"] | null} */
    this.turned = shown.pose === "before" ? this.first : shown.pose;
    this.matrix = this.goals[shown.pose];
    this.timer = 0;
    const { query, match } = sets.aligned;
    this.size = Math.max(Math.hypot(...query.extent), Math.hypot(...match.extent), 0.1);
    // smaller than their spacing: where both lie on one surface, both are seen
    const size = (points) => POINT * Math.sqrt(box(points.extent) / Math.max(points.count, 1));
    viewer.cloud("query", { points: query, tint: "query", size: size(query) });
    viewer.cloud("match", { points: match, tint: "match", size: size(match) });
    const lens = (camera) => frustum(camera, this.size * CAMERA);
    // where both are in one place, both are seen
    viewer.lines("query camera", { positions: lens(cameras.query), tint: "query", width: 2 });
    viewer.lines("match camera", { positions: lens(cameras.match), tint: "match", width: 4 });
    this.free();
    this.paint();
    viewer.look({ azimuth: 0.45, elevation: 0.4 });
    this.fit();
  }

  fit() {
    const whole = ["query", "match"];
    this.viewer.fit(this.shown.hidden.has("cameras") ? whole : [...whole, "query camera", "match camera"]);
  }

  /** The pose that is turned to from "before": null where there is none. @returns {"aligned" | null} */
  get first() {
    return this.goals.aligned ? "aligned" : null;
  }

  cross(id, points) {
    const positions = crosses(points.slice(0, MOST_CROSSES), this.size * CROSS);
    this.viewer.lines(id, { positions, tint: "violation", width: 2, onTop: true });
  }

  /** Directions in which the transform is hardly held, both ways from the query's camera. */
  free() {
    const { uncertainty, transform } = this.details;
    if (!uncertainty?.degenerate.length || !transform) return;
    const { x, y, z } = transform.translation, at = [x, y, z], out = [];
    for (const { translation: t, deviation } of uncertainty.degenerate) {
      const reach = Math.min(Math.max(deviation, this.size * 0.1), this.size);
      const way = [t.x, t.y, t.z].map((v) => v * reach);
      out.push(...at.map((v, k) => v - way[k]), ...at.map((v, k) => v + way[k]));
    }
    this.viewer.lines("free", { positions: new Float32Array(out), tint: "accent", width: 3, onTop: true });
  }

  /** Set what is drawn to what is shown; the matrices follow by themselves. */
  paint() {
    const { viewer, shown, details } = this;
    const own = this.sets[shown.pose], set = (shown.colour === "residual" && own) || this.sets.aligned;
    // residuals of another pose would be untrue: until its own have come there are none
    const colour = { source: "tint", normal: "normal", residual: own ? "residual" : "tint" }[shown.colour];
    const seen = (name) => !shown.hidden.has(name);
    const isWhole = shown.pose !== "before" && shown.share === 1; // evidence is of the whole pose
    if (isWhole) this.crossesOf(shown.pose);
    for (const side of ["query", "match"]) {
      viewer.cloud(side, { points: set[side], colour, visible: seen(side) });
      viewer.lines(`${side} camera`, { visible: seen("cameras") && seen(side) });
      viewer.lines(`violations of ${side}`, {
        visible: isWhole && seen("violations") && seen(side) && shown.colour !== "residual",
      });
    }
    if (viewer.has("free")) viewer.lines("free", { visible: seen("free") && shown.pose === "aligned" && isWhole });
    this.place();
    const isLinked = seen("patches") && shown.pose !== "rival" && this.turned === "aligned";
    if (details.patches) viewer.lines("patches", { visible: isLinked });
  }

  /** Everything of the query where its matrix puts it. */
  place() {
    const { viewer, matrix, details } = this;
    for (const id of ["query", "query camera", "violations of query"]) {
      if (viewer.has(id)) viewer[id === "query" ? "cloud" : "lines"](id, { matrix });
    }
    if (details.patches) {
      const from = details.patches.query_mean.map((p) => transformed(matrix, p).slice(0, 3));
      const positions = links(from, details.patches.match_mean);
      viewer.lines("patches", { positions, tint: "ink", width: 1.5, onTop: true });
    }
  }

  /** Part of the way from where the cameras saw them to the pose last turned to. */
  blend(share) {
    cancelAnimationFrame(this.timer);
    if (!this.turned) return;
    this.shown.share = share;
    this.shown.pose = share > 0 ? this.turned : "before";
    this.matrix = between(this.goals.before, this.goals[this.turned], share);
    this.paint();
    this.changed();
  }

  /** Turn to a pose, in a moment rather than at once: the eye follows what belongs together. */
  turn(pose) {
    cancelAnimationFrame(this.timer);
    const { shown } = this, from = this.matrix, to = this.goals[pose];
    const begun = performance.now(), first = shown.share, last = pose === "before" ? 0 : 1;
    const isCalm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    if (pose !== "before") this.turned = pose;
    shown.pose = pose;
    const step = (now) => {
      const t = isCalm ? 1 : Math.min(Math.max((now - begun) / TURN_MS, 0), 1);
      const eased = t * t * (3 - 2 * t);
      this.matrix = between(from, to, eased);
      shown.share = t === 1 ? last : first + (last - first) * eased;
      if (t === 1) this.paint();
      else this.place();
      this.changed();
      if (t < 1) this.timer = requestAnimationFrame(step);
    };
    this.paint();
    step(begun);
  }

  /** Points with the residuals of another pose have come. */
  add(pose, set) {
    this.sets[pose] = set;
    if (pose === this.shown.pose) this.paint();
  }

  /** Whose violations the crosses are: those of the details, or of the rival's points. */
  crossesOf(pose) {
    const { details, sets } = this, of = pose === "rival" ? sets.rival ?? pose : details;
    if (this.crossed === of) return;
    this.crossed = of;
    for (const side of ["query", "match"]) {
      const told = pose !== "rival" ? details[side]?.violations : sets.rival && violating(sets.rival[side]);
      this.cross(`violations of ${side}`, told ?? []);
    }
  }

  destroy() {
    cancelAnimationFrame(this.timer);
  }
}

function violating(points) {
  const out = [];
  for (let i = 0; i < points.count; i += 1) {
    const one = pointAt(points, i);
    if (one.residual === VIOLATION) out.push(one.position);
  }
  return out.filter((_, i) => i % STRIDE === 0);
}

/** What the points of both say, counted. @param {Uint32Array[]} counts of `residualCounts`, of both clouds */
export function tally(counts) {
  const sum = (low, high) => counts.reduce(
    (total, one) => total + one.subarray(low, high + 1).reduce((a, b) => a + b, 0), 0);
  const told = {
    fifth: sum(0, 50), half: sum(51, 100), all: sum(101, 250), outside: sum(OUTSIDE, OUTSIDE),
    violations: sum(VIOLATION, VIOLATION),
  };
  return { ...told, agree: sum(0, 250), total: sum(0, 254) };
}
