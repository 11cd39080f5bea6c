"""Read portable float maps (PFM), which programs for multi-view stereo write.

bytes  --decode_pfm-->  samples (H, W) float32, metres
"""

from __future__ import annotations

import math
import re

import numpy as np

from sceneprint.errors import UnreadableFrame
from sceneprint.types import MAXIMUM_SAMPLES, Floats32

#: Three lines: one channel, width and height, and a scale whose sign gives the byte order.
_HEADER = re.compile(
    rb"Pf\s+(\d{1,9})\s+(\d{1,9})\s+"
    rb"([-+]?(?:\d{1,9}\.?\d{0,20}|\.\d{1,20})(?:[eE][-+]?\d{1,3})?)[ \t\r]*\n"
)


def decode_pfm(data: bytes) -> Floats32:
    """Return the samples of a PFM file, metres, whose rows go from the bottom to the top.

    Raises
    ------
    UnreadableFrame : The header is damaged, or does not fit the size of the data.
    """
    (width, height), scale, start = _header(data)
    if len(data) - start != 4 * width * height:
        raise UnreadableFrame(
            f"The PFM header announces {width} x {height} samples of 4 bytes, and "
            f"{len(data) - start} bytes follow. Copy or write the file again."
        )
    rows = np.frombuffer(data, "<f4" if scale < 0 else ">f4", offset=start).reshape(height, width)
    with np.errstate(all="ignore"):  # what overflows is missing
        return (rows[::-1] * np.float32(abs(scale))).astype(np.float32)


def pfm_size(head: bytes) -> tuple[int, int]:
    """Return the width and height of a PFM file; UnreadableFrame if the header is damaged."""
    return _header(head)[0]


def _header(data: bytes) -> tuple[tuple[int, int], float, int]:
    """Return width and height, scale, and offset of the samples."""
    found = _HEADER.match(data)
    if found is not None:
        width, height, scale = int(found[1]), int(found[2]), float(found[3])
        if 1 <= width * height <= MAXIMUM_SAMPLES and scale and math.isfinite(scale):
            return (width, height), scale, found.end()
    raise UnreadableFrame(
        "The header of the PFM file is damaged, or announces no samples or more than "
        f"{MAXIMUM_SAMPLES}. Write one channel (Pf) of float32 metres."
    )
