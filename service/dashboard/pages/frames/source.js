// From a dropped file to the form that uploads and queries send; and the fields that ask for what
// the file does not say: camera, scale, viewpoint. Shared by upload and query.

import { h } from "../lib/dom.js";
import { kindOf } from "./kinds.js";

const KEPT_AS = "sceneprint.source";
const EMPTY = {
  fx: "", fy: "", cx: "", cy: "", width: "", height: "", distortion: "", depth_scale: "1000",
  depth_along_ray: false, viewpoint: "file", units_per_metre: "1",
  robot: "", session: "", parent_frame: "", tags: "", map_up: "", map_units: "", map_heights: "", map_offset: "", bag_topic: "",
};
const PRESETS = {
  "": { label: "Custom" },
  kinect: {
    label: "Kinect, 640 × 480, f 585", fx: "585", fy: "585", cx: "320", cy: "240",
    width: "640", height: "480", distortion: "", depth_scale: "1000", depth_along_ray: false,
  },
};

/** What was typed the last time, in this tab: all fields as text ("" where nothing is said). @returns {typeof EMPTY} */
export function settings() {
  try {
    return { ...EMPTY, ...JSON.parse(sessionStorage.getItem(KEPT_AS) ?? "{}") };
  } catch {
    return { ...EMPTY };
  }
}

/** Keep settings for this tab. @param {typeof EMPTY} given */
export function remember(given) {
  try { sessionStorage.setItem(KEPT_AS, JSON.stringify(given)); } catch { /* until a reload */ }
}

/**
 * What the API is told of a file as `meta`.
 * @param {Object<string, any>} given settings, with what intrinsics.json or clouds.json say in place of theirs
 * @param {import("./kinds.js").Source} source of the file
 * @param {number[][] | null} [pose] T_parent_sensor
 * @param {{name?: string, sequence?: number}} [label] what the file is called, and its place in the session
 * @returns {Object<string, any>}
 */
export function metaOf(given, source, pose = null, label = {}) {
  const meta = /** @type {Object<string, any>} */ ({ ...label });
  for (const name of ["robot", "session"]) if (said(given[name])) meta[name] = given[name].trim();
  const tags = listOf(given.tags);
  if (tags.length) meta.tags = tags;
  if (given.up) meta.up = given.up;
  if (pose) {
    meta.pose = { matrix: pose };
    if (said(given.parent_frame)) meta.pose.parent_frame = given.parent_frame.trim();
  }
  return Object.assign(meta, source.kind === "cloud" ? ofCloud(given, source) : ofDepth(given, source));
}

function ofDepth(given, source) {
  const lens = {};
  for (const name of ["fx", "fy", "cx", "cy", "width", "height"]) {
    if (said(given[name])) lens[name] = numberOf(given[name]);
  }
  if (!Object.keys(lens).length) return {};
  // a camera told without a size has that of the image
  const size = source.width ? { width: source.width, height: source.height } : {};
  const bent = listOf(given.distortion).map(numberOf);
  if (bent.length) lens.distortion = bent;
  const meta = { intrinsics: { ...size, ...lens } };
  if (said(given.depth_scale)) meta.depth_scale = numberOf(given.depth_scale);
  if (given.depth_along_ray) meta.depth_along_ray = true;
  return meta;
}

function ofCloud(given, source) {
  const meta = {};
  // the file's own bytes tell its format, whatever was said of others
  const format = source.format === "kitti" ? "kitti" : source.format ? null : given.format;
  if (format) meta.format = format;
  if (said(given.units_per_metre)) meta.units_per_metre = numberOf(given.units_per_metre);
  const seen = given.viewpoint;
  if (seen === null || seen === "none") meta.viewpoint = null;
  else if (typeof seen === "object") meta.viewpoint = seen;
  else if (said(seen) && seen !== "file") {
    const [x, y, z] = listOf(seen).map(numberOf);
    meta.viewpoint = { x, y, z };
  }
  return meta;
}

/**
 * The form that uploads and queries send: parts `frame` and `meta`.
 * @param {File} file @param {Object<string, any>} given as of `metaOf`
 * @param {{source?: import("./kinds.js").Source, pose?: number[][] | null,
 *   label?: {name?: string, sequence?: number}}} [more] see metaOf
 * @returns {Promise<FormData>}
 */
export async function formOf(file, given, { source, pose = null, label } = {}) {
  const form = new FormData();
  form.append("meta", JSON.stringify(metaOf(given, source ?? await kindOf(file), pose, label)));
  form.append("frame", file, file.name);
  return form;
}

