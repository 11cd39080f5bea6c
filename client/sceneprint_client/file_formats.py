"""Which format the file of a frame has: by its first bytes, or by its name.

bytes  --format_of-->  CloudFormat
bytes  --npy_header-->  NpyHeader: type, shape, order, where the numbers begin
"""

from __future__ import annotations

import ast
import re
import struct
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, Literal

import numpy as np

from sceneprint_client.api.frames import CloudFormat
from sceneprint_client.cdr import is_point_cloud
from sceneprint_client.errors import FrameError, UnreadableCloud
from sceneprint_client.sidecars import MAXIMUM_SAMPLES

#: Longest files of a depth image and of points that are read, bytes.
MAXIMUM_IMAGE_BYTES = 8 * MAXIMUM_SAMPLES + 65_536
MAXIMUM_CLOUD_BYTES = 512 << 20
#: First bytes of a file that tell what it is.
HEAD = 10_016


PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
NPY_SIGNATURE = b"\x93NUMPY"
_MAXIMUM_HEADER = 10_000  #: bytes, as in numpy; a literal that long can still be parsed safely
_FLOATING = ("<f4", "<f8", "<f2", ">f4", ">f8", ">f2")
_WHOLE = ("<u2", ">u2")


@dataclass(frozen=True)
class NpyHeader:
    """What an NPY file says of itself: an array of two dimensions, floating or uint16."""

    dtype: np.dtype[Any]
    shape: tuple[int, int]
    order: Literal["C", "F"]
    start: int  #: of its numbers, bytes


def npy_header(
    data: bytes, error: type[FrameError], advice: str, shapes: str, *, whole: bool = False
) -> NpyHeader:
    """The header of an NPY file of floating numbers in rows and columns.

    Parameters
    ----------
    data : the file, or its first 10,016 bytes
    error : to raise
    advice : what to write instead of an array of another type; a sentence
    shapes : what to write instead of one of another shape; two sentences
    whole : take uint16 too

    Raises
    ------
    error : it cannot be read, or is of another type or shape.
    """
    fields, start = _fields(data, error)
    dtype = _dtype(fields["descr"], error, advice, _FLOATING + _WHOLE if whole else _FLOATING)
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


def _dtype(
    described: object, error: type[FrameError], advice: str, types: tuple[str, ...]
) -> np.dtype[Any]:
    if described == "|O":
        raise error(
            "The NPY file holds pickled Python objects, which could run code. "
            "Write a plain float32 array in metres."
        )
    # compared, not parsed: np.dtype would take almost anything
    if not isinstance(described, str) or described not in types:
        raise error(
            f"The NPY file holds {described if isinstance(described, str) else 'records'!r:.40}, "
            f"and {advice}"
        )
    return np.dtype(described)


PLY_SIGNATURE = b"ply"
LAS_SIGNATURE = b"LASF"
_PCD_BEGINNING = re.compile(rb"(?:VERSION|FIELDS|COLUMNS)[ \t]")
_BLANK_LINES = re.compile(rb"[\r\n]*")
_LONGEST_COMMENT = 200  #: bytes, of a line before the header
_MAXIMUM_PCD_HEADER = 65_536  #: bytes

#: Suffixes of file names, in lower case. A .npy may be a depth image as well: its shape tells.
SUFFIXES: dict[str, CloudFormat] = {
    ".ply": "ply", ".pcd": "pcd", ".bin": "kitti", ".npy": "npy", ".las": "las", ".laz": "las",
    ".cdr": "pointcloud2",
}  # fmt: skip


#: Suffixes of recordings of ROS, whose messages are many frames.
RECORDING_SUFFIXES = (".mcap", ".db3", ".bag")


def format_of(data: bytes) -> CloudFormat | None:
    """What the first bytes of a file tell, or None; a KITTI scan has nothing that tells it.

    Parameters
    ----------
    data : the file, or its first 10,016 bytes
    """
    if data.startswith(NPY_SIGNATURE):
        try:
            header = npy_header(data, UnreadableCloud, "", "")
        except UnreadableCloud:
            return None
        return "npy" if header.shape[1] in (3, 4) else None
    if data[: len(PLY_SIGNATURE) + 1] in (b"ply\n", b"ply\r", b"ply "):
        return "ply"
    if data.startswith(LAS_SIGNATURE):
        return "las"
    if is_point_cloud(data):
        return "pointcloud2"
    return "pcd" if is_pcd(data) else None


def is_pcd(data: bytes) -> bool:
    """Whether a file begins as PCD files do."""
    head, at = data[:_MAXIMUM_PCD_HEADER], 0
    while (found := _BLANK_LINES.match(head, at)) is not None:
        at = found.end()
        if head[at : at + 1] != b"#":
            break
        end = head.find(b"\n", at, at + _LONGEST_COMMENT + 2)
        if end < 0:
            return False
        at = end + 1
    return _PCD_BEGINNING.match(head, at) is not None


def is_cloud(file: str) -> bool:
    """Whether a file of that name holds points whatever is beside it; a .npy may be depth."""
    suffix = PurePath(file).suffix.lower()
    return suffix in SUFFIXES and suffix != ".npy"
