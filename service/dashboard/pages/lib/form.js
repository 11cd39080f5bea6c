// Dialogs that save what is typed, and stay while it is refused.
import { put } from "./dom.js";
import { coded } from "./prose.js";

/** Why the API refuses a request, field by field where it says so. @param {Fault} error */
export function reasonOf({ errors, detail, message }) {
  const reasons = (errors ?? []).map(({ field, reason }) => (field ? `${field}: ${reason}` : reason));
  return coded(reasons.join(". ") || (detail ?? message));
}

/**
 * Save when the form of a dialog is submitted, once at a time, and close the dialog when that is done.
 * @param {HTMLDialogElement} dialog with a button of class `primary`
 * @param {() => Promise<any>} save rejected with what the API refuses; false: there is nothing to save yet
 * @param {(error: Fault) => any} [refuse] say why it is refused; default: in the first `.field-error`
 */
export function saveFrom(dialog, save, refuse = (error) => put(/** @type {Element} */ (dialog.querySelector(".field-error")), reasonOf(error))) {
  const button = /** @type {HTMLButtonElement} */ (dialog.querySelector(".primary"));
  dialog.querySelector("form")?.addEventListener("submit", async (event) => {
    event.preventDefault();
    if (button.disabled) return;
    button.disabled = true;
    for (const one of dialog.querySelectorAll(".field-error")) put(one);
    for (const one of dialog.querySelectorAll("[aria-invalid]")) one.removeAttribute("aria-invalid");
    try {
      if (await save() !== false) dialog.close();
    } catch (error) {
      if (error.status === undefined || error.status === 401 || !dialog.open) { dialog.close(); throw error; } // told elsewhere
      await refuse(error);
    } finally {
      button.disabled = false;
    }
  });
}
