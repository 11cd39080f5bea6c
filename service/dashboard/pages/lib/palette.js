// Colours of things with names, the same on every page.

/** Number of colours of robots, `--robot-0` and so on in style.css. */
const ROBOTS = 6;

/**
 * Give each name a colour that stays when others come: by its hash, and where that is taken the next; the first
 * names choose first.
 * @param {string[]} names @param {number} size number of colours
 * @returns {Map<string, number>}
 */
export function paletteOf(names, size) {
  const taken = new Set(), colours = new Map();
  for (const name of names) {
    let hash = 0;
    for (const letter of name) hash = (31 * hash + letter.charCodeAt(0)) % 65521;
    let colour = hash % size;
    while (taken.has(colour)) colour = (colour + 1) % size;
    taken.add(colour);
    if (taken.size === size) taken.clear();
    colours.set(name, colour);
  }
  return colours;
}

/** Tokens of the colours of robots. @param {string[]} names @returns {Map<string, string>} */
export function robotTokens(names) {
  return new Map([...paletteOf([...new Set(names)].sort(), ROBOTS)].map(([name, colour]) => [name, `--robot-${colour}`]));
}
