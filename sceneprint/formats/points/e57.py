"""Reading of E57 files (ASTM E2807): scans of laser scanners with their poses.

bytes  --read_e57-->  E57Scan, ...  --points-->  FilePoints

A file is a sequence of pages that each end with a checksum. Their payload consists of sections with
packed points, and of an XML text that describes the sections. Points are decoded in blocks, so a
scan needs a few megabytes of memory besides its file. The reference implementation (libE57) opens
files by name, but confined decoders cannot. Therefore, this module parses the format.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from mmap import mmap
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import InvalidPose, UnreadableCloud
from sceneprint.formats.points.rows import FilePoints, steps
from sceneprint.types import Bytes, Floats
from sceneprint_client.errors import printable
from sceneprint_client.poses import rigid_transform, rotation_of

#: Types for the bytes of an E57 file.
Buffer = bytes | bytearray | memoryview | mmap

E57_SIGNATURE = b"ASTM-E57"
_HEADER = struct.Struct("<8sIIQQQQ")
_SECTION = struct.Struct("<B7xQQQ")
_CHECKSUM_BYTES = 4
_PAGE_BYTES = (256, 1 << 16)  #: smallest and largest page; the standard requires 1024
_WINDOW_BYTES = 4 << 20  #: size of the window of pages whose checksums are verified at once, bytes
_MAXIMUM_XML_BYTES = 64 << 20
_MAXIMUM_SCANS = 10_000
#: Maximum number of points of a scan. Points with few bits take time even in a small file.
MAXIMUM_SCAN_POINTS = 200_000_000
_NAMESPACE = "{http://www.astm.org/COMMIT/E57/2010-e57-v1.0}"
_AGAIN = "Copy the file again, or export it again as E57."
_AS_PLY = "Export the scan as PLY, PCD or LAS."

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_INDEX, _DATA, _EMPTY = 0, 1, 2  #: kinds of packets


@dataclass(frozen=True)
class _Field:
    """A field of a point, and its packing.

    Parameters
    ----------
    name : name such as "cartesianX"; empty for a field of an extension
    bits : number of bits of a value
    dtype : type of a floating-point field; None for integers
    minimum : smallest integer; it is stored as 0
    scale, offset : parameters of value = scale * integer + offset
    """

    name: str
    bits: int
    dtype: str | None = None
    minimum: int = 0
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, eq=False)
class E57Scan:
    """A scan of an E57 file.

    Parameters
    ----------
    name : name in the file; may be empty
    count : number of points, including invalid points
    T_world_scan : (4, 4) float64 pose of the scan in the file's frame, metres
    has_pose : whether the file states the pose; otherwise, T_world_scan is the identity
    is_structured : whether the points have rows and columns, as seen from a single viewpoint
    is_spherical : whether the points are ranges and angles from the scanner
    """

    name: str
    count: int
    T_world_scan: Floats
    has_pose: bool
    is_structured: bool
    is_spherical: bool
    _pages: _Pages = field(repr=False)
    _start: int = field(repr=False)
    _fields: tuple[_Field, ...] = field(repr=False)

    def points(self) -> FilePoints:
        """Return the points in the axes of the scan, metres; invalid points are NaN.

        The blocks are decoded during iteration. The iteration raises UnreadableCloud if the packed
        points are damaged or truncated.
        """
        return FilePoints(self.count, self._blocks())

    def _blocks(self) -> Iterator[Floats]:
        names = _SPHERICAL if self.is_spherical else _CARTESIAN
        state = "sphericalInvalidState" if self.is_spherical else "cartesianInvalidState"
        by_name = {entry.name: place for place, entry in enumerate(self._fields)}
        columns = [by_name[name] for name in (*names, state) if name in by_name]
        streams = [_Stream(self._fields[place]) for place in columns]
        packets = _read_packets(self._pages, self._start, len(self._fields))
        for first, n in steps(self.count):
            while not all(stream.holds(n) for stream in streams):
                packet = next(packets, None)
                if packet is None:
                    raise UnreadableCloud(
                        f"The scan declares {self.count} points, but they end before point "
                        f"{first + n}. {_AGAIN}"
                    )
                for stream, place in zip(streams, columns, strict=True):
                    stream.add(packet[place])
            values = [stream.take(n) for stream in streams]
            block = _from_angles(*values[:3]) if self.is_spherical else np.stack(values[:3], axis=1)
            if len(values) > len(names):
                block[values[3] != 0] = np.nan
            yield block


def _from_angles(distance: Floats, azimuth: Floats, elevation: Floats) -> Floats:
    """Convert spherical coordinates (n,) to positions (n, 3); the xy plane has elevation 0."""
    with np.errstate(all="ignore"):
        level = distance * np.cos(elevation)
        return np.stack(
            (level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)), axis=1
        )


def read_e57(data: Buffer) -> tuple[E57Scan, ...]:
    """Return the scans of an E57 file in order, without decoding their points.

    Parameters
    ----------
    data : the whole file, which must not change while points are decoded

    Returns
    -------
    scans : at least one scan

    Raises
    ------
    UnreadableCloud : If the file is not E57, is damaged, has a later version or no scan, a scan has
        no coordinates or more than 200 million points, or a pose is not rigid.
    """
    if len(data) < _HEADER.size or bytes(data[:8]) != E57_SIGNATURE:
        raise UnreadableCloud(f"This is not an E57 file. {_AGAIN}")
    _, major, _, length, xml_start, xml_bytes, page = _HEADER.unpack(bytes(data[: _HEADER.size]))
    if major != 1:
        raise UnreadableCloud(
            f"The file has version {major} of E57; only version 1 is supported. {_AS_PLY}"
        )
    if not _PAGE_BYTES[0] <= page <= _PAGE_BYTES[1] or page % 4:
        raise UnreadableCloud(f"The header states an invalid page size of {page} bytes. {_AGAIN}")
    if length > len(data) or length % page:
        raise UnreadableCloud(
            f"The header declares {length} bytes, but the file has {len(data)}. {_AGAIN}"
        )
    if xml_bytes > _MAXIMUM_XML_BYTES:
        raise UnreadableCloud(
            f"The description of the scans has {xml_bytes} bytes, too many to read. {_AS_PLY}"
        )
    pages = _Pages(memoryview(data)[:length], page)
    root = _parse_description(pages.read(pages.logical(xml_start), xml_bytes))
    scans = root.findall(f"{_NAMESPACE}data3D/{_NAMESPACE}vectorChild")
    if not scans:
        raise UnreadableCloud(f"The file has no scan. {_AGAIN}")
    if len(scans) > _MAXIMUM_SCANS:
        raise UnreadableCloud(
            f"The file has {len(scans)} scans; the limit is {_MAXIMUM_SCANS}. Split the file."
        )
    return tuple(_parse_scan(pages, node, number) for number, node in enumerate(scans, start=1))


def with_viewpoint(scans: tuple[E57Scan, ...]) -> list[bool]:
    """Return, for each scan of a file, whether the scan's origin is the viewpoint of its points.

    This is true for structured scans, and for points that are ranges and angles. It is also true
    for scans with a pose if the file's poses differ or contain a rotation. Merged clouds have no
    pose, or a pose that shifts them to map coordinates.
    """
    poses = [scan.T_world_scan for scan in scans if scan.has_pose]
    turned = any(not np.allclose(T[:3, :3], np.eye(3), atol=1e-9) for T in poses)
    registered = turned or any(not np.array_equal(T, poses[0]) for T in poses)
    return [
        scan.is_structured or scan.is_spherical or (scan.has_pose and registered) for scan in scans
    ]


@lru_cache(maxsize=1)
def _crc_table() -> NDArray[np.uint32]:
    """Return the table (65536,) of CRC-32C for two bytes at a time."""
    table = np.arange(1 << 16, dtype=np.uint32)
    for _ in range(16):
        odd = (table & np.uint32(1)) * np.uint32(0x82F63B78)
        table = (table >> np.uint32(1)) ^ odd
    return table


def _checksums(payloads: Bytes) -> NDArray[np.uint32]:
    """Return the CRC-32C of each row of bytes (n, m); m is even."""
    table = _crc_table()
    words = np.ascontiguousarray(payloads.view("<u2").T)
    crc = np.full(len(payloads), 0xFFFFFFFF, np.uint32)
    for column in words:
        crc = table[(crc ^ column) & np.uint32(0xFFFF)] ^ (crc >> np.uint32(16))
    return ~crc


class _Pages:
    """The payload of a file's pages as one sequence of bytes, with verified checksums.

    Parameters
    ----------
    data : complete pages
    page : size of a page, bytes
    """

    def __init__(self, data: memoryview, page: int) -> None:
        self._data, self._page = data, page
        self._payload = page - _CHECKSUM_BYTES
        self._group = max(1, _WINDOW_BYTES // page)  # number of pages in a window
        self._window, self._number = b"", -1

    def logical(self, physical: int) -> int:
        """Convert an offset in the file to an offset in the payload."""
        number, within = divmod(physical, self._page)
        if physical >= len(self._data) or within >= self._payload:
            raise UnreadableCloud(f"A part of the file lies beyond its end. {_AGAIN}")
        return number * self._payload + within

    def read(self, start: int, length: int) -> bytes:
        """Return `length` bytes from offset `start` of the payload.

        Raise UnreadableCloud if the bytes are beyond the end, or the checksum of a page is wrong.
        """
        total = len(self._data) // self._page * self._payload
        if length > total - start:
            raise UnreadableCloud(f"A part of the file lies beyond its end. {_AGAIN}")
        pieces, span = [], self._group * self._payload
        while length:
            number, within = divmod(start, span)
            piece = self._in_window(number)[within : within + length]
            pieces.append(piece)
            start, length = start + len(piece), length - len(piece)
        return b"".join(pieces)

    def _in_window(self, number: int) -> bytes:
        if number != self._number:
            first = number * self._group * self._page
            window = self._data[first : first + self._group * self._page]
            rows = np.frombuffer(window, np.uint8).reshape(-1, self._page)
            payloads = np.ascontiguousarray(rows[:, : self._payload])
            stored = np.ascontiguousarray(rows[:, self._payload :]).view(">u4")[:, 0]
            wrong = np.flatnonzero(_checksums(payloads) != stored)
            if len(wrong):
                raise UnreadableCloud(
                    f"The file is damaged: the checksum of its page "
                    f"{number * self._group + int(wrong[0])} is wrong. {_AGAIN}"
                )
            self._window, self._number = payloads.tobytes(), number
        return self._window


# An XML text describes the scans and the packing of their points.


def _parse_description(text: bytes) -> Element:
    try:
        content = text.decode("utf-8-sig")
        # entities could expand without limit, and E57 does not use them
        if "<!DOCTYPE" in content or "<!ENTITY" in content:
            raise UnreadableCloud(f"The description of the scans declares entities. {_AGAIN}")
        return ElementTree.fromstring(content)
    except (UnicodeDecodeError, ElementTree.ParseError, ValueError) as cause:
        raise UnreadableCloud(
            printable(f"The description of the scans is damaged ({cause}). {_AGAIN}")
        ) from cause


def _parse_scan(pages: _Pages, node: Element, number: int) -> E57Scan:
    """Return a scan from its description; raise UnreadableCloud if it is not supported."""
    name = (node.findtext(f"{_NAMESPACE}name") or "").strip()
    place = printable(f"Scan {number} ({name:.60})" if name else f"Scan {number}")
    points = node.find(f"{_NAMESPACE}points")
    prototype = None if points is None else points.find(f"{_NAMESPACE}prototype")
    if points is None or prototype is None:
        raise UnreadableCloud(f"{place} has no points. {_AGAIN}")
    for codec in points.iterfind(f"{_NAMESPACE}codecs/{_NAMESPACE}vectorChild/*"):
        if codec.tag not in (f"{_NAMESPACE}inputs", f"{_NAMESPACE}bitPackCodec"):
            raise UnreadableCloud(f"{place} uses an unknown codec. {_AS_PLY}")
    count = _parse_integer(points.get("recordCount"), place)
    if not 0 <= count <= MAXIMUM_SCAN_POINTS:
        raise UnreadableCloud(
            f"{place} declares {count} points; the limit is {MAXIMUM_SCAN_POINTS}. Downsample the "
            "scan, or export it in parts."
        )
    fields = tuple(_parse_fields(prototype, place))
    bits = {entry.name: entry.bits for entry in fields}
    spherical = not all(name in bits for name in _CARTESIAN)
    coordinates = _SPHERICAL if spherical else _CARTESIAN
    if not all(name in bits for name in coordinates):
        raise UnreadableCloud(f"{place} has neither Cartesian nor spherical points. {_AGAIN}")
    if count > 1 and not any(bits[name] for name in coordinates):
        raise UnreadableCloud(f"All {count} points of {place} are identical. {_AGAIN}")
    pose = node.find(f"{_NAMESPACE}pose")
    return E57Scan(
        name=name,
        count=count,
        T_world_scan=np.eye(4) if pose is None else _parse_pose(pose, place),
        has_pose=pose is not None,
        is_structured=all(bits.get(name, 0) for name in ("rowIndex", "columnIndex")),
        is_spherical=spherical,
        _pages=pages,
        _start=pages.logical(_parse_integer(points.get("fileOffset"), place)) if count else 0,
        _fields=fields,
    )


def _parse_fields(prototype: Element, place: str, *, nested: bool = False) -> Iterator[_Field]:
    """Yield the fields of a prototype in the order of their packed values."""
    for node in prototype:
        kind = node.get("type")
        name = "" if nested else node.tag.removeprefix(_NAMESPACE)
        if kind in ("Structure", "Vector"):
            yield from _parse_fields(node, place, nested=True)
        elif kind == "Float":
            single = node.get("precision") == "single"
            yield _Field(name, 32 if single else 64, "<f4" if single else "<f8")
        elif kind in ("Integer", "ScaledInteger"):
            low = _parse_integer(node.get("minimum", str(-(2**63))), place)
            high = _parse_integer(node.get("maximum", str(2**63 - 1)), place)
            if not -(2**63) <= low <= high < 2**63:
                raise UnreadableCloud(f"The bounds of a field of {place} are wrong. {_AGAIN}")
            scale, offset = (
                _parse_number(node.get(key, default), place)
                for key, default in (("scale", "1"), ("offset", "0"))
            )
            if kind == "Integer":
                scale, offset = 1.0, 0.0
            yield _Field(name, (high - low).bit_length(), None, low, scale, offset)
        else:  # a text field of varying length
            yield _Field("", 0)


def _parse_pose(node: Element, place: str) -> Floats:
    """Parse T_world_scan (4, 4) from a pose element; missing parts are the identity."""

    def numbers(part: str, names: str) -> Floats:
        texts = (node.findtext(f"{_NAMESPACE}{part}/{_NAMESPACE}{name}") for name in names)
        return np.array([_parse_number(text or "0", place) for text in texts])

    T = np.eye(4)
    T[:3, 3] = numbers("translation", "xyz")
    if node.find(f"{_NAMESPACE}rotation") is not None:
        quaternion = numbers("rotation", "xyzw")
        length = float(np.linalg.norm(quaternion))
        if not 0.9 < length < 1.1:
            raise UnreadableCloud(f"The rotation of {place} is not a unit quaternion. {_AGAIN}")
        T[:3, :3] = rotation_of(quaternion / length)
    try:
        return rigid_transform(T)
    except InvalidPose as cause:
        raise UnreadableCloud(f"{place}: {cause}") from cause


def _parse_integer(text: str | None, place: str) -> int:
    try:
        if text is None or len(text) > 20:
            raise ValueError
        return int(text)
    except ValueError as cause:
        raise UnreadableCloud(f"A number of {place} is missing or damaged. {_AGAIN}") from cause


def _parse_number(text: str, place: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UnreadableCloud(f"A number of {place} is damaged. {_AGAIN}")
    return value


# A packet has the next bytes of every field.


def _read_packets(pages: _Pages, start: int, fields: int) -> Iterator[list[bytes]]:
    """Yield the bytes of every field, packet by packet.

    Parameters
    ----------
    start : offset of the section in the payload
    fields : number of fields
    """
    kind, length, data_start, _ = _SECTION.unpack(pages.read(start, _SECTION.size))
    if kind != 1:
        raise UnreadableCloud(f"The header of the file has a wrong offset for its points. {_AGAIN}")
    place, end = pages.logical(data_start), start + length
    while place + 4 <= end:
        packet, _, last = struct.unpack("<BBH", pages.read(place, 4))
        size = last + 1
        if packet == _DATA:
            content = pages.read(place, min(size, end - place))
            sizes = _field_sizes(content, size, fields)
            pieces, at = [], 6 + 2 * fields
            for n in sizes:
                pieces.append(content[at : at + n])
                at += n
            yield pieces
        elif packet not in (_INDEX, _EMPTY) or size < 4:
            raise UnreadableCloud(f"The packed points of the file are damaged. {_AGAIN}")
        place += size


def _field_sizes(content: bytes, size: int, fields: int) -> tuple[int, ...]:
    """Return the size of each field in a packet, bytes; raise UnreadableCloud if it is damaged."""
    head = 6 + 2 * fields
    if len(content) == size >= head and struct.unpack_from("<H", content, 4)[0] == fields:
        sizes: tuple[int, ...] = struct.unpack_from(f"<{fields}H", content, 6)
        if head + sum(sizes) <= size:
            return sizes
    raise UnreadableCloud(f"The packed points of the file are damaged. {_AGAIN}")


class _Stream:
    """The values of a field; its bytes arrive in packets."""

    def __init__(self, packing: _Field) -> None:
        self._field, self._bytes = packing, bytearray()

    def add(self, piece: bytes) -> None:
        self._bytes += piece

    def holds(self, n: int) -> bool:
        """Return whether the bytes of n values are available."""
        return 8 * len(self._bytes) >= n * self._field.bits

    def take(self, n: int) -> Floats:
        """Remove and return the next n values; n must be a multiple of 8 except at the end."""
        packing = self._field
        size = -(-n * packing.bits // 8)
        content = bytes(self._bytes[:size])
        del self._bytes[:size]
        if packing.dtype is not None:
            return np.frombuffer(content, packing.dtype, n).astype(np.float64)
        whole = unpacked(content, packing.bits, n) + np.uint64(packing.minimum % 2**64)
        return whole.view(np.int64).astype(np.float64) * packing.scale + packing.offset


def unpacked(content: bytes, bits: int, n: int) -> NDArray[np.uint64]:
    """Return n integers of `bits` (0 to 64) bits; the least significant bit is stored first."""
    if bits == 0:
        return np.zeros(n, np.uint64)
    source = np.frombuffer(content + bytes(9), np.uint8)
    places = np.arange(n, dtype=np.int64) * bits
    first, shift = places >> 3, (places & 7).astype(np.uint64)
    values = np.zeros(n, np.uint64)
    for k in range(min(8, (bits + 14) // 8)):
        values |= source[first + k].astype(np.uint64) << np.uint64(8 * k)
    values >>= shift
    if bits > 57:  # a number may extend into a ninth byte unless it starts at a byte boundary
        ninth = source[first + 8].astype(np.uint64)
        values |= np.where(shift > 0, ninth << ((np.uint64(64) - shift) & np.uint64(63)), 0)
    return values & np.uint64(2**bits - 1)
