// What came of a query.

/** By status: the kind of its badge, and its words. */
export const STATUSES = {
  found: ["good", "Found"], ambiguous: ["warn", "Ambiguous"], not_found: ["warn", "Not found"],
  failed: ["bad", "Failed"], unvalidated: ["neutral", "Not validated"],
};

/** Statuses of queries that were to find a pose, and did not. */
export const LOST = ["ambiguous", "not_found", "failed"];
