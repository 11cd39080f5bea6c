// Reasons of the API as text of a page.
import { h } from "./dom.js";
import { metres } from "./format.js";

/** A reason of the API as a sentence. @param {string} text */
export function sentence(text) {
  return `${text.charAt(0).toUpperCase()}${text.slice(1)}${/[.!?]$/.test(text) ? "" : "."}`;
}

/** Angles and short lengths of the API as pages write them. @param {string} text */
const written = (text) => text.replace(/(\d) deg\b/g, "$1°").replace(/\b0\.0\d+ m(?![\w²³/])/g, (length) => metres(parseFloat(length)));

/** A text of the API: what stands in backticks is code. @param {string} text @returns {(string | HTMLElement)[]} */
export function coded(text) {
  return text.split("`").map((part, i) => (i % 2 ? h("code", {}, part) : written(part)));
}

/** The same where no markup can stand, as in titles and labels. @param {string} text */
export const plain = (text) => written(text.replaceAll("`", ""));
