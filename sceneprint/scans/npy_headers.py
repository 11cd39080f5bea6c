"""The header of an NPY file, read without trusting it.

bytes  --npy_header-->  NpyHeader: type, shape, order, where the numbers begin
"""

from __future__ import annotations

import ast
import struct
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sceneprint.errors import FrameError

SIGNATURE = b"\x93NUMPY"
_MAXIMUM_HEADER = 10_000  #: bytes, as in numpy; a literal that long can still be parsed safely
_TYPES = ("<f4", "<f8", "<f2", ">f4", ">f8", ">f2")


@dataclass(frozen=True)
class NpyHeader:
    """What an NPY file says of itself: an array of two dimensions, floating."""

    dtype: np.dtype[np.floating]
    shape: tuple[int, int]
    order: Literal["C", "F"]
    start: int  #: of its numbers, bytes


def npy_header(data: bytes, error: type[FrameError], advice: str, shapes: str) -> NpyHeader:
    """The header of an NPY file of floating numbers in rows and columns.

    Parameters
    ----------
    data : the file, or its first 10,016 bytes
    error : to raise
    advice : what to write instead of an array of another type; a sentence
    shapes : what to write instead of one of another shape; two sentences

    Raises
    ------
    error : it cannot be read, or is of another type or shape.
    """
    fields, start = _fields(data, error)
    dtype = _dtype(fields["descr"], error, advice)
    shape = fields["shape"]
    if (
        not isinstance(shape, tuple)
        or len(shape) != 2
        or not all(type(n) is int and n >= 0 for n in shape)
    ):
        raise error(shapes)
    return NpyHeader(dtype, shape, "F" if fields["fortran_order"] is True else "C", start)


def _fields(data: bytes, error: type[FrameError]) -> tuple[dict[str, object], int]:
    """Return the header and the place where the numbers begin."""
    damaged = "The header of the NPY file cannot be read. Write the file with numpy.save."
    size = {1: 2, 2: 4, 3: 4}.get(data[6]) if len(data) >= 12 else None
    if size is None:
        raise error(damaged)
    (length,) = struct.unpack_from("<H" if size == 2 else "<I", data, 8)
    start = 8 + size + length
    if length > _MAXIMUM_HEADER or start > len(data):
        raise error(
            f"The NPY header announces {length} bytes of itself, more than it has or may have "
            f"({_MAXIMUM_HEADER}). Copy or write the file again."
        )
    try:
        header = ast.literal_eval(data[8 + size : start].decode("utf-8").strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as cause:
        raise error(damaged) from cause
    if not isinstance(header, dict) or set(header) != {"descr", "fortran_order", "shape"}:
        raise error(damaged)
    if not isinstance(header["fortran_order"], bool):
        raise error(damaged)
    return header, start


def _dtype(described: object, error: type[FrameError], advice: str) -> np.dtype[np.floating]:
    if described == "|O":
        raise error(
            "The NPY file holds pickled Python objects, which could run code. "
            "Write a plain float32 array in metres."
        )
    # compared, not parsed: np.dtype would take almost anything
    if not isinstance(described, str) or described not in _TYPES:
        raise error(
            f"The NPY file holds {described if isinstance(described, str) else 'records'!r:.40}, "
            f"and {advice}"
        )
    return np.dtype(described)
