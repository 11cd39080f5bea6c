"""The size of a depth image, by its header alone.

first bytes  --size_of-->  width, height
"""

from __future__ import annotations

import struct

from sceneprint.datasets import npy, png
from sceneprint.errors import UnreadableFrame
from sceneprint.scans.npy_headers import SIGNATURE

#: Bytes that are enough to know: of a PNG 24, of an NPY file its whole header.
HEAD = 10_016


def size_of(head: bytes) -> tuple[int, int] | None:
    """Width and height of the image of a PNG or NPY file, pixels; None where it is neither.

    Parameters
    ----------
    head : first `HEAD` bytes of the file
    """
    if head.startswith(png.SIGNATURE) and len(head) >= 24:
        width, height = struct.unpack_from(">II", head, 16)
        return width, height
    if head.startswith(SIGNATURE):
        try:
            return npy.image_size(head)
        except UnreadableFrame:  # whoever decodes it says why
            pass
    return None
