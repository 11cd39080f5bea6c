// What is drawn: each layer keeps its arrays on this side too, so that it can be made again when
// the context is lost.

import { BESIDE, STEPS, VIOLATES, colourOf, manyColours } from "./colours.js";
import { boxAbout, cornersOf, identity, transformed } from "./matrix.js";
import { boxOf, someOf } from "./points.js";

const MODES = { tint: 0, normal: 1, patch: 2, residual: 3, height: 4 };
const unit = (bytes) => bytes.map((x) => x / 255);

/** The box about a box that has been moved. */
export const movedBox = (box, matrix) => boxAbout(cornersOf(box).map((p) => transformed(matrix, p)));

/** Places of numbers, three each. */
const placesOf = (numbers) => Array.from({ length: numbers.length / 3 }, (_, i) => numbers.slice(3 * i, 3 * i + 3));

/** What a layer is set to has names of its own: see `cloud`, `lines`, `triangles` and `cells` of the viewer. */
const Named = /** @type {new () => any} */ (Object);

export class Layer extends Named {
  /** @type {any} */
  made;
  /** @type {any} */
  fresh;

  constructor(told) {
    super();
    // own, some: bounds, null of nothing, and some points, before the matrix, once computed; made: buffers
    // of the context; fresh: whether they hold what is to be drawn
    Object.assign(this, { own: undefined, some: undefined, made: null, fresh: false, onTop: false, visible: true, matrix: identity() });
    this.set(told);
  }

  /** What it takes up, null for nothing. @returns {{low: number[], high: number[]} | null} */
  bounds() {
    return null;
  }

  /** Points that show where it is. @returns {number[][]} */
  samples() {
    return [];
  }

  /** @param {Object<string, any>} told what changes; what is undefined stays */
  set(told) {
    for (const [name, value] of Object.entries(told)) if (value !== undefined) this[name] = value;
  }

  /** The box in the world, null where there is nothing. */
  get box() {
    this.own ??= this.bounds();
    return this.own && movedBox(this.own, this.matrix);
  }

  /** Points of the world that show where it is. */
  get outline() {
    if (!this.box) return [];
    const { low, high } = this.own, more = low.map((x, k) => (high[k] - x) / 6);
    const near = (x, k) => Math.min(Math.max(x, low[k] - more[k]), high[k] + more[k]);
    this.some ??= this.samples().map((p) => p.map(near)); // but for strays
    return this.some.map((p) => transformed(this.matrix, p).slice(0, 3));
  }

  /** Buffers of this context; made once, and again after it was lost. */
  free(gl) {
    if (gl && this.made) for (const one of this.made.buffers) gl.deleteBuffer(one);
    if (gl && this.made?.array) gl.deleteVertexArray(this.made.array);
    if (gl && this.made?.texture) gl.deleteTexture(this.made.texture);
    this.made = null;
  }

  buffer(gl, data) {
    const made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    this.made.buffers.push(made);
  }

  begin(gl) {
    this.made = { buffers: [], array: gl.createVertexArray() };
    gl.bindVertexArray(this.made.array);
  }
}

/** Points as the API sends them. */
export class CloudLayer extends Layer {
  kind = "points";

  set(told) {
    const isOther = told.points !== undefined && told.points !== this.points;
    if (isOther) this.own = this.some = undefined;
    super.set(told);
    this.fresh &&= !isOther && told.patchColours === undefined;
  }

  bounds() {
    return this.points?.count ? boxOf(this.points) : null;
  }

  samples() {
    return someOf(this.points);
  }

  upload(gl) {
    const { data, offset, stride, count } = this.points;
    this.begin(gl);
    this.buffer(gl, new Uint8Array(data, offset, count * stride));
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, true, stride, 0);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_SHORT, stride, 6);
    gl.enableVertexAttribArray(2);
    gl.vertexAttribPointer(2, 3, gl.BYTE, true, stride, 8);
    gl.enableVertexAttribArray(3);
    gl.vertexAttribIPointer(3, 1, gl.UNSIGNED_BYTE, stride, 11);
    this.made.texture = paletteTexture(gl, this.patchColours ?? manyColours(4096));
  }

  draw(gl, { at }, view) {
    const { points } = this;
    if (!points?.count) return;
    if (!this.made || !this.fresh) {
      this.free(gl);
      this.upload(gl);
      this.fresh = true;
    }
    const mode = MODES[this.colour ?? "tint"] ?? 0;
    gl.uniformMatrix4fv(at.model, false, this.matrix);
    gl.uniform3fv(at.origin, points.origin);
    gl.uniform3fv(at.extent, points.extent);
    gl.uniform1i(at.mode, mode);
    gl.uniform3fv(at.tint, unit(colourOf(this.tint ?? "match")));
    gl.uniform1f(at.shade, points.hasNormals ? this.shade ?? 0.45 : 0);
    gl.uniform3fv(at.outside, unit(BESIDE));
    gl.uniform3fv(at.violation, unit(VIOLATES));
    gl.uniform3fv(at.steps, unit(STEPS.flat()));
    gl.uniform1f(at.size, (this.size ?? this.spacing()) * view.pixelsAtOneMetre);
    gl.uniform2fv(at.pixels, [1.5 * view.density, 14 * view.density]);
    gl.uniform2fv(at.heights, view.heights);
    gl.bindTexture(gl.TEXTURE_2D, this.made.texture);
    gl.bindVertexArray(this.made.array);
    gl.drawArrays(gl.POINTS, 0, points.count);
  }

  /** Metres from point to point, about: as if they lay on the walls of their box. */
  spacing() {
    this.own ??= this.bounds();
    const [a, b, c] = this.own.high.map((x, k) => x - this.own.low[k]);
    return Math.max(Math.sqrt((a * b + b * c + a * c) / this.points.count), 1e-3);
  }
}