/** Whether a depth image could be sent with these settings. */
export function hasCamera(given) {
  return ["fx", "fy", "cx", "cy"].every((name) => said(given[name]));
}

function said(value) {
  return value !== undefined && value !== null && String(value).trim() !== "";
}

function listOf(value) {
  const parts = Array.isArray(value) ? value : String(value ?? "").split(",");
  return parts.map((one) => String(one).trim()).filter((one) => one !== "");
}

/** A number where it is one; else the text, so that the API says what is wrong with it. */
function numberOf(value) {
  const number = Number(value);
  return Number.isFinite(number) ? number : value;
}

/** A text field of the settings. @param {string} name @param {string} label @param {Object<string, any>} [props] hint: beside the label */
export function settingField(name, label, { hint = "", ...props } = {}) {
  return h("label", { class: "field" }, h("span", {}, label, hint && h("small", { class: "muted" }, ` ${hint}`)),
    h("input", { type: "text", name, autocomplete: "off", ...props }));
}

/**
 * Let fields write into settings as they change, and remember these; `refill()` shows them after others changed them.
 * @template {HTMLElement} T
 * @param {Object<string, any>} given settings() @param {T} element with fields of their names
 * @param {{onchange?: () => void, onshow?: () => void}} [heard] onshow: also after a refill
 * @returns {T & {refill: () => void}}
 */
export function settingsForm(given, element, { onchange = () => {}, onshow = () => {} } = {}) {
  function refill() {
    for (const one of /** @type {NodeListOf<HTMLInputElement>} */ (element.querySelectorAll("[name]"))) {
      if (one.type === "checkbox") one.checked = Boolean(given[one.name]); else one.value = textOf(given[one.name]);
    }
    onshow();
  }
  element.addEventListener("input", (event) => {
    const { name, type, checked, value } = /** @type {HTMLInputElement} */ (event.target);
    if (!name) return;
    given[name] = type === "checkbox" ? checked : value;
    remember(/** @type {any} */ (given));
    onshow();
    onchange();
  });
  refill();
  return Object.assign(element, { refill });
}

/**
 * Fields for the camera of depth images, and, folded, for how clouds are read.
 * @param {typeof EMPTY} given settings()
 * @param {{onchange?: () => void}} [heard]
 */
export function cameraFields(given, { onchange = () => {} } = {}) {
  const number = (name, label, props) => settingField(name, label, { inputmode: "decimal", ...props });
  const preset = h("select", {
    onchange: () => {
      const { label, ...values } = PRESETS[preset.value];
      Object.assign(given, values);
      remember(given);
      form.refill();
      onchange();
    },
  }, Object.entries(PRESETS).map(([value, { label }]) => h("option", { value }, label)));
  const onshow = () => {
    const fits = Object.entries(PRESETS).find(([key, { label, ...values }]) => key
      && Object.entries(values).every(([name, value]) => textOf(given[name]) === textOf(value)));
    preset.value = fits?.[0] ?? "";
  };
  const form = settingsForm(given, h("div", { class: "source-fields" },
    h("fieldset", null,
      h("legend", null, "Camera settings"),
      h("label", { class: "field source-preset" }, h("span", null, "Preset"), preset),
      h("div", { class: "source-row" },
        number("fx", "fx", { hint: "px" }), number("fy", "fy", { hint: "px" }),
        number("cx", "cx", { hint: "px" }), number("cy", "cy", { hint: "px" }),
        number("width", "Width", { hint: "px", placeholder: "from the image" }),
        number("height", "Height", { hint: "px", placeholder: "from the image" }),
        number("depth_scale", "Depth scale", { hint: "per metre", placeholder: "1000" }),
        number("distortion", "Distortion", { placeholder: "k1,k2,p1,p2" })),
      h("label", { class: "field source-check" }, h("input", { type: "checkbox", name: "depth_along_ray" }), h("span", null, "Samples are ranges along the pixel’s ray"))),
    h("details", null,
      h("summary", null, "Point clouds"),
      h("div", { class: "source-row" },
        number("viewpoint", "Viewpoint", { hint: "x,y,z in metres, file or none", placeholder: "file" }),
        number("units_per_metre", "Units per metre", { placeholder: "1" })))), { onchange, onshow });
  return form;
}

function textOf(value) {
  if (value === null) return "none";
  if (Array.isArray(value)) return value.join(", ");
  if (typeof value === "object") return [value.x, value.y, value.z].join(", ");
  return String(value ?? "");
}
