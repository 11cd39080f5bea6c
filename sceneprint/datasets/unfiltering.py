"""The filters of PNG undone: what each row is the difference of, added again (PNG, section 9).

rows (H, 1 + 2 W) uint8  --unfilter-->  samples (H, W) uint16
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

#: Bytes of a pixel: the one to the left of a byte is so far before it.
_BACK = 2
_NONE, _SUB, _UP, _AVERAGE, _PAETH = range(5)


def unfilter(rows: NDArray[np.uint8]) -> NDArray[np.uint16] | None:
    """The samples of a 16-bit greyscale PNG that is not interlaced.

    Parameters
    ----------
    rows : (H, 1 + 2 W) the rows, each with its filter before it

    Returns
    -------
    samples : (H, W), or None where a filter is none
    """
    height, width = rows.shape[0], rows.shape[1] - 1
    plain = np.empty((height, width), np.uint8)
    if not _undo(rows, plain):
        return None
    return plain.view(">u2").astype(np.uint16)


@numba.njit(nogil=True, cache=True)
def _undo(rows: NDArray[np.uint8], plain: NDArray[np.uint8]) -> bool:
    """Write the plain bytes; False where a filter is none."""
    height, width = plain.shape
    above = np.zeros(width, np.uint8)
    for y in range(height):
        kind, row, out = rows[y, 0], rows[y, 1:], plain[y]
        if kind == _NONE:
            for x in range(width):
                out[x] = row[x]
        elif kind == _SUB:
            for x in range(min(_BACK, width)):
                out[x] = row[x]
            for x in range(_BACK, width):
                out[x] = (int(row[x]) + int(out[x - _BACK])) & 255
        elif kind == _UP:
            for x in range(width):
                out[x] = (int(row[x]) + int(above[x])) & 255
        elif kind == _AVERAGE:
            for x in range(width):
                left = int(out[x - _BACK]) if x >= _BACK else 0
                out[x] = (int(row[x]) + ((left + int(above[x])) >> 1)) & 255
        elif kind == _PAETH:
            for x in range(width):
                left = int(out[x - _BACK]) if x >= _BACK else 0
                corner = int(above[x - _BACK]) if x >= _BACK else 0
                top = int(above[x])
                to_left = abs(top - corner)
                to_top = abs(left - corner)
                to_corner = abs(left + top - 2 * corner)
                if to_left <= to_top and to_left <= to_corner:
                    nearest = left
                elif to_top <= to_corner:
                    nearest = top
                else:
                    nearest = corner
                out[x] = (int(row[x]) + nearest) & 255
        else:
            return False
        above = out
    return True
