"""Reading of LAS files (ASPRS LAS 1.0 to 1.4), and of LAZ files with the package lazrs.

bytes  --read_las-->  FilePoints

Records of all point formats start with X, Y, Z as integers; the header states scale and offset.
"""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import MissingDependency, UnreadableCloud
from sceneprint.formats.points.rows import MAXIMUM_POINTS, FileBytes, FilePoints, check_count, steps
from sceneprint.types import Floats
from sceneprint_client.files import LAS_SIGNATURE

# The optional package lazrs (Rust) decompresses the points of LAZ files.
#
# bytes  --inflated_records-->  blocks of records
#
# lazrs allocates memory according to the file, and Rust aborts if an allocation fails. Therefore,
# all numbers that determine allocations are compared with the file's length first (M. Isenburg,
# LASzip 1.3 and 1.4): the kinds of values in a record, the number of chunks, and, from format 6 on,
# the lengths of the layers of each chunk.

_VLR = 54  #: size of the header of a variable-length record, bytes
_MAXIMUM_VLRS = 10_000
_VARIABLE = 0xFFFFFFFF  #: chunk size in the header if chunks have different sizes
_MOST = 2 << 30  #: maximum size of all records, bytes; they are decompressed in blocks
#: Maximum compression ratio, and total size of records that is exempt from it, bytes.
_MOST_RATIO, _FREE = 250, 64 << 20

#: Size of a value by kind, bytes.
_ITEMS = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_BYTES, _LAYERED_BYTES = 0, 14


def inflated_records(
    data: FileBytes, start: int, form: int, length: int, count: int, row: np.dtype[np.void]
) -> Iterator[NDArray[np.void]]:
    """Yield the records of a LAZ file, in blocks.

    Parameters
    ----------
    data : the whole file
    start : offset of the points
    form : point format
    length : size of a record, bytes
    count : number of points
    row : dtype of a record

    Raises
    ------
    MissingDependency : If lazrs is not installed.
    UnreadableCloud : If the compressed points are damaged or contradict the header.
    """
    lazrs = _import_lazrs()
    vlr = _laszip_vlr(data)
    compressor, coder, chunk, kinds = _parse_vlr(vlr)
    layered = compressor == 3
    is_supported = layered == (form >= 6) and coder == 0 and compressor in (2, 3)
    if not is_supported or not _is_record(kinds, layered, length):
        raise UnreadableCloud(
            f"The LAZ file stores records of {length} bytes of format {form} as {kinds[:20]} with "
            f"compressor {compressor}, a combination that is not supported. {_AGAIN}"
        )
    if count * length > min(_MOST, _FREE + _MOST_RATIO * len(data)):
        raise UnreadableCloud(
            f"The LAZ file declares {count} points of {length} bytes, which exceeds "
            f"{_MOST_RATIO} times the size of the file, {len(data)} bytes. {_AGAIN}"
        )
    _check_chunks(data, start, length, kinds, count, chunk)
    return _decompress_records(lazrs, data, start, vlr, count, row)


