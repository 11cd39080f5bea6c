// How a query can be asked: the fields of the controls, and between them, an address, and JSON.
// A field that says nothing (null) has the service's default, which is told beside it.

/**
 * @typedef {{name: string, group: string, within?: string, label: string, hint: string,
 *   kind: "range" | "number" | "flag" | "choice" | "text", min?: number, max?: number,
 *   step?: number, unit?: string, choices?: [string, string][], default?: any}} Field
 */

/** Headings of the groups, in their order. */
export const GROUPS = {
  search: "Search",
  diversity: "Diversity",
  validation: "Validation",
  filter: "Filter: frames that",
};

/** @type {Field[]} */
export const FIELDS = [
  { name: "k", group: "search", label: "Matches", kind: "range", min: 1, max: 50, step: 1, default: 5,
    hint: "Accepted matches to list. The pose does not depend on it: it rests on the first five that are accepted." },
  { name: "candidates", group: "search", label: "Candidates", kind: "range", min: 1, max: 200, step: 1, default: 10,
    hint: "Number of ranked frames to select and validate, about 20 ms each. Default: 10, or the number of matches if larger." },
  { name: "stages", group: "search", label: "Stages", kind: "choice", default: "retrieve,diversify,validate",
    choices: [["retrieve,diversify,validate", "Rank, diversify, validate"], ["retrieve,validate", "Rank, validate"],
      ["retrieve,diversify", "Rank, diversify"], ["retrieve", "Rank"]],
    hint: "VDR, VR, DR and R of the paper." },
  { name: "exact", group: "search", label: "Compare every frame", kind: "flag", default: false,
    hint: "Makes a difference only in very large maps and with PostgreSQL search, which skip some frames otherwise." },
  { name: "seed", group: "search", label: "Seed", kind: "number", min: 0, max: 4294967295, step: 1, default: 0,
    hint: "Random seed of validation." },
  { name: "confidence", group: "search", label: "Confidence", kind: "number", min: 0.5, max: 0.999, step: 0.001, default: 0.99,
    hint: "Minimum probability of a pose that is found; below it the answer is ambiguous." },
  { name: "deadline_ms", group: "search", label: "Deadline", kind: "number", min: 1, max: 600000, step: 1, unit: "ms", default: null,
    hint: "Skips candidates that would finish later." },
  { name: "sigma", group: "diversity", within: "diversity", label: "Sigma", kind: "range", min: 0.05, max: 10, step: 0.05, default: 1,
    hint: "A larger value treats more frames as similar." },
  { name: "omega", group: "diversity", within: "diversity", label: "Omega", kind: "range", min: 0.1, max: 40, step: 0.1, default: 4,
    hint: "A larger value favours diversity over rank." },
  { name: "mode", group: "validation", within: "validation", label: "Mode", kind: "choice", default: "full",
    choices: [["full", "full: residual and evidence"], ["paper", "paper: residual alone"]],
    hint: "With the residual alone, more wrong matches are accepted." },
  { name: "residual_m", group: "validation", within: "validation", label: "Residual, translation", kind: "range", min: 0.005, max: 1, step: 0.005, unit: "m",
    hint: "Maximum disagreement of the two directions." },
  { name: "residual_deg", group: "validation", within: "validation", label: "Residual, rotation", kind: "range", min: 0.5, max: 45, step: 0.5, unit: "°",
    hint: "Maximum disagreement in rotation." },
  { name: "evidence", group: "validation", within: "validation", label: "Evidence", kind: "range", min: 0, max: 1, step: 0.01,
    hint: "Minimum overlap minus weighted violations." },
  { name: "violation_weight", group: "validation", within: "validation", label: "Violation weight", kind: "range", min: 0, max: 100, step: 0.5,
    hint: "Penalty of a point that the other sensor saw through." },
  { name: "plane_overlap", group: "validation", within: "validation", label: "Overlap by planes", kind: "range", min: 0, max: 1, step: 0.01,
    hint: "Minimum with equal weight for every plane: a floor alone is not enough." },
  { name: "strong", group: "validation", within: "validation", label: "Strong from", kind: "range", min: 0, max: 1, step: 0.01,
    hint: "Minimum evidence of a strong match." },
  { name: "weak", group: "validation", within: "validation", label: "Weak from", kind: "range", min: 0, max: 1, step: 0.01,
    hint: "Ambiguity from which an accepted match is weak." },
  { name: "ambiguous", group: "validation", within: "validation", label: "Ambiguous from", kind: "range", min: 0, max: 1, step: 0.01,
    hint: "Ambiguity from which no match is accepted." },
  { name: "ambiguous_share", group: "validation", within: "validation", label: "Ambiguous share", kind: "range", min: 0, max: 10, step: 0.05,
    hint: "The same limit as a share of the plane overlap." },
  { name: "session", group: "filter", within: "filter", label: "are of session", kind: "text", default: null,
    hint: "Comma-separated; matches any." },
  { name: "not_within_s", group: "filter", within: "filter", label: "are not within", kind: "number", min: 0, step: 1, unit: "s of the query", default: null,
    hint: "For loop closure within its own session; the query needs a session and a time." },
];

