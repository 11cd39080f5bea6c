"""NPY files of float metres, read without trusting their header.

bytes  --decode_npy-->  samples (H, W) float32
"""

from __future__ import annotations

import numpy as np

from sceneprint.datasets.png import MAXIMUM_BYTES
from sceneprint.errors import UnreadableFrame
from sceneprint.scans.npy_headers import SIGNATURE, NpyHeader, npy_header
from sceneprint.types import MAXIMUM_SAMPLES, Floats32

_TYPES = (
    "depth is float32 in metres (float64 and float16 are taken too). Convert it, or send whole "
    "numbers as a 16-bit PNG."
)
_SHAPES = (
    "The shape of the NPY array is not that of an image, which has two dimensions. "
    "Send one image of height x width."
)


def decode_npy(data: bytes) -> Floats32:
    """Return the samples of an NPY file, in metres.

    Parameters
    ----------
    data : the whole file: one two-dimensional array of float32, float64 or float16

    Returns
    -------
    samples : (H, W) float32, with whatever NaN and infinities the file holds

    Raises
    ------
    UnreadableFrame : the file is empty, no NPY, too large, of another type or shape, holds
        Python objects, or its size contradicts its header.
    """
    if not data:
        raise UnreadableFrame("The file is empty. Copy or write it again.")
    if len(data) > MAXIMUM_BYTES:
        raise UnreadableFrame(
            f"The file has {len(data)} bytes, the limit is {MAXIMUM_BYTES}. "
            "Send the image at a lower resolution."
        )
    if not data.startswith(SIGNATURE):
        raise UnreadableFrame("This is no NPY file. Write the depth with numpy.save.")
    header = _header(data)
    height, width = header.shape
    expected = height * width * header.dtype.itemsize
    if len(data) - header.start != expected:
        raise UnreadableFrame(
            f"The NPY header announces {height} x {width} samples of {header.dtype.itemsize} bytes "
            f"and {len(data) - header.start} of {expected} bytes follow. Copy or write the file "
            "again."
        )
    numbers = np.frombuffer(data, header.dtype, offset=header.start)
    samples = numbers.reshape(header.shape, order=header.order)
    with np.errstate(all="ignore"):  # a float64 beyond float32 becomes inf: missing
        return np.array(samples, dtype=np.float32, order="C")


def image_size(head: bytes) -> tuple[int, int]:
    """Width and height that the header of an NPY file tells; UnreadableFrame if it is none."""
    height, width = _header(head).shape
    return width, height


def _header(data: bytes) -> NpyHeader:
    header = npy_header(data, UnreadableFrame, _TYPES, _SHAPES)
    height, width = header.shape
    if not 1 <= height * width <= MAXIMUM_SAMPLES:
        raise UnreadableFrame(
            f"The NPY file announces no samples, or more than {MAXIMUM_SAMPLES}. "
            "Send the image at a lower resolution."
        )
    return header
