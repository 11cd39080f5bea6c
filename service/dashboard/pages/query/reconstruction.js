// The surface that the accepted matches of an answer show together: started, followed and shown.
import { at, save, send } from "../lib/api.js";
import { h, once, put } from "../lib/dom.js";
import { count, percent } from "../lib/format.js";
import { followJob, goesOn } from "../lib/products.js";
import { go, link, parse } from "../lib/router.js";
import { may } from "../lib/session.js";
import { failed } from "../lib/states.js";

const WAITING = { queued: "Waiting for a worker…", running: "Fusing the views…" };

/**
 * A card that starts a reconstruction, and shows one that was started; the address says which.
 * @param {AbortSignal} signal @returns {HTMLElement | null} null where there is nothing to fuse
 */
export function reconstructionPanel(answer, signal) {
  const accepted = answer.matches.filter((one) => one.validation.status === "accepted");
  const mayStart = accepted.every((one) => may("write", one.map));
  const known = parse(location.hash).search.get("reconstruction");
  if (accepted.length === 0 || (!mayStart && known === null)) return null;
  const body = h("div", { class: "query-fused" });
  const said = h("span", { class: "visually-hidden", role: "status" });

  const start = once(async () => {
    put(body, h("p", { class: "muted" }, WAITING.queued));
    try {
      const { data } = await send("POST", `${at("queries", answer.query_id)}/reconstruction`, { json: {}, signal });
      remember(data.job_id);
      await watch(data.job_id);
    } catch (error) { refused(error, start); }
  });

  async function watch(id) {
    const ended = new AbortController();
    await followJob(at("reconstructions", id), (told) => {
      // it was deleted, or is of an answer before this one
      if (told === null || told.query_id !== answer.query_id) { ended.abort(); idle(); return; }
      if (goesOn(told)) put(body, h("p", { class: "muted" }, WAITING[told.state]));
      else if (told.state === "succeeded") show(told); else lost(told);
    }, AbortSignal.any([signal, ended.signal]));
  }

  function show(told) {
    const { result: coverage } = told;
    const path = at("reconstructions", told.job_id);
    put(said, "The reconstruction is there.");
    put(body, h("p", { class: "muted" }, `${count(coverage.views.length)} views show ${coverage.area_m2.toFixed(1)} m² together; `,
        `the matches explain ${percent(coverage.query_explained)} of the query. Voxels of ${(100 * coverage.voxel_m).toFixed(1)} cm, ${count(coverage.triangles)} triangles.`),
      h("div", { class: "toolbar" },
        h("button", { class: "button", type: "button", onClick: () => save(`${path}/mesh.ply`) }, "Mesh (PLY)"),
        h("a", { class: "button quiet", href: link("operations", "jobs", told.job_id) }, "The job")));
  }

  /** @param {Object<string, any>} told */
  function lost({ state, error }) {
    const detail = error ?? `The job is ${state}.`;
    put(body, failed({ name: "Problem", message: detail, status: 409, title: "The reconstruction failed", detail }, mayStart ? start : undefined));
  }

  function refused(error, again) {
    if (error.name === "AbortError") return;
    if (error.status === undefined || error.status === 401) throw error;
    put(body, failed(error, mayStart ? again : undefined));
  }

  function idle() {
    put(body, h("p", { class: "muted" }, `Fuse the ${count(accepted.length + 1)} views, of the query and its accepted matches, to one surface. A worker does it within a minute.`),
      mayStart && h("div", { class: "toolbar" }, h("button", { class: "button", type: "button", onClick: start }, "Reconstruct")));
  }

  if (known === null) idle(); else watch(known).catch((error) => refused(error, start));
  return h("section", { class: "card", "aria-labelledby": "fused-title" }, h("h3", { id: "fused-title" }, "Reconstruction"), said, body);
}

/** Let the address say which reconstruction is shown: it survives a reload. */
function remember(id) {
  const { path, search } = parse(location.hash);
  search.set("reconstruction", id);
  go(`#/${path}?${search}`, { replace: true, quiet: true });
}