def _decompress_records(
    lazrs: ModuleType, data: FileBytes, start: int, vlr: bytes, count: int, row: np.dtype[np.void]
) -> Iterator[NDArray[np.void]]:
    source = io.BytesIO(data) if isinstance(data, bytes) else data
    source.seek(start)
    fields = lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL | lazrs.SELECTIVE_DECOMPRESS_Z
    selection = lazrs.DecompressionSelection(fields)
    reader: Any = _call_lazrs(lazrs.LasZipDecompressor, source, vlr, selection)
    most = max(1, (4 << 20) // row.itemsize)
    for _, n in steps(count):
        table = np.empty(n, row)
        for i in range(0, n, most):
            part = bytearray(min(most, n - i) * row.itemsize)
            _call_lazrs(reader.decompress_many, part)
            table[i : i + most] = np.frombuffer(part, row)
        yield table


def _call_lazrs(function: Any, *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as cause:  # a Rust panic is not an Exception
        raise UnreadableCloud(
            f"The compressed points of the LAZ file are damaged ({str(cause)[:80]}). {_AGAIN}"
        ) from cause


def _import_lazrs() -> ModuleType:
    try:
        import lazrs
    except ImportError as cause:
        raise MissingDependency(
            "LAZ requires the package lazrs, which is not installed. Install sceneprint[las], or "
            "send the points as LAS."
        ) from cause
    module: ModuleType = lazrs
    return module


def las_records(data: FileBytes) -> Iterator[tuple[bytes, int, bytes]]:
    """Yield the user id, record id and content of each variable-length record in the header."""
    at, end, count = struct.unpack_from("<HII", data, 94)
    for _ in range(min(count, _MAXIMUM_VLRS)):
        if at + _VLR > end:
            return
        user, number, length = struct.unpack_from("<16sHH", data, at + 2)
        yield user.rstrip(b"\0"), number, data[at + _VLR : min(at + _VLR + length, end)]
        at += _VLR + length


def _laszip_vlr(data: FileBytes) -> bytes:
    """Return the variable-length record that describes the compression of the points."""
    for user, number, content in las_records(data):
        if (user, number) == (b"laszip encoded", 22204):
            return content
    raise UnreadableCloud(f"The LAZ file does not state how its points are compressed. {_AGAIN}")


def _parse_vlr(vlr: bytes) -> tuple[int, int, int, list[tuple[int, int]]]:
    """Parse the compressor, coder, points per chunk, and the kind and size of each value."""
    if len(vlr) >= 34:
        compressor, coder = struct.unpack_from("<HH", vlr, 0)
        (chunk,) = struct.unpack_from("<I", vlr, 12)
        (items,) = struct.unpack_from("<H", vlr, 32)
        if chunk and len(vlr) >= 34 + 6 * items:
            kinds = [struct.unpack_from("<HH", vlr, 34 + 6 * i) for i in range(items)]
            return compressor, coder, chunk, kinds
    raise UnreadableCloud(f"The LAZ file does not state how its points are compressed. {_AGAIN}")


def _is_record(kinds: list[tuple[int, int]], layered: bool, length: int) -> bool:
    """Return whether values of these kinds and sizes form a record of `length` bytes.

    The point must come first, and each kind may occur once.
    """
    names = [kind for kind, _ in kinds]
    free = _LAYERED_BYTES if layered else _BYTES
    return (
        names[:1] == [10 if layered else 6]
        and len(set(names)) == len(names)
        and all(k == free or (k in _ITEMS and (k >= 10) == layered) for k in names)
        and all(size == _ITEMS.get(kind, size) for kind, size in kinds)
        and sum(size for _, size in kinds) == length
    )


def _check_chunks(
    data: FileBytes, start: int, length: int, kinds: list[tuple[int, int]], count: int, chunk: int
) -> None:
    """Raise UnreadableCloud if the chunk table contradicts the file's length or the header."""
    error = UnreadableCloud(f"The chunk table of the LAZ file contradicts its points. {_AGAIN}")
    if len(data) - start < 8:
        raise error
    (table,) = struct.unpack_from("<q", data, start)
    if table == -1:  # files that were written to a pipe have the offset at their end
        (table,) = struct.unpack_from("<q", data, len(data) - 8)
    if not start + 8 <= table <= len(data) - 8:
        raise error
    version, chunks = struct.unpack_from("<II", data, table)
    # the first point of each chunk is uncompressed; this limits the number of chunks
    if version != 0 or chunks * length > len(data) or chunks > count:
        raise error
    if chunk != _VARIABLE and chunks != -(-count // chunk):
        raise error
    if kinds[0][0] != 10:
        return
    layers = sum(_LAYERS.get(kind, size) for kind, size in kinds)
    at, points = start + 8, 0
    while points < count:  # the last chunk may be empty
        head = at + length
        if head + 4 + 4 * layers > table:
            raise error
        points += struct.unpack_from("<I", data, head)[0]
        at = head + 4 + 4 * layers
        at += sum(struct.unpack_from(f"<{layers}I", data, head + 4))
    if points != count or at > table or (at < table and chunk != _VARIABLE):
        raise error


_SMALLEST_HEADER = 227  #: bytes
_AGAIN = "Copy or write the file again."

#: Size of a record by point format, bytes.
_RECORDS = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)

Records = NDArray[np.void]


def read_las(data: FileBytes, most: int = MAXIMUM_POINTS) -> FilePoints:
    """Read the points of a LAS or LAZ file.

    Raise UnreadableCloud if the file is not LAS, has an unknown point format or more than `most`
    points, or its size contradicts its header. Raise MissingDependency if the file is LAZ and lazrs
    is not installed.
    """
    if len(data) < _SMALLEST_HEADER or data[:4] != LAS_SIGNATURE:
        raise UnreadableCloud(
            "This is not a LAS file, or its header is truncated. Copy the file again."
        )
    minor, (header, start) = data[25], struct.unpack_from("<HI", data, 94)
    form, length, count = struct.unpack_from("<BHI", data, 104)
    packed, form = bool(form & 0x80), form & 0x3F
    if data[24] != 1 or minor > 4 or form >= len(_RECORDS) or length < _RECORDS[form]:
        raise UnreadableCloud(
            f"The LAS header states version {data[24]}.{minor}, point format {form} and records of "
            f"{length} bytes; versions up to 1.4 and formats up to 10 with their standard sizes "
            f"are supported. {_AGAIN}"
        )
    if minor == 4 and len(data) >= 255 and header >= 375:
        (count,) = struct.unpack_from("<Q", data, 247)  # 64-bit count of LAS 1.4
    if not _SMALLEST_HEADER <= header <= start <= len(data):
        raise UnreadableCloud(
            f"The LAS header states a size of {header} bytes and points from byte {start}, but "
            f"the file has {len(data)} bytes. {_AGAIN}"
        )
    check_count(count, most)
    transform = struct.unpack_from("<6d", data, 131)
    if not all(map(math.isfinite, transform)) or 0.0 in transform[:3]:
        raise UnreadableCloud(f"The scale of the LAS file, {transform[:3]}, is invalid. {_AGAIN}")
    row = np.dtype({"names": list("xyz"), "formats": ["<i4"] * 3, "offsets": [0, 4, 8],
                    "itemsize": length})  # fmt: skip
    if packed:
        records = inflated_records(data, start, form, length, count, row)
    else:
        if count * length > len(data) - start:
            raise UnreadableCloud(
                f"The LAS header declares {count} points of {length} bytes, but "
                f"{len(data) - start} of {count * length} bytes follow. {_AGAIN}"
            )
        table = np.frombuffer(data, row, count, start)
        records = (table[i : i + n] for i, n in steps(count))
    return FilePoints(count, _scale_records(records, transform))


def _scale_records(records: Iterator[Records], transform: tuple[float, ...]) -> Iterator[Floats]:
    for rows in records:
        block = np.empty((len(rows), 3))
        for k, name in enumerate("xyz"):
            block[:, k] = rows[name]
        yield block * transform[:3] + transform[3:]
