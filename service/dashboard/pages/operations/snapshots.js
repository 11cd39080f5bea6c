// Snapshots of the data folder: taken by a worker, kept until they are removed.
import { at, get, save, send } from "../lib/api.js";
import { h, put } from "../lib/dom.js";
import { bytes, count, time } from "../lib/format.js";
import { confirm, empty, toast } from "../lib/states.js";
import { jobRow } from "./joblist.js";
import { poll, renewTimes, rows } from "./poll.js";

const POLL_S = 3;

/** See operations.js. */
export async function renderTab(root, { signal, actions }) {
  const body = h("tbody", {});
  const table = h("table", { class: "table" }, h("thead", {}, h("tr", {},
    h("th", { scope: "col" }, "Taken"), h("th", { scope: "col" }, "Id"),
    ["Size", "Maps", "Frames", "Blobs", "Damaged"].map((text) => h("th", { scope: "col", class: "number" }, text)),
    h("th", { scope: "col" }, h("span", { class: "visually-hidden" }, "Actions")))), body);
  const card = h("div", { class: "card scroll" }, table);
  const none = h("div", { hidden: true }, empty({ title: "No snapshot yet", text: "A snapshot is a consistent archive of all maps, taken while the service runs. Restore it on the command line with “sceneprint restore”." }));
  const jobs = h("ul", { class: "list jobs" });
  const show = rows(body, (one) => one.snapshot_id, (one) => snapshotRow(one, () => again()));
  const showJobs = rows(jobs, (one) => one.job_id, (one) => jobRow(one, () => again()));

  async function look() {
    const [taken, recent] = await Promise.all([get("snapshots", { signal }), get("jobs", { params: { kind: "snapshot", limit: 5 }, signal })]);
    none.hidden = taken.items.length > 0;
    card.hidden = taken.items.length === 0;
    show(taken.items);
    // those that are over and well are in the table
    showJobs(recent.items.filter((one) => one.state !== "succeeded" && one.state !== "cancelled"));
    renewTimes(root);
  }

  const again = await poll(look, POLL_S, signal);
  const take = h("button", { class: "button primary", type: "button", onClick: async () => {
    take.disabled = true;
    try {
      await send("POST", "snapshots");
      again();
    } finally { take.disabled = false; }
  } }, "Take a snapshot");
  actions(take);
  put(root, h("p", { class: "muted" }, "An archive contains all frames and the hashes of keys: protect it like the data folder."), jobs, card, none);
}

function snapshotRow(one, changed) {
  const name = `sceneprint-${one.snapshot_id}.tar`;
  const remove = async () => {
    const text = h("p", {}, "The archive is removed from the service's disk. This cannot be undone. Copies elsewhere remain.");
    if (!(await confirm({ title: "Delete a snapshot", text, word: one.snapshot_id, action: "Delete" }))) return;
    await send("DELETE", at("snapshots", one.snapshot_id));
    toast("Snapshot deleted");
    changed();
  };
  return h("tr", {}, h("td", {}, time(one.created_at)), h("th", { scope: "row", class: "mono" }, one.snapshot_id),
    h("td", { class: "number" }, bytes(one.bytes)), [one.maps, one.frames, one.blobs].map((n) => h("td", { class: "number" }, count(n))),
    h("td", { class: "number" }, one.damaged > 0 ? h("span", { class: "badge", dataset: { kind: "bad" } }, count(one.damaged)) : "0"),
    h("td", {}, h("span", { class: "toolbar end" },
      h("button", { class: "button", type: "button", dataset: { part: "save" }, "aria-label": `Download ${name}`, onClick: () => save(at("snapshots", one.snapshot_id), { name }) }, "Download"),
      h("button", { class: "button danger", type: "button", dataset: { part: "delete" }, "aria-label": `Delete ${name}`, onClick: remove }, "Delete"))));
}
