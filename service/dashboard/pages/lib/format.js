// Numbers, sizes and times as text, the same in every language of a browser.
import { h } from "./dom.js";

const WHOLE = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
const STEPS = ["B", "kB", "MB", "GB", "TB", "PB"];
const NONE = "–";

/** A number of things: "12,345". @param {number | null | undefined} n */
export function count(n) {
  return isNumber(n) ? WHOLE.format(n) : NONE;
}

/** A number with the name of what it counts: "1 frame", "2 queries". @param {number} n @param {string} one @param {string} [many] */
export function things(n, one, many = `${one}s`) {
  return `${count(n)} ${n === 1 ? one : many}`;
}

/** A size: "1.2 MB". @param {number | null | undefined} n bytes */
export function bytes(n) {
  if (!isNumber(n)) return NONE;
  let step = 0;
  let rest = n;
  // 999.5 and not 1000: it would be written 1000 otherwise
  while (Math.abs(rest) >= 999.5 && step < STEPS.length - 1) { rest /= 1000; step += 1; }
  return `${step === 0 || rest >= 99.95 ? WHOLE.format(rest) : rest.toFixed(1)} ${STEPS[step]}`;
}

/** A length: "1.24 m", "34 mm". @param {number | null | undefined} x metres */
export function metres(x) {
  if (!isNumber(x)) return NONE;
  if (x === 0) return "0 m";
  const size = Math.abs(x);
  if (size < 0.1) return `${(1000 * x).toFixed(size < 0.01 ? 1 : 0)} mm`;
  return `${x.toFixed(size < 10 ? 2 : size < 100 ? 1 : 0)} m`;
}

/** An angle: "3.2°". @param {number | null | undefined} x degrees */
export function degrees(x) {
  return isNumber(x) ? `${x.toFixed(Math.abs(x) < 10 ? 1 : 0)}°` : NONE;
}

/** A share: "81 %". @param {number | null | undefined} x of 1 */
export function percent(x) {
  if (!isNumber(x)) return NONE;
  const share = 100 * x;
  return `${share.toFixed(share !== 0 && Math.abs(share) < 1 ? 2 : Math.abs(share) < 10 ? 1 : 0)} %`;
}

/** A probability: "99.6 %", rounded down, so that none looks better than it is. @param {number | null | undefined} x of 1 */
export function confidence(x) {
  return isNumber(x) ? `${(Math.floor(1000 * Math.min(x, 0.999)) / 10).toFixed(1)} %` : NONE;
}

/** A span: "0.4 s", "12 s", "3 min 20 s", "2 h 5 min", "3 d 4 h". @param {number | null | undefined} s */
export function seconds(s) {
  if (!isNumber(s)) return NONE;
  if (s < 9.95) return `${s.toFixed(1)} s`;
  const whole = Math.round(s);
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return two(Math.floor(whole / 60), "min", whole % 60, "s");
  if (whole < 86400) return two(Math.floor(whole / 3600), "h", Math.floor((whole % 3600) / 60), "min");
  return two(Math.floor(whole / 86400), "d", Math.floor((whole % 86400) / 3600), "h");
}

/** A short span: "147 ms", "1.25 s". @param {number | null | undefined} x milliseconds */
export function ms(x) {
  if (!isNumber(x)) return NONE;
  if (x >= 1000) return `${(x / 1000).toFixed(2)} s`;
  return `${x.toFixed(x < 10 ? 1 : 0)} ms`;
}

/** How long ago: "3 min ago". @param {string | null | undefined} iso */
export function ago(iso) {
  const then = Date.parse(iso ?? "");
  if (!Number.isFinite(then)) return NONE;
  const s = (Date.now() - then) / 1000;
  const text = span(Math.abs(s));
  if (text === null) return "just now"; // clocks differ by seconds
  return s < 0 ? `in ${text}` : `${text} ago`;
}

/** When, as an element that tells the exact time on demand. @param {string | null | undefined} iso */
export function time(iso) {
  if (!Number.isFinite(Date.parse(iso ?? ""))) return h("span", {}, NONE);
  const exact = new Date(iso ?? "").toISOString().replace("T", " ").replace(/(\.\d+)?Z$/, " UTC");
  return h("time", { datetime: iso, title: exact }, ago(iso));
}

/** The beginning of an id that is enough to tell it from others. @param {string | null | undefined} id */
export function shortId(id) {
  if (!id) return NONE;
  return id.length > 12 && /^[0-9a-f-]+$/.test(id) ? id.slice(0, 8) : id;
}

/** Ends of names that say how files are packed, and nothing of a frame. */
const PACKED = /(\.depth)?\.(png|npy|ply|pcd|bin|las|laz)$/i;

/**
 * What people call a frame: the last part of the name of its file without its type, or the beginning of its id.
 * @param {Object<string, any>} frame
 */
export function frameLabel({ frame_id: id, name }) {
  return (name && name.slice(name.lastIndexOf("/") + 1).replace(PACKED, "")) || shortId(id);
}

/** All of a frame's name and id, for a title. @param {Object<string, any>} frame */
export function frameTitle({ frame_id: id, name }) {
  return name ? `${name}, frame ${id}` : id;
}

function span(s) {
  if (s < 10) return null;
  if (s < 59.5) return `${Math.round(s)} s`;
  if (s < 3570) return `${Math.round(s / 60)} min`;
  if (s < 84600) return `${Math.round(s / 3600)} h`;
  const days = Math.round(s / 86400);
  return days < 60 ? `${days} d` : days < 700 ? `${Math.round(days / 30.4)} months` : `${Math.round(days / 365)} years`;
}

function two(a, unitA, b, unitB) {
  return b === 0 ? `${a} ${unitA}` : `${a} ${unitA} ${b} ${unitB}`;
}

/** @param {any} n @returns {n is number} */
function isNumber(n) {
  return typeof n === "number" && Number.isFinite(n);
}
