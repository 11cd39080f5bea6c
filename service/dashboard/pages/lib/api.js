// The HTTP API as any customer of it has it: JSON, files and the stream of events.
import { address, ask, keyed, Problem, read, unreachable, whole } from "./http.js";
import { key } from "./session.js";

export { address, ask, at, lives, Problem } from "./http.js";
export { watch } from "./live.js";

/**
 * JSON of the API.
 * @param {string} path under /v1, such as `at("maps", name, "frames")`
 * @param {{params?: Object<string, any> | URLSearchParams, signal?: AbortSignal, accept?: string}} [how]
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
 * @param {string} method @param {string} path
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

/**
 * The bytes of a file; the browser asks whether those that it has are still right.
 * @param {string} path @param {{params?: Object<string, any>, signal?: AbortSignal, accept?: string}} [how]
 */
export async function bytes(path, { params, signal, accept = "*/*" } = {}) {
  const answer = await ask(path, params, { headers: { Accept: accept }, signal, cache: "no-cache" });
  return whole(answer.arrayBuffer());
}

/**
 * Let the browser keep a file.
 * @param {string} path @param {{params?: Object<string, any>, name?: string}} [how] name: of the file
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
