// Cells of a map's surface, drawn from the tiles of the API as they came: 8 bytes a cell, which the
// GPU takes as they are. Byte by byte in docs/surface.md.

import { BESIDE } from "./colours.js";
import { Layer, paletteTexture } from "./layers.js";
import { cornersOf as corners, transformed } from "./matrix.js";

const MODES = { height: 0, session: 1, seen: 2, age: 3 };
/** Bytes of a cell. */
export const STRIDE = 8;
/** A square of a cell seen aslant leaves gaps to the next one. */
const WIDER = 1.3;

/**
 * @typedef {object} Tile
 * @property {string} name the same name: the same bytes at the same place
 * @property {ArrayBuffer} data cells
 * @property {number} span metres of an edge
 * @property {number} cell metres of a cell
 * @property {number[]} matrix its corner, and the axes of its parent frame, in those of the picture;
 *   16, column-major
 */

export class CellsLayer extends Layer {
  kind = "cells";
  /** @type {Map<string, {array: any, buffer: any, count: number, every: number}>} */
  #held = new Map();

  set(told) {
    if (told.extent !== undefined) this.own = this.some = undefined;
    super.set(told);
    this.fresh &&= told.palette === undefined;
  }

  bounds() {
    return this.extent ?? null;
  }

  samples() {
    return corners(this.extent);
  }

  free(gl) {
    for (const [name, one] of this.#held) this.#drop(gl, name, one);
    super.free(gl);
  }

  #drop(gl, name, { array, buffer }) {
    if (gl) { gl.deleteVertexArray(array); gl.deleteBuffer(buffer); }
    this.#held.delete(name);
  }

  #buffers(gl, { name, data }) {
    const known = this.#held.get(name), every = this.every ?? 1, stride = every * STRIDE;
    if (known && known.every === every) return known;
    if (known) this.#drop(gl, name, known);
    const made = { array: gl.createVertexArray(), buffer: gl.createBuffer(), count: Math.ceil(Math.floor(data.byteLength / STRIDE) / every), every };
    gl.bindVertexArray(made.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, made.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 4, gl.UNSIGNED_BYTE, stride, 0);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribIPointer(1, 2, gl.UNSIGNED_SHORT, stride, 4);
    this.#held.set(name, made);
    return made;
  }

  draw(gl, { at }, view) {
    if (!this.tiles?.length) return;
    if (!this.made || !this.fresh) {
      if (this.made?.texture) gl.deleteTexture(this.made.texture);
      this.made = { buffers: [], texture: paletteTexture(gl, this.palette ?? new Uint8Array(0)) };
      this.fresh = true;
    }
    const drawn = new Set(this.tiles.map((one) => one.name));
    for (const [name, one] of this.#held) if (!drawn.has(name)) this.#drop(gl, name, one);
    gl.uniform1i(at.mode, MODES[this.colour ?? "height"] ?? 0);
    gl.uniform3fv(at.unknown, BESIDE.map((x) => x / 255));
    gl.uniform2fv(at.pixels, [view.density, 64 * view.density]);
    gl.uniform2fv(at.heights, this.heights);
    gl.uniform2fv(at.cut, this.cut ?? [-1e30, 1e30]);
    gl.uniform1f(at.most, this.most);
    gl.uniform2fv(at.ages, this.ages);
    gl.bindTexture(gl.TEXTURE_2D, this.made.texture);
    for (const one of this.tiles) {
      if (!isInView(one, view.clip, 1)) continue;
      const { array, count } = this.#buffers(gl, one);
      gl.uniformMatrix4fv(at.model, false, one.matrix);
      gl.uniform1f(at.span, one.span);
      gl.uniform1f(at.size, one.cell * WIDER * Math.sqrt(this.every ?? 1) * view.pixelsAtOneMetre);
      gl.bindVertexArray(array);
      gl.drawArrays(gl.POINTS, 0, count);
    }
  }
}

/** Whether a tile may be in the picture. @param {{matrix: number[], span: number}} tile @param {ArrayLike<number>} clip
 * world to clip coordinates @param {number} margin of the picture's width and height: 1 is its edge */
export function isInView({ matrix, span }, clip, margin) {
  const seen = cornersOf({ matrix, span }).map((p) => transformed(/** @type {any} */ (clip), p));
  return ![0, 1].some((k) => seen.every((p) => p[k] > margin * p[3]) || seen.every((p) => p[k] < -margin * p[3]));
}

/** @param {{matrix: number[], span: number}} tile @returns {number[][]} in the picture's frame */
export const cornersOf = ({ matrix, span }) =>
  corners({ low: [0, 0, 0], high: [span, span, span] }).map((p) => transformed(matrix, p).slice(0, 3));

/** Where a cell is, metres from the corner of its tile. @param {{data: ArrayBuffer, span: number}} tile @param {number} i */
export function placeIn({ data, span }, i) {
  const bytes = new Uint8Array(data, i * STRIDE, 3);
  return [0, 1, 2].map((k) => ((bytes[k] + 0.5) / 256) * span);
}

/**
 * The cell in front at a place of the canvas.
 * @param {Tile[]} tiles @param {(p: number[]) => number[] | null} project see `projector` of paths/pick.js
 * @param {{x: number, y: number, near: number, allowed: (p: number[]) => boolean}} where near: CSS
 *   pixels from there at most; allowed: by its place in the picture's frame
 * @returns {{tile: Tile, cell: number} | null}
 */
export function cellUnder(tiles, project, { x, y, near, allowed }) {
  /** @type {{tile: Tile, cell: number} | null} */
  let found = null;
  let closest = Infinity;
  for (const tile of tiles) {
    if (!reaches(tile, project, x, y, near)) continue;
    for (let i = 0; i * STRIDE < tile.data.byteLength; i += 1) {
      const p = transformed(tile.matrix, placeIn(tile, i)), seen = project(p);
      if (!seen || Math.hypot(seen[0] - x, seen[1] - y) > near || seen[2] >= closest) continue;
      if (allowed(p)) [found, closest] = [{ tile, cell: i }, seen[2]];
    }
  }
  return found;
}

/** Whether a tile may be drawn near a place of the canvas. */
function reaches(tile, project, x, y, near) {
  const corners = cornersOf(tile).map(project);
  if (corners.some((one) => one === null)) return true; // it is about the eye
  const within = (k, at) => Math.min(...corners.map((one) => one[k])) - near <= at && at <= Math.max(...corners.map((one) => one[k])) + near;
  return within(0, x) && within(1, y);
}
