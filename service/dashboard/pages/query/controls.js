// The controls of a query: a slider and a number for each option, its default told, and reset.
import { h, put } from "../lib/dom.js";
import { coded } from "../lib/prose.js";
import { GROUPS } from "./options.js";

/**
 * @param {import("./options.js").Field[]} fields with the defaults of the map's model
 * @param {Object<string, any>} said by name; null for a default. It is changed in place
 * @param {{onchange: () => void, sessions?: string[]}} heard
 * @returns {HTMLElement & {refill: () => void, refuse: (errors: any[]) => void}}
 */
export function controls(fields, said, { onchange, sessions = [] }) {
  const rows = fields.map((field) => row(field, said, changed, sessions));
  const reset = h("button", { type: "button", class: "button quiet", onclick: () => {
    for (const { name } of fields) said[name] = null;
    changed();
  } }, "Reset");
  const told = h("span", { class: "muted", role: "status" });
  function changed() { refill(); onchange(); }
  function refill() {
    for (const one of rows) one.refill();
    const n = fields.filter(({ name }) => said[name] !== null).length;
    put(told, n ? `${n} changed` : "Default options");
    reset.disabled = n === 0;
  }
  const element = h("form", { class: "query-controls", onsubmit: (event) => event.preventDefault(), "aria-label": "Options" },
    h("div", { class: "query-controls-head" }, told, reset),
    Object.entries(GROUPS).map(([group, title], i) => h("details", { class: "query-group", open: i === 0 || any(fields, said, group) },
      h("summary", {}, title),
      rows.filter((one) => one.field.group === group).map((one) => one.element))));
  refill();
  return Object.assign(element, {
    refill,
    /** Mark the fields that the service refused. */
    refuse(errors) {
      for (const one of rows) {
        const wrong = errors.find((error) => String(error.field ?? "").split(".").includes(one.field.name));
        one.refuse(wrong ? String(wrong.reason) : null);
      }
    },
  });
}

function any(fields, said, group) {
  return fields.some((field) => field.group === group && said[field.name] !== null);
}

function row(field, said, onchange, sessions) {
  const id = `ask-${field.name}`;
  const about = h("small", { class: "muted query-about", id: `${id}-about` });
  const wrong = h("small", { class: "query-wrong", role: "alert" });
  const set = (value) => {
    said[field.name] = same(value, field.default) ? null : value;
    onchange();
  };
  const shown = () => said[field.name] ?? field.default;
  const inputs = kinds[field.kind](field, id, set, shown, sessions);
  const element = h("div", { class: "field query-field", dataset: { kind: field.kind, name: field.name } },
    h("label", { for: id }, field.label), inputs.elements, about, wrong);
  return {
    field, element,
    refill() {
      inputs.refill();
      element.dataset.changed = String(said[field.name] !== null);
      const unsaid = field.default === null || field.default === undefined || field.kind === "choice" || field.kind === "flag";
      put(about, field.hint, unsaid || field.name === "candidates" ? null
        : [" ", h("span", { class: "query-default" }, `Default ${field.default}${field.unit === "°" ? "°" : field.unit ? ` ${field.unit}` : ""}.`)]);
      put(wrong);
    },
    refuse(text) { put(wrong, text && coded(text)); },
  };
}

const kinds = {
  range(field, id, set, shown) {
    const { min, max, step } = field;
    const slider = h("input", { type: "range", min, max, step, "aria-label": `${field.label}, slider`, oninput: () => set(Number(slider.value)) });
    const typed = number(field, id, set);
    return { elements: [h("div", { class: "query-pair" }, slider, typed, unitOf(field))],
      refill() { slider.value = shown() ?? min; fillNumber(typed, shown()); } };
  },
  number(field, id, set, shown) {
    const typed = number(field, id, set);
    return { elements: [h("div", { class: "query-pair" }, typed, unitOf(field))], refill() { fillNumber(typed, shown()); } };
  },
  flag(_field, id, set, shown) {
    const box = h("input", { type: "checkbox", id, "aria-describedby": `${id}-about`, onchange: () => set(box.checked) });
    return { elements: [box], refill() { box.checked = Boolean(shown()); } };
  },
  choice(field, id, set, shown) {
    const select = h("select", { id, "aria-describedby": `${id}-about`, onchange: () => set(select.value) },
      field.choices.map(([value, text]) => h("option", { value }, text)));
    return { elements: [select], refill() { select.value = shown(); } };
  },
  text(_field, id, set, shown, sessions) {
    const typed = h("input", { type: "text", id, list: `${id}-known`, autocomplete: "off", "aria-describedby": `${id}-about`,
      onchange: () => set(typed.value.trim() || null) });
    return { elements: [typed, h("datalist", { id: `${id}-known` }, sessions.map((value) => h("option", { value })))],
      refill() { typed.value = shown() ?? ""; } };
  },
};

function number(field, id, set) {
  const { min, max, step } = field;
  const typed = h("input", { type: "number", id, min, max, step: field.kind === "number" ? step : "any", inputmode: "decimal", class: "number", placeholder: field.default === null ? "none" : null,
    "aria-describedby": `${id}-about`,
    onchange: () => set(typed.value === "" || !Number.isFinite(typed.valueAsNumber) ? null : typed.valueAsNumber) });
  return typed;
}

// what is being typed stays as it is typed
function fillNumber(typed, value) {
  if (document.activeElement !== typed || typed.valueAsNumber !== value) typed.value = value ?? "";
}

function unitOf(field) {
  return field.unit ? h("span", { class: "muted query-unit" }, field.unit) : null;
}

function same(a, b) {
  return a === b || (a === null && b === undefined);
}
