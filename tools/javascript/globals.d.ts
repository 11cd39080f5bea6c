// Additions of the dashboard to the browser's objects.

interface HTMLCanvasElement {
  /** Viewer that draws on the canvas; tests and benchmarks read it. */
  viewer?: import("../../service/dashboard/pages/viewer/viewer.js").Viewer;
  /** Overlay or place on the canvas; tests and benchmarks read it. */
  scene?:
    | import("../../service/dashboard/pages/overlay/scene.js").Scene
    | import("../../service/dashboard/pages/paths/scene.js").Scene;
  /** Resolves to whether the picture was drawn. */
  ready?: Promise<boolean>;
}

interface WindowEventMap {
  "sceneprint:live": CustomEvent<string>;
  "sceneprint:go": CustomEvent;
  "sceneprint:theme": CustomEvent;
}

interface Document {
  /** Elements of index.html, which always exist. */
  getElementById(id: "actions" | "banner" | "crumbs" | "main" | "nav" | "rail-foot" | "tabs" | "title" | "toasts"): HTMLElement;
  /** An undefined id finds no element. */
  getElementById(id: string | undefined): HTMLElement | null;
  querySelector(selectors: ".skip"): HTMLElement;
}

/** An error: a Problem of lib/http.js, or a defect of the dashboard. */
type Fault = Error & Partial<import("../../service/dashboard/pages/lib/http.js").Problem>;

/** Result of setTimeout; null without a timer. */
type Timer = number | null;

interface HTMLDialogElement {
  /** Every dialog is a `sheet` of lib/states.js, with a form. */
  querySelector(selectors: "form"): HTMLFormElement;
  querySelector(selectors: string): HTMLElement | null;
}

/** Clearing a missing timer has no effect. */
declare function clearTimeout(id: number | null | undefined): void;
