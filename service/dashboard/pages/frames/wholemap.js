// Files of whole maps: what the form asks for them, and what the import is sent.
import { h } from "../lib/dom.js";
import { settingField, settingsForm } from "./source.js";

const UPS = [["", "Estimate"], ["z", "+z"], ["y", "+y"], ["x", "+x"], ["-z", "\u2212z"], ["-y", "\u2212y"], ["-x", "\u2212x"]];
const UNITS = [["", "From the file"], ["1", "Metres"], ["100", "Centimetres"], ["1000", "Millimetres"], ["3.28084", "Feet"]];

/** Fields of a form, which write into settings as they change. @param {any} given settings of source.js */
export function mapFields(given) {
  const choice = (name, label, options) => h("label", { class: "field" }, h("span", {}, label),
    h("select", { name }, options.map(([value, text]) => h("option", { value }, text))));
  return settingsForm(given, h("div", { class: "source-fields" }, h("details", {},
    h("summary", {}, "Whole maps"),
    h("div", { class: "source-row" },
      choice("map_up", "Up", UPS), choice("map_units", "Unit", UNITS),
      settingField("map_heights", "Sensor heights", { hint: "m above the floor", placeholder: "those of the model" }),
      settingField("map_offset", "Offset", { hint: "x,y,z m", placeholder: "from the file" })))));
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
