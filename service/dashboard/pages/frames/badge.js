// States of frames and jobs as words with a shape: never a colour alone.
import { h } from "../lib/dom.js";

const KINDS = {
  received: "neutral", signing: "neutral", indexed: "good", rejected: "bad", failed: "bad",
  redundant: "warn", deleted: "warn",
  queued: "neutral", running: "neutral", succeeded: "good", cancelled: "warn", dead: "bad",
};
const SENTENCES = {
  received: "Stored and waiting for a worker.",
  signing: "A worker is signing it.",
  indexed: "Signed and searchable.",
  rejected: "It cannot be signed.",
  failed: "Signing failed.",
  redundant: "Not stored, as requested: the map already has this place.",
  deleted: "Deleted; not searchable.",
};

/** States a frame can be in, in the order in which they are met. */
export const STATES = Object.keys(SENTENCES);

/** What a state of a frame means. @param {string} state */
export function sentence(state) {
  return SENTENCES[state] ?? state;
}

/** Whether more will happen to a frame by itself. @param {string} state */
export function isPending(state) {
  return state === "received" || state === "signing";
}

/** A state of a frame or a job. @param {string} state */
export function badge(state) {
  return h("span", { class: "badge", dataset: { kind: KINDS[state] ?? "neutral", state } }, state);
}