const OWN = Object.fromEntries(FIELDS.map((field) => [field.name, field]));

/** Nothing said: all defaults. @returns {Object<string, any>} */
export function defaults() {
  return Object.fromEntries(FIELDS.map(({ name }) => [name, null]));
}

/**
 * The fields with the defaults of a map's model: what a match must stand is the model's.
 * @param {Object<string, any> | null} model of GET /v1/models
 * @returns {Field[]}
 */
export function fieldsOf(model) {
  const own = model?.parameters?.validation?.acceptance ?? {};
  const known = { ...own, residual_deg: (own.residual_rad ?? NaN) * 180 / Math.PI };
  return FIELDS.map((field) => {
    const value = known[field.name];
    return field.group === "validation" && Number.isFinite(value) ? { ...field, default: tidy(value) } : field;
  });
}

/** What an address says. @param {URLSearchParams} search @returns {Object<string, any>} */
export function fromSearch(search) {
  const said = defaults();
  for (const { name, kind } of FIELDS) {
    const text = search.get(name);
    if (text === null || text === "") continue;
    if (kind === "flag") said[name] = text === "true";
    else if (kind === "range" || kind === "number") said[name] = Number.isFinite(Number(text)) ? Number(text) : null;
    else said[name] = text;
  }
  return said;
}

/** As an address has it: what is not default. */
export function toSearch(said) {
  return Object.fromEntries(Object.entries(said).filter(([name, value]) => name in OWN && value !== null && value !== ""));
}

/**
 * What a query was asked with, and the rest of its filter, which the controls do not show.
 * @param {Object<string, any>} options of GET /v1/queries/ID/question
 * @returns {{said: Object<string, any>, rest: Object<string, any>}}
 */
export function fromOptions(options) {
  const said = defaults();
  for (const { name, within } of FIELDS) {
    const value = within ? options[within]?.[name] : options[name];
    if (value === undefined || value === null) continue;
    said[name] = Array.isArray(value) ? value.join(",") : value;
  }
  if (said.stages === OWN.stages.default) said.stages = null;
  const { session, not_within_s: _, ...rest } = options.filter ?? {};
  return { said, rest };
}

/**
 * Options as JSON, null for a default.
 * @param {Object<string, any>} [rest] more of the filter
 * @returns {Object<string, any>}
 */
export function toOptions(said, rest = {}) {
  const told = { k: null, candidates: null, stages: null, exact: null, seed: null, confidence: null, deadline_ms: null,
    diversity: null, validation: null, filter: Object.keys(rest).length ? { ...rest } : null };
  for (const { name, within } of FIELDS) {
    let value = said[name];
    if (value === null || value === undefined || value === "") continue;
    if (name === "session") value = value.split(",").map((one) => one.trim()).filter(Boolean);
    if (within) told[within] = { ...told[within], [name]: value };
    else told[name] = value;
  }
  return told;
}

/** Without what is null: a query that was never asked has nothing to put back. */
export function plain(options) {
  return Object.fromEntries(Object.entries(options).filter(([, value]) => value !== null && value !== undefined));
}

/** As a form has them, beside the file. @param {FormData} form */
export function fill(form, options) {
  for (const [name, value] of Object.entries(plain(options))) {
    form.append(name, typeof value === "object" && !Array.isArray(value) ? JSON.stringify(value) : String(value));
  }
  return form;
}

function tidy(value) {
  return Number(value.toFixed(6));
}
