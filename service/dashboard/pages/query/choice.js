// Which frame is looked at: pointed at for a moment, or chosen until another is. All rows, the heat
// map and "why not" hear of it, so that one sees how a frame moved, or where it fell out.

/**
 * @returns {{point: (key: string | null) => void, choose: (key: string | null) => void,
 *   toggle: (key: string) => void, hear: (heard: (key: string | null, chosen: string | null) => void) => void,
 *   readonly chosen: string | null}}
 */
export function choice() {
  const listeners = [];
  /** @type {string | null} */
  let pointed = null;
  /** @type {string | null} */
  let chosen = null;
  const tell = () => { for (const heard of listeners) heard(pointed ?? chosen, chosen); };
  return {
    point(key) { if (key !== pointed) { pointed = key; tell(); } },
    choose(key) { chosen = key; pointed = null; tell(); },
    toggle(key) { chosen = chosen === key ? null : key; tell(); },
    hear(heard) { listeners.push(heard); heard(pointed ?? chosen, chosen); },
    get chosen() { return chosen; },
  };
}