/** Segments (every two positions) or triangles (every three), with a tint or a colour each. */
export class ShapeLayer extends Layer {
  /** @param {"lines" | "triangles"} kind */
  constructor(kind, told) {
    super(told);
    this.kind = kind;
  }

  set(told) {
    if (told.positions !== undefined) this.own = this.some = undefined;
    // colours that are not sent again are not those of new positions of another number
    if (told.positions !== undefined && told.colours === undefined) this.colours = undefined;
    super.set(told);
    this.fresh &&= told.positions === undefined && told.colours === undefined;
  }

  bounds() {
    const p = this.positions;
    if (!p?.length) return null;
    return boxAbout(placesOf(p));
  }

  samples() {
    return this.positions.length > 3000 ? cornersOf(this.own) : placesOf(this.positions); // of many their box will do
  }

  upload(gl) {
    const lines = this.kind === "lines", corners = lines ? 2 : 1;
    const attribute = (place, size, type, normalised, stride, offset) => {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, type, normalised, stride, offset);
    };
    const laid = (values) => (lines ? fourTimes(values, 6) : values);
    this.begin(gl);
    this.buffer(gl, laid(new Float32Array(this.positions)));
    for (let k = 0; k < corners; k += 1) {
      attribute(k, 3, gl.FLOAT, false, 12 * corners, 12 * k);
    }
    if (this.colours) {
      this.buffer(gl, laid(new Uint8Array(this.colours)));
      for (let k = 0; k < corners; k += 1) {
        attribute(corners + k, 3, gl.UNSIGNED_BYTE, true, 3 * corners, 3 * k);
      }
    }
    if (lines) this.corners(gl);
  }

  /** Two triangles of the four corners of each segment. */
  corners(gl) {
    const count = Math.floor(this.positions.length / 6), places = new Uint32Array(6 * count);
    for (let i = 0; i < count; i += 1) places.set([0, 1, 2, 2, 1, 3].map((corner) => 4 * i + corner), 6 * i);
    const made = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, places, gl.STATIC_DRAW);
    this.made.buffers.push(made);
  }

  draw(gl, { at }, view) {
    if (!this.positions?.length) return;
    if (!this.made || !this.fresh) {
      this.free(gl);
      this.upload(gl);
      this.fresh = true;
    }
    gl.uniformMatrix4fv(at.model, false, this.matrix);
    gl.uniform4fv(at.tint, [...unit(colourOf(this.tint ?? "ink")), this.colours ? 0 : 1]);
    gl.bindVertexArray(this.made.array);
    if (this.kind === "lines") {
      gl.uniform1f(at.width, Math.max(this.width ?? 1.5, 1.5) * view.density);
      gl.drawElements(gl.TRIANGLES, 6 * Math.floor(this.positions.length / 6), gl.UNSIGNED_INT, 0);
    } else {
      gl.uniform1f(at.alpha, this.alpha ?? 1);
      gl.drawArrays(gl.TRIANGLES, 0, Math.floor(this.positions.length / 9) * 3);
    }
  }
}

/** Colours by number, 256 a row; those that are none are grey. @param {any} gl
 * @param {Uint8Array} colours rgb of each */
export function paletteTexture(gl, colours) {
  const rows = Math.max(1, Math.ceil(colours.length / 3 / 256));
  const texels = new Uint8Array(256 * rows * 4).fill(150);
  for (let i = 0; i < colours.length / 3; i += 1) {
    texels.set(colours.subarray(3 * i, 3 * i + 3), 4 * i);
  }
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, rows, 0, gl.RGBA, gl.UNSIGNED_BYTE, texels);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
    gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  }
  return texture;
}

/** Each so many values four times: an instance for each segment would do without, but costs a GPU
 * that is none (SwiftShader) 25 us. @param {Float32Array | Uint8Array} values @param {number} size */
function fourTimes(values, size) {
  const out = values instanceof Float32Array ? new Float32Array(4 * values.length) : new Uint8Array(4 * values.length);
  for (let at = 0; at + size <= values.length; at += size) {
    const one = values.subarray(at, at + size);
    for (let k = 0; k < 4; k += 1) out.set(one, 4 * at + k * size);
  }
  return out;
}

/** The box about some boxes, null about none. @param {({low, high} | null)[]} boxes */
export const around = (boxes) => boxAbout(boxes.flatMap((one) => (one === null ? [] : [one.low, one.high])));

