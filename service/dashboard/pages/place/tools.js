// Hands on the place beside looking about: click a spot, measure, drag a box, keep the picture.

import { h, put } from "../lib/dom.js";
import { metres } from "../lib/format.js";
import { VIEW } from "../viewer/camera.js";
import { add, dot, scale, subtract } from "../viewer/matrix.js";
import { links } from "../viewer/shapes.js";

/** CSS pixels: a click on a frame, on a cell, and near a frame where there is no cell. */
const ON_FRAME = 10, ON_CELL = 12, NEAR_FRAME = 28;
/** A drag of fewer is a click. */
const STILL = 4;

export class Tools {
  /** @type {"measure" | "box" | null} */
  tool = null;
  /** @type {number[][]} ends of what is measured, in the frame of the picture */
  #ends = [];
  #drags = false;

  /**
   * @param {{stage: HTMLElement, scene: import("../paths/scene.js").Scene, surface: import("./surface.js").Surface,
   *   onframe: (one: {path: number, place: number}) => void, onspot: (spot: any) => void,
   *   onbox: (corners: number[][]) => void, onplan: () => void}} what onbox: four corners, in the frame
   *   of the picture, in turn; onplan: the picture has to be a plan
   */
  constructor({ stage, scene, surface, onframe, onspot, onbox, onplan }) {
    this.scene = scene;
    this.surface = surface;
    this.onframe = onframe;
    this.onspot = onspot;
    this.onbox = onbox;
    this.onplan = onplan;
    const button = (name, text) => h("button", { class: "button", type: "button", id: `place-${name}`, "aria-pressed": false, onClick: () => this.choose(this.tool === name ? null : name) }, text);
    this.buttons = { measure: button("measure", "Measure"), box: button("box", "Select frames") };
    this.said = h("p", { class: "place-said muted", role: "status" });
    this.frame = h("span", { class: "place-rectangle", hidden: true });
    this.cover = h("button", { class: "place-cover", type: "button", hidden: true, "aria-label": "Drag a box over the plan. Enter takes all that is in view." }, this.frame);
    stage.append(h("span", { class: "place-cross", "aria-hidden": "true" }), this.cover);
    this.#clicks();
    this.#box();
    stage.addEventListener("keydown", (event) => { if (event.key === "Escape") this.choose(null); });
  }

  /** Take another tool in hand. @param {"measure" | "box" | null} tool */
  choose(tool) {
    this.tool = tool;
    for (const [name, one] of Object.entries(this.buttons)) one.setAttribute("aria-pressed", String(name === tool));
    this.cover.hidden = tool !== "box";
    this.#measured([]);
    if (tool === "box") { this.onplan(); this.cover.focus(); }
    put(this.said, tool === "measure" ? "Click two spots; on the keyboard, Enter takes the one in the middle."
      : tool === "box" ? "Drag a box over the plan, or press Enter for all that is in view." : "");
  }

  /** Offer what needs a surface, or not. @param {boolean} isBuilt */
  offer(isBuilt) {
    this.buttons.box.disabled = !isBuilt;
  }

