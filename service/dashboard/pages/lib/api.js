// The HTTP API as any customer of it has it: JSON, files and the stream of events.
import { address, ask, keyed, Problem, read, unreachable, whole } from "./http.js";
import { key } from "./session.js";

export { address, ask, at, lives, Problem } from "./http.js";
export { watch } from "./live.js";

const KEPT_MOST = 200;
const KEPT_BYTES = 64 * 2 ** 20;

/**
 * JSON of the API.
 * @param {string} path under /v1, such as `at("maps", name, "frames")`
 * @param {{params?: Object<string, any> | URLSearchParams, signal?: AbortSignal, accept?: string}} [how]
 * @returns {Promise<any>}
 */
export async function get(path, { params, signal, accept = "application/json" } = {}) {
  const answer = await ask(path, params, { signal, headers: { Accept: accept } });
  return read(answer);
}

/**
 * Items of a list, page by page.
 * @param {string} path
 * @param {{params?: Object<string, any>, signal: AbortSignal, most?: number}} how most: of items, about
 * @returns {Promise<{items: any[], cursor: string | null}>} cursor: of those that are left; null: none
 */
export async function list(path, { params, signal, most = Infinity }) {
  const items = [];
  let cursor = null;
  do {
    const page = await get(path, { params: { limit: 1000, ...params, cursor }, signal });
    items.push(...page.items);
    cursor = page.next_cursor;
  } while (cursor !== null && items.length < most);
  return { items, cursor };
}

/**
 * Change something.
 * @param {string} method
 * @param {string} path
 * @param {{json?: any, form?: FormData | Object<string, any>, body?: BodyInit, type?: string,
 *   headers?: Object<string, string>, params?: Object<string, any> | URLSearchParams,
 *   signal?: AbortSignal, onprogress?: (share: number) => void}} [what] one of json, form, body
 * @returns {Promise<{status: number, data: any, headers: Headers}>}
 */
export async function send(method, path, what = {}) {
  const { json, form, params, signal, onprogress } = what;
  const headers = { Accept: "application/json", ...what.headers };
  let body = what.body;
  if (json !== undefined) { body = JSON.stringify(json); headers["Content-Type"] ??= "application/json"; }
  if (form !== undefined) body = form instanceof FormData ? form : formOf(form);
  if (what.type) headers["Content-Type"] = what.type;
  if (onprogress) return upload(method, address(path, params), { headers: keyed(headers), body, signal, onprogress });
  const answer = await ask(path, params, { method, headers, body, signal });
  return { status: answer.status, data: await read(answer), headers: answer.headers };
}

const kept = new Map(); // address and key -> {tag, body}, the longest unused first
let keptBytes = 0;

/**
 * The bytes of a file; what has not changed since it was asked for is not sent again. They are
 * shared with who else asked: read them only.
 * @param {string} path
 * @param {{params?: Object<string, any>, signal?: AbortSignal, accept?: string}} [how]
 * @returns {Promise<ArrayBuffer>}
 */
export async function bytes(path, { params, signal, accept = "*/*" } = {}) {
  const headers = { Accept: accept };
  const name = `${key() ?? ""} ${accept} ${address(path, params)}`;
  const known = kept.get(name);
  if (known) headers["If-None-Match"] = known.tag;
  const answer = await ask(path, params, { headers, signal }, known ? 304 : undefined);
  const same = answer.status === 304;
  const body = same ? known.body : await whole(answer.arrayBuffer());
  const tag = same ? known.tag : answer.headers.get("ETag");
  // by now another may have asked for it as well
  keptBytes -= kept.get(name)?.body.byteLength ?? 0;
  kept.delete(name);
  if (tag && body.byteLength <= KEPT_BYTES / 4) {
    kept.set(name, { tag, body });
    keptBytes += body.byteLength;
    for (const [oldest, one] of kept) {
      if (kept.size <= KEPT_MOST && keptBytes <= KEPT_BYTES) break;
      kept.delete(oldest);
      keptBytes -= one.body.byteLength;
    }
  }
  return body;
}

/**
 * Let the browser keep a file.
 * @param {string} path
 * @param {{params?: Object<string, any>, name?: string}} [how] name: of the file
 */
export async function save(path, { params, name } = {}) {
  const link = document.createElement("a");
  link.download = name ?? path.split("/").pop() ?? "";
  link.href = address(path, params);
  if (key() === null) { link.click(); return; } // straight to the disk, however large
  const answer = await ask(path, params, { headers: { Accept: "*/*" } });
  const told = /filename="([^"/\\]+)"/.exec(answer.headers.get("Content-Disposition") ?? "");
  link.download = name ?? told?.[1] ?? link.download;
  link.href = URL.createObjectURL(await whole(answer.blob()));
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000); // the download has begun by then
}

function formOf(fields) {
  const form = new FormData();
  for (const [name, value] of Object.entries(fields)) {
    for (const one of [value].flat()) if (one !== null && one !== undefined) form.append(name, one);
  }
  return form;
}

// fetch tells nothing of how much was sent
function upload(method, url, { headers, body, signal, onprogress }) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open(method, url);
    for (const [name, value] of Object.entries(headers)) request.setRequestHeader(name, value);
    request.upload.onprogress = (event) => { if (event.lengthComputable) onprogress(event.loaded / event.total); };
    request.onerror = () => reject(unreachable());
    const givenUp = () => reject(new DOMException("It was cancelled.", "AbortError"));
    request.onabort = givenUp;
    request.onload = () => {
      const isJson = /[/+]json/.test(request.getResponseHeader("Content-Type") ?? "");
      const text = request.responseText;
      const data = text && isJson ? JSON.parse(text) : text || null;
      if (request.status >= 400) {
        reject(new Problem(request.status, (isJson && data) || {}, request.getResponseHeader("Retry-After")));
        return;
      }
      const lines = request.getAllResponseHeaders().trim().split(/\r?\n/).map((line) => line.split(/:\s*(.*)/, 2));
      resolve({ status: request.status, data, headers: new Headers(/** @type {any} */ (lines)) });
    };
    if (signal?.aborted) { givenUp(); return; }
    signal?.addEventListener("abort", () => request.abort(), { once: true });
    request.send(body ?? null);
  });
}
