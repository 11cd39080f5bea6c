"""LZF, which binary_compressed PCD files are packed with (M. Lehmann's liblzf 3.6).

packed, size  --inflate-->  bytes

A control byte below 32 is followed by so many bytes and one more, as they are. Any other has, in
its upper three bits, how many bytes to repeat beyond two (7: and a byte more of them follows), and
in its lower five the upper part of how far back they begin.
"""

from __future__ import annotations

import numpy as np

from sceneprint.errors import UnreadableCloud
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Bytes

#: Most bytes that one packed byte can become: three of a repetition tell 264.
MOST_RATIO = 88


def inflate(packed: Bytes, size: int) -> Bytes:
    """The bytes that were packed.

    Parameters
    ----------
    packed : (n,)
    size : how many there must be; the caller has made sure that so many are wanted

    Raises
    ------
    UnreadableCloud : there are more, fewer, or the packed ones make no sense.
    """
    if size > MOST_RATIO * len(packed):  # before anything is allocated
        raise UnreadableCloud(
            f"The file announces {size} bytes packed into {len(packed)}, and LZF packs at most "
            f"{MOST_RATIO} into one. Copy or write the file again."
        )
    out = np.empty(size, np.uint8)
    if _inflate(packed, out) != size:
        raise UnreadableCloud(
            f"The compressed points are damaged: they do not become {size} bytes. "
            "Copy or write the file again."
        )
    return out


@kernel
def _inflate(packed: Bytes, out: Bytes) -> int:
    """Fill `out`, and return how many bytes there were; -1 where there are more, or none."""
    i, o, size, room = 0, 0, len(packed), len(out)
    while i < size:
        control = int(packed[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > size or o + length > room:
                return -1
            for k in range(length):
                out[o + k] = packed[i + k]
            i += length
        else:
            length = control >> 5
            if length == 7:
                if i >= size:
                    return -1
                length += int(packed[i])
                i += 1
            if i >= size:
                return -1
            length += 2
            back = o - ((control & 31) << 8) - int(packed[i]) - 1
            i += 1
            if back < 0 or o + length > room:
                return -1
            for k in range(length):  # one by one: what is repeated may overlap itself
                out[o + k] = out[back + k]
        o += length
    return o
