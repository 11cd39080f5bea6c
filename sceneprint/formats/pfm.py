"""Reading of portable float maps (PFM), a format of multi-view stereo programs.

bytes  --decode_pfm-->  samples (H, W) float32, metres
"""

from __future__ import annotations

import math
import re

import numpy as np

from sceneprint.errors import UnreadableFrame
from sceneprint.types import MAXIMUM_SAMPLES, Floats32

#: Header: type with one channel, width, height, and a scale whose sign is the byte order.
_HEADER = re.compile(
    rb"Pf\s+(\d{1,9})\s+(\d{1,9})\s+"
    rb"([-+]?(?:\d{1,9}\.?\d{0,20}|\.\d{1,20})(?:[eE][-+]?\d{1,3})?)[ \t\r]*\n"
)


def decode_pfm(data: bytes) -> Floats32:
    """Decode the samples (H, W) of a PFM file, metres; the file stores the bottom row first.

    Raise UnreadableFrame if the header is damaged or contradicts the size of the data.
    """
    (width, height), scale, start = _read_header(data)
    if len(data) - start != 4 * width * height:
        raise UnreadableFrame(
            f"The PFM header declares {width} x {height} samples of 4 bytes, but "
            f"{len(data) - start} bytes follow. Copy or write the file again."
        )
    rows = np.frombuffer(data, "<f4" if scale < 0 else ">f4", offset=start).reshape(height, width)
    with np.errstate(all="ignore"):  # overflows are missing samples
        return (rows[::-1] * np.float32(abs(scale))).astype(np.float32)


def pfm_size(head: bytes) -> tuple[int, int]:
    """Return the width and height of a PFM file; raise UnreadableFrame if its header is damaged."""
    return _read_header(head)[0]


def _read_header(data: bytes) -> tuple[tuple[int, int], float, int]:
    """Return the width and height, the scale, and the offset of the samples."""
    match = _HEADER.match(data)
    if match is not None:
        width, height, scale = int(match[1]), int(match[2]), float(match[3])
        if 1 <= width * height <= MAXIMUM_SAMPLES and scale and math.isfinite(scale):
            return (width, height), scale, match.end()
    raise UnreadableFrame(
        "The header of the PFM file is damaged, or the number of samples is not between 1 and "
        f"{MAXIMUM_SAMPLES}. Write one channel (Pf) of float32 metres."
    )
