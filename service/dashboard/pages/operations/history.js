// The last hour by minutes, as the service counted it over all its processes.
import { chart } from "../lib/charts.js";
import { h } from "../lib/dom.js";
import { count, ms } from "../lib/format.js";

const time = (value) => (value === 0 ? "0" : ms(1000 * value));

/** @type {Parameters<typeof chart>[0]} */
const FRAMES = {
  title: "Frames per minute", kind: "bars", format: count, least: 1, nothing: "No frames in the last hour",
  series: [
    { name: "indexed", colour: "--good" }, { name: "redundant", colour: "--match" },
    { name: "rejected", colour: "--warn" }, { name: "failed", colour: "--bad" },
    { name: "received", colour: "--muted", over: true },
  ],
};
/** @type {Parameters<typeof chart>[0]} */
const LATENCY = {
  title: "Query time", format: time, nothing: "No queries in the last hour",
  series: [
    { name: "p50", colour: "--accent", area: true }, { name: "p95", colour: "--match", dash: "6 3" },
    { name: "p99", colour: "--rival", dash: "1.5 3.5" },
  ],
};
/** @type {Parameters<typeof chart>[0]} */
const QUERIES = {
  title: "Queries per minute", kind: "bars", format: count, least: 1, nothing: "No queries in the last hour",
  series: [
    { name: "found", colour: "--good" }, { name: "ambiguous", colour: "--warn" },
    { name: "not_found", colour: "--edge" }, { name: "unvalidated", colour: "--match" },
  ],
};
/** @type {Parameters<typeof chart>[0]} */
const REQUESTS = {
  title: "Requests per minute", kind: "bars", format: count, least: 1, nothing: "No requests in the last hour",
  series: [
    { name: "answered", colour: "--accent" }, { name: "refused", colour: "--warn" },
    { name: "busy", colour: "--rival" }, { name: "failed", colour: "--bad" },
  ],
};

/**
 * Charts of the last hour; of one map, those of its frames alone.
 * @param {boolean} whole @returns {{element: HTMLElement, update: (stats: Object<string, any>) => void}}
 */
export function history(whole) {
  /** @type {[ReturnType<typeof chart>, (minute: Object<string, any>) => (number | null)[]]} */
  const frames = [chart(FRAMES), (one) => FRAMES.series.map(({ name }) => one[name])];
  /** @type {(typeof frames)[]} */
  const others = [
    [chart(LATENCY), (one) => LATENCY.series.map(({ name }) => one.latency?.[name] ?? null)],
    [chart(named(QUERIES)), (one) => QUERIES.series.map(({ name }) => one.queries[name] ?? 0)],
    [chart(REQUESTS), (one) => [one.requests - one.refused - one.busy - one.broken, one.refused, one.busy, one.broken]],
  ];
  const all = whole ? [frames, ...others] : [frames];
  return {
    element: h("section", { class: "charts", "aria-label": "The last hour" }, all.map(([one]) => h("div", { class: "card" }, one.element))),
    update({ minutes }) {
      const times = minutes.map((one) => new Date(one.at));
      for (const [one, pick] of all) {
        const found = minutes.map(pick);
        one.update(times, bySeries(found));
      }
    },
  };
}

/** Statuses as people write them. */
function named(what) {
  return { ...what, series: what.series.map((one) => ({ ...one, name: one.name.replace("_", " ") })) };
}

function bySeries(found) {
  return (found[0] ?? []).map((_, i) => found.map((values) => values[i]));
}
