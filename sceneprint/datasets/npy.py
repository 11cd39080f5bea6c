"""NPY files of float metres, read without trusting their header.

bytes  --decode_npy-->  samples (H, W) float32
"""

from __future__ import annotations

import ast
import struct
from typing import Literal

import numpy as np

from sceneprint.datasets.png import MAXIMUM_BYTES
from sceneprint.errors import UnreadableFrame
from sceneprint.types import MAXIMUM_SAMPLES, Floats32

SIGNATURE = b"\x93NUMPY"
_MAXIMUM_HEADER = 10_000  #: bytes, as in numpy; a literal that long can still be parsed safely
_TYPES = ("<f4", "<f8", "<f2", ">f4", ">f8", ">f2")


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
    header, start = _header(data)
    dtype = _dtype(header["descr"])
    height, width = _shape(header["shape"])
    expected = height * width * dtype.itemsize
    if len(data) - start != expected:
        raise UnreadableFrame(
            f"The NPY header announces {height} x {width} samples of {dtype.itemsize} bytes and "
            f"{len(data) - start} of {expected} bytes follow. Copy or write the file again."
        )
    order: Literal["C", "F"] = "F" if header["fortran_order"] is True else "C"
    samples = np.frombuffer(data, dtype=dtype, offset=start).reshape((height, width), order=order)
    with np.errstate(all="ignore"):  # a float64 beyond float32 becomes inf: missing
        return np.array(samples, dtype=np.float32, order="C")


def image_size(head: bytes) -> tuple[int, int]:
    """Width and height that the header of an NPY file tells; UnreadableFrame if it is none."""
    height, width = _shape(_header(head)[0]["shape"])
    return width, height


def _header(data: bytes) -> tuple[dict[str, object], int]:
    """Return the header and the place where the samples begin."""
    damaged = "The header of the NPY file cannot be read. Write the depth with numpy.save."
    size = {1: 2, 2: 4, 3: 4}.get(data[6]) if len(data) >= 12 else None
    if size is None:
        raise UnreadableFrame(damaged)
    (length,) = struct.unpack_from("<H" if size == 2 else "<I", data, 8)
    start = 8 + size + length
    if length > _MAXIMUM_HEADER or start > len(data):
        raise UnreadableFrame(
            f"The NPY header announces {length} bytes of itself, more than it has or may have "
            f"({_MAXIMUM_HEADER}). Copy or write the file again."
        )
    try:
        header = ast.literal_eval(data[8 + size : start].decode("utf-8").strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as cause:
        raise UnreadableFrame(damaged) from cause
    if not isinstance(header, dict) or set(header) != {"descr", "fortran_order", "shape"}:
        raise UnreadableFrame(damaged)
    if not isinstance(header["fortran_order"], bool):
        raise UnreadableFrame(damaged)
    return header, start


def _dtype(described: object) -> np.dtype[np.floating]:
    if described == "|O":
        raise UnreadableFrame(
            "The NPY file holds pickled Python objects, which could run code. "
            "Write a plain float32 array in metres."
        )
    # compared, not parsed: np.dtype would take almost anything
    if not isinstance(described, str) or described not in _TYPES:
        raise UnreadableFrame(
            f"The NPY file holds {described if isinstance(described, str) else 'records'!r:.40}, "
            "and depth is float32 in metres (float64 and float16 are taken too). Convert it, or "
            "send whole numbers as a 16-bit PNG."
        )
    return np.dtype(described)


def _shape(shape: object) -> tuple[int, int]:
    if (
        not isinstance(shape, tuple)
        or len(shape) != 2
        or not all(type(n) is int and n >= 0 for n in shape)
    ):
        raise UnreadableFrame(
            "The shape of the NPY array is not that of an image, which has two dimensions. "
            "Send one image of height x width."
        )
    height, width = shape
    if not 1 <= height * width <= MAXIMUM_SAMPLES:
        raise UnreadableFrame(
            f"The NPY file announces no samples, or more than {MAXIMUM_SAMPLES}. "
            "Send the image at a lower resolution."
        )
    return height, width
