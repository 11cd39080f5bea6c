// Work for what is in view, a few at a time: hundreds of maps must not be hundreds of requests.

const AT_ONCE = 3;
const AHEAD = "200px"; // so that it is there when it is scrolled to

/**
 * Elements that are filled when they come into view.
 * @param {AbortSignal} signal of the page
 * @returns {{join: (element: Element, fill: () => Promise<void>) => void, leave: (element: Element) => void}}
 */
export function inView(signal) {
  const fills = new Map();
  const queue = new Set(); // those that came into view first are first
  let busy = 0;

  const observer = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      if (isIntersecting) queue.add(target); else queue.delete(target);
    }
    next();
  }, { rootMargin: AHEAD });
  signal.addEventListener("abort", () => { observer.disconnect(); queue.clear(); });

  async function next() {
    while (busy < AT_ONCE && queue.size && !signal.aborted) {
      const [element] = queue;
      queue.delete(element);
      observer.unobserve(element); // once is enough: from then on events tell of changes
      busy += 1;
      fills.get(element)().finally(() => { busy -= 1; next(); });
    }
  }

  return {
    join(element, fill) { fills.set(element, fill); observer.observe(element); },
    leave(element) { observer.unobserve(element); queue.delete(element); fills.delete(element); },
  };
}
