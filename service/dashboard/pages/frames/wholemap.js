// Files of whole maps: what the form asks for them, and what the import is sent.
import { h } from "../lib/dom.js";
import { remember } from "./source.js";

const UPS = [["", "Estimate"], ["z", "+z"], ["y", "+y"], ["x", "+x"], ["-z", "\u2212z"], ["-y", "\u2212y"], ["-x", "\u2212x"]];
const UNITS = [["", "From the file"], ["1", "Metres"], ["100", "Centimetres"], ["1000", "Millimetres"], ["3.28084", "Feet"]];

/**
 * Fields of a form, which write into settings as they change.
 * @param {ReturnType<typeof import("./source.js").settings>} given
 * @returns {HTMLElement}
 */
export function mapFields(given) {
  const write = (name) => (event) => { given[name] = event.target.value; remember(given); };
  const text = (name, label, unit, placeholder) => h("label", { class: "field" }, h("span", {}, label, h("small", { class: "muted" }, unit)),
    h("input", { type: "text", name, autocomplete: "off", placeholder, value: given[name], onInput: write(name) }));
  const choice = (name, label, options) => h("label", { class: "field" }, h("span", {}, label),
    h("select", { name, onChange: write(name) }, options.map(([value, text]) => h("option", { value, selected: given[name] === value }, text))));
  return h("div", { class: "source-fields" }, h("details", {},
    h("summary", {}, "Whole maps"),
    h("div", { class: "source-row" },
      choice("map_up", "Up", UPS), choice("map_units", "Unit", UNITS),
      text("map_heights", "Sensor heights", " m above the floor", "those of the model"),
      text("map_offset", "Offset", " x,y,z m", "from the file"))));
}

/**
 * Query parameters of the import of a whole map, beside those of any import.
 * @param {Object<string, any>} given settings of source.js
 * @returns {Object<string, string>}
 */
export function mapParams(given) {
  const params = { as: "map", up: given.map_up, units_per_metre: given.map_units, heights: given.map_heights.trim(), offset: given.map_offset.trim() };
  return Object.fromEntries(Object.entries(params).filter(([, value]) => value !== ""));
}
