// One request to the API: its address, the key, and what refusals become.
import { searchOf } from "./router.js";
import { key } from "./session.js";

// of this module, not of the page: it is right behind whatever prefix a proxy adds
const ROOT = new URL("../../", import.meta.url);
const BASE = new URL("v1/", ROOT);

/** What the API refused, as its problem document says it; status 0 where nothing answered. */
export class Problem extends Error {
  /** @param {number} status @param {string | null} [retryAfter] the header of that name */
  constructor(status, document, retryAfter = null) {
    super(document.detail ?? document.title ?? `The service answered ${status}.`);
    this.status = status;
    this.type = String(document.type ?? "").split("/").pop();
    this.title = document.title ?? `Status ${status}`;
    this.detail = this.message;
    this.errors = document.errors ?? [];
    this.instance = document.instance ?? null;
    this.retryAfter = retryAfter === null ? null : Number(retryAfter) || null; // seconds
  }
}

/** A path of the API from its segments, which may hold any character. @param {...string} segments */
export function at(...segments) {
  // nothing is called so, and a URL would take it for a step to elsewhere
  if (segments.some((one) => /^\.{0,2}$/.test(one))) throw new Problem(404, { title: "Not found", detail: "There is no page at this address." });
  return segments.map((one) => encodeURIComponent(one)).join("/");
}

const PULSE_S = 4; // a service that takes longer to say that it lives hangs

/** Whether the service lives, and says so in time. @param {AbortSignal} [signal] */
export async function lives(signal) {
  const late = AbortSignal.timeout(1000 * PULSE_S);
  const init = { signal: signal ? AbortSignal.any([signal, late]) : late, cache: /** @type {RequestCache} */ ("no-store") };
  try {
    const answer = await fetch(new URL("healthz", ROOT), init);
    await answer.text(); // else the connection stays taken
    return answer.ok;
  } catch { return false; }
}

/** Ask the API, with the key if there is one; Problem where it refuses or does not answer. */
export async function ask(path, params, init = {}) {
  let answer;
  try {
    answer = await fetch(address(path, params), { cache: "no-store", ...init, headers: keyed(init.headers) });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw unreachable();
  }
  if (answer.ok) return answer;
  throw new Problem(answer.status, (await answer.json().catch(() => null)) ?? {}, answer.headers.get("Retry-After"));
}

/** The address of something of the API, for a link. @param {string} path @param {any} [params] */
export function address(path, params) {
  return new URL(`${path}${searchOf(params)}`, BASE).href;
}

/** Headers, and the key if there is one. @param {Object<string, string>} [headers] */
export function keyed(headers = {}) {
  const shown = key();
  return shown === null ? headers : { ...headers, Authorization: `Bearer ${shown}` };
}

/** The Problem of no answer. */
export function unreachable() {
  const detail = "The service does not answer. It may be restarting, or the network is down.";
  return new Problem(0, { type: "unreachable", title: "No answer", detail });
}

/** What an answer holds: JSON as its value, else text. @param {Response} answer */
export async function read(answer) {
  const text = await whole(answer.text());
  const isJson = /[/+]json/.test(answer.headers.get("Content-Type") ?? "");
  return isJson && text ? JSON.parse(text) : text || null;
}

/** A body that may break off on its way. @template T @param {Promise<T>} body @returns {Promise<T>} */
export async function whole(body) {
  try { return await body; } catch (error) {
    if (error.name === "AbortError") throw error;
    throw unreachable(); // it broke off
  }
}
