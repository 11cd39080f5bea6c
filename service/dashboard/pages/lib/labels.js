// Labels beside places of a picture, so that none lies over another.

const BESIDE = 8, ABOVE = 6; // pixels between a place and its label
const GAP = 2, RINGS = 4; // between two labels; rows of spots above and below a place

/**
 * Offsets of labels from their places: the first spot that is free, from the upper right on. Labels choose in turn.
 * @param {{x: number, y: number, width: number, height: number}[]} labels place and size of each, pixels
 * @param {{width: number, height: number}} [room] that labels stay in
 * @returns {([number, number] | null)[]} null: no spot is free
 */
export function spread(labels, room = { width: Infinity, height: Infinity }) {
  const taken = [];
  return labels.map(({ x, y, width, height }) => {
    for (let ring = 0; ring < RINGS; ring += 1) {
      const away = ABOVE + ring * (height + GAP);
      for (const [dx, dy] of [[BESIDE, -away - height], [BESIDE, away], [-BESIDE - width, -away - height], [-BESIDE - width, away]]) {
        const [left, top] = [x + dx, y + dy], [right, bottom] = [left + width, top + height];
        const isIn = room.width === Infinity || (left >= 0 && top >= 0 && right <= room.width && bottom <= room.height);
        if (!isIn || taken.some((one) => left < one.right + GAP && right > one.left - GAP && top < one.bottom + GAP && bottom > one.top - GAP)) continue;
        taken.push({ left, top, right, bottom });
        return [dx, dy];
      }
    }
    return null;
  });
}
