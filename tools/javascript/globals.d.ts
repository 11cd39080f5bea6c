// What the dashboard adds to the browser's own objects.

interface HTMLCanvasElement {
  /** The view that draws here; the tests and benchmarks read it. */
  viewer?: import("../../service/dashboard/pages/viewer/viewer.js").Viewer;
  /** The overlay or the place that is drawn here; likewise. */
  scene?:
    | import("../../service/dashboard/pages/overlay/scene.js").Scene
    | import("../../service/dashboard/pages/paths/scene.js").Scene;
  /** Whether the picture was drawn, once that is known. */
  ready?: Promise<boolean>;
}

interface WindowEventMap {
  "sceneprint:live": CustomEvent<string>;
  "sceneprint:go": CustomEvent;
  "sceneprint:theme": CustomEvent;
}

interface Document {
  /** Elements of index.html, which are always there. */
  getElementById(id: "actions" | "banner" | "crumbs" | "main" | "nav" | "rail-foot" | "tabs" | "title" | "toasts"): HTMLElement;
  /** Nothing has no id. */
  getElementById(id: string | undefined): HTMLElement | null;
  querySelector(selectors: ".skip"): HTMLElement;
}

/** What went wrong: a Problem of lib/http.js, or a fault of ours. */
type Fault = Error & Partial<import("../../service/dashboard/pages/lib/http.js").Problem>;

/** What setTimeout gave; null where nothing is waited for. */
type Timer = number | null;

interface HTMLDialogElement {
  /** Every dialog is a `sheet` of lib/states.js, with a form. */
  querySelector(selectors: "form"): HTMLFormElement;
  querySelector(selectors: string): HTMLElement | null;
}

/** A timer that was never set is cleared as well. */
declare function clearTimeout(id: number | null | undefined): void;
