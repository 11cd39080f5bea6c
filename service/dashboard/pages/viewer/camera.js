// Where one looks from: an orbit about a target. Angles in radians, lengths in metres.

import { add, cornersOf, cross, dot, multiply, parallel, perspective, scale, transformed, viewOf } from "./matrix.js";

/** Angle of view from top to bottom. */
export const VIEW = (45 * Math.PI) / 180;
const STEEPEST = (89 * Math.PI) / 180; // straight down, "up" on the screen would be no direction
/** Share of the picture that is filled when all is shown. */
const FILLED = 0.93;
const NEAREST = 1e-3, FARTHEST = 1e6;
/** What is up, and what lies ahead at azimuth 0: of a camera's optical axes, and of a map's. */
const AXES = {
  "-y": { above: [0, -1, 0], ahead: [0, 0, 1] },
  y: { above: [0, 1, 0], ahead: [0, 0, -1] },
  z: { above: [0, 0, 1], ahead: [0, 1, 0] },
};

/** What is up: an axis, or two directions of unit length at right angles.
 * @typedef {"-y" | "y" | "z" | {above: number[], ahead: number[]}} Up */

export class Orbit {
  /** @param {Up} up */
  constructor(up = "-y") {
    const { above, ahead } = typeof up === "string" ? AXES[up] : up;
    this.above = above;
    this.ahead = ahead;
    this.right = cross(ahead, above);
    this.target = [0, 0, 0];
    this.distance = 5;
    this.azimuth = 0; // turns to the right
    this.elevation = 0.35; // above the target, looking down
    this.flat = false; // a plan: straight down, and nothing is smaller for being farther
  }

  /** Three directions at right angles: to the right of the screen, up it, and into it. */
  axes() {
    const [ca, sa] = [Math.cos(this.azimuth), Math.sin(this.azimuth)];
    const [ce, se] = this.flat ? [0, 1] : [Math.cos(this.elevation), Math.sin(this.elevation)];
    const level = add(scale(this.ahead, ca), scale(this.right, sa));
    const ahead = add(scale(level, ce), scale(this.above, -se));
    const right = add(scale(this.right, ca), scale(this.ahead, -sa));
    return { right, above: cross(right, ahead), ahead };
  }

  eye() {
    return add(this.target, scale(this.axes().ahead, -this.distance));
  }

  /** @param {Partial<Orbit>} where target, distance, azimuth, elevation, flat */
  look({ target, distance, azimuth, elevation, flat }) {
    if (flat !== undefined) this.flat = flat;
    if (target) this.target = [...target];
    if (distance !== undefined) this.distance = Math.min(Math.max(distance, NEAREST), FARTHEST);
    if (azimuth !== undefined) this.azimuth = azimuth;
    if (elevation !== undefined) {
      this.elevation = Math.min(Math.max(elevation, -STEEPEST), STEEPEST);
    }
  }

  orbit(right, up) {
    this.look({ azimuth: this.azimuth + right, elevation: this.elevation + up });
  }

  zoom(factor) {
    this.look({ distance: this.distance * factor });
  }

  /** Move along the screen, by shares of its height: what is grabbed at the target stays put. */
  pan(right, up) {
    const axes = this.axes(), size = 2 * Math.tan(VIEW / 2) * this.distance;
    this.target = add(
      this.target, add(scale(axes.right, -right * size), scale(axes.above, -up * size)));
  }

  /**
   * Keep looking the same way, from as near as shows all of some points.
   * @param {number[][]} points @param {number} aspect width / height
   */
  fit(points, aspect) {
    const axes = this.axes(), [x, y, z] = [axes.right, axes.above, axes.ahead]
      .map((axis) => points.map((p) => dot(p, axis)));
    const most = (values) => values.reduce((a, b) => Math.max(a, b), -Infinity);
    const tall = Math.tan(VIEW / 2) * FILLED, wide = tall * aspect;
    if (this.flat) {
      const ends = [x, y, z].map((values) => [-most(values.map((v) => -v)), most(values)]);
      const [at, size] = [ends.map(([a, b]) => (a + b) / 2), ends.map(([a, b]) => b - a)];
      const target = [axes.right, axes.above, axes.ahead].map((axis, k) => scale(axis, at[k])).reduce(add);
      this.look({ target, distance: Math.max(size[0] / (2 * wide), size[1] / (2 * tall), 1e-2) });
      return;
    }
    // each side of the picture is a plane through the eye that all points must lie behind
    const side = (sign, values, slope) => most(values.map((v, i) => sign * v - slope * z[i]));
    const [left, right] = [side(-1, x, wide), side(1, x, wide)];
    const [below, over] = [side(-1, y, tall), side(1, y, tall)];
    const eye = -Math.max((left + right) / wide, (below + over) / tall) / 2;
    const middle = (most(z) - most(z.map((v) => -v))) / 2;
    const deep = Math.max(middle, eye + 1e-2);
    this.look({
      target: add(add(scale(axes.right, (right - left) / 2), scale(axes.above, (over - below) / 2)),
        scale(axes.ahead, deep)),
      distance: deep - eye,
    });
  }

  /**
   * World to clip coordinates.
   * @param {number} aspect @param {{low: number[], high: number[]}} box of all there is: it is never cut off behind
   */
  projection(aspect, box) {
    const { right, above, ahead } = this.axes(), eye = this.eye();
    const view = viewOf(eye, right, above, ahead);
    let farthest = this.distance, closest = this.distance;
    for (const p of cornersOf(box)) {
      const depth = -transformed(view, p)[2];
      [farthest, closest] = [Math.max(farthest, depth), Math.min(closest, depth)];
    }
    if (this.flat) return multiply(parallel(VIEW, aspect, this.distance, closest - 1, farthest + 1), view);
    const far = farthest * 1.01 + 0.1, near = Math.max(this.distance / 100, far / 5000);
    return multiply(perspective(VIEW, aspect, near, far), view);
  }
}