  #clicks() {
    const { canvas } = this.scene;
    /** @type {number[] | null} */
    let down = null;
    canvas.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; });
    canvas.addEventListener("click", (event) => {
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) > STILL) return; // turned
      this.#pick(event.offsetX, event.offsetY);
    });
    canvas.addEventListener("keydown", (event) => {
      if (event.key === "Enter") this.#pick(canvas.clientWidth / 2, canvas.clientHeight / 2);
    });
  }

  #pick(x, y) {
    if (!this.scene.viewer?.available) return;
    const spot = this.surface.spot(x, y, ON_CELL);
    if (this.tool === "measure") {
      const at = spot?.world ?? (this.scene.viewer.orbit.flat ? this.level(x, y) : null);
      if (at) this.#measured(this.#ends.length === 1 ? [...this.#ends, at] : [at]);
      return;
    }
    const frame = this.scene.pick(x, y, spot ? ON_FRAME : NEAR_FRAME);
    if (frame) this.onframe(frame);
    else if (spot) this.onspot(spot);
  }

  /** Where a place of the canvas is on a plan, in the frame of the picture. @param {number} x @param {number} y */
  level(x, y) {
    const { orbit, canvas } = this.scene.viewer, { right, above } = orbit.axes();
    const size = (2 * Math.tan(VIEW / 2) * orbit.distance) / canvas.clientHeight;
    const [u, v] = [(x - canvas.clientWidth / 2) * size, (canvas.clientHeight / 2 - y) * size];
    return add(this.scene.origin, add(orbit.target, add(scale(right, u), scale(above, v))));
  }

  #measured(ends) {
    this.#ends = ends;
    const { viewer } = this.scene;
    if (!viewer) return;
    const near = ends.map((p) => this.scene.near(p));
    if (ends.length < 2) {
      viewer.remove("measure");
      this.scene.mark("measure", near.length ? [{ at: ends[0], node: h("span", { class: "paths-label", dataset: { kind: "measure" } }, "1") }] : []);
      return;
    }
    const apart = subtract(ends[1], ends[0]), length = Math.hypot(...apart);
    const rise = dot(apart, this.scene.axes.above), level = Math.sqrt(Math.max(length ** 2 - rise ** 2, 0));
    viewer.lines("measure", { positions: links([near[0]], [near[1]]), tint: "accent", width: 3, onTop: true });
    this.scene.mark("measure", [{ at: scale(add(ends[0], ends[1]), 0.5), node: h("span", { class: "paths-label", dataset: { kind: "measure" } }, metres(length)) }]);
    put(this.said, `${metres(length)}: ${metres(level)} level, ${metres(Math.abs(rise))} in height.`);
  }

  #box() {
    const { cover, frame } = this;
    /** @type {number[] | null} */
    let from = null;
    const corners = (a, b) => [[Math.min(a[0], b[0]), Math.min(a[1], b[1])], [Math.max(a[0], b[0]), Math.max(a[1], b[1])]];
    const place = (event) => [event.clientX - cover.getBoundingClientRect().left, event.clientY - cover.getBoundingClientRect().top];
    const take = ([low, high]) => {
      this.choose(null);
      this.onbox([low, [high[0], low[1]], high, [low[0], high[1]]].map(([x, y]) => this.level(x, y)));
    };
    cover.addEventListener("pointerdown", (event) => { from = place(event); cover.setPointerCapture(event.pointerId); });
    cover.addEventListener("pointermove", (event) => {
      if (!from) return;
      const [low, high] = corners(from, place(event));
      frame.hidden = false;
      for (const [name, value] of [["left", low[0]], ["top", low[1]], ["width", high[0] - low[0]], ["height", high[1] - low[1]]]) frame.style.setProperty(String(name), `${value}px`);
    });
    cover.addEventListener("pointerup", (event) => {
      if (!from) return;
      const [low, high] = corners(from, place(event));
      from = null;
      frame.hidden = true;
      this.#drags = true; // the click that follows is of this
      if (high[0] - low[0] > STILL && high[1] - low[1] > STILL) take([low, high]);
    });
    cover.addEventListener("click", () => {
      if (this.#drags) { this.#drags = false; return; }
      take([[0, 0], [cover.clientWidth, cover.clientHeight]]);
    });
  }
}

/**
 * Let the browser keep the picture with what floats over it.
 * @param {HTMLElement} stage @param {import("../paths/scene.js").Scene} scene
 * @param {string} caption @param {string} name of the file
 */
export async function keepPicture(stage, scene, caption, name) {
  const { viewer, canvas } = scene, data = viewer.pixels();
  const out = h("canvas", { width: canvas.width, height: canvas.height });
  const pen = /** @type {CanvasRenderingContext2D} */ (out.getContext("2d"));
  pen.putImageData(new ImageData(data, canvas.width, canvas.height), 0, 0);
  pen.scale(canvas.width / canvas.clientWidth, canvas.height / canvas.clientHeight);
  const corner = canvas.getBoundingClientRect();
  for (const one of stage.querySelectorAll(".paths-label, .paths-scale > span, .paths-bar")) {
    if (!(one instanceof HTMLElement) || one.hidden || !one.offsetParent) continue;
    const { left, top, width, height } = one.getBoundingClientRect(), look = getComputedStyle(one);
    pen.fillStyle = look.backgroundColor;
    pen.strokeStyle = look.borderBottomColor;
    const edge = parseFloat(look.borderBottomWidth) || 0;
    pen.beginPath();
    pen.roundRect(left - corner.left, top - corner.top, width, height, parseFloat(look.borderTopLeftRadius) || 0);
    pen.fill();
    pen.lineWidth = edge || 1;
    if (edge > 0) pen.stroke();
    const text = one.childElementCount === 0 ? one.textContent : one.lastElementChild?.childElementCount === 0 ? one.lastElementChild.textContent : "";
    pen.fillStyle = look.color;
    pen.font = `${look.fontWeight} ${look.fontSize} system-ui, sans-serif`;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    const indent = one.childElementCount === 0 ? (width - pen.measureText(text ?? "").width) / 2 : parseFloat(look.paddingRight) || 0;
    pen.fillText(text ?? "", left - corner.left + width - indent, top - corner.top + height / 2);
  }
  const ink = getComputedStyle(document.documentElement).getPropertyValue("--ink");
  pen.fillStyle = ink;
  pen.font = "13px system-ui, sans-serif";
  pen.textAlign = "left";
  pen.fillText(caption, 12, 18);
  const blob = await new Promise((resolve) => { out.toBlob(resolve, "image/png"); });
  const link = h("a", { download: name, href: URL.createObjectURL(/** @type {Blob} */ (blob)) });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000); // the download has begun by then
}
