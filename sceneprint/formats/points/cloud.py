"""Decoding of point clouds from the bytes of a file.

bytes  --decode_scan-->  Scan: the cloud, and the parameters used to read it
bytes  --read_kitti | read_npy | read_pointcloud2-->  FilePoints

This module contains the readers of plain arrays: KITTI's .bin, NPY, and serialised ROS 2 messages
of the type sensor_msgs/PointCloud2.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UnreadableCloud, UselessFrame
from sceneprint.formats.points.rows import MAXIMUM_POINTS, FileBytes, FilePoints, check_count, steps
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Cloud, Floats, Floats32
from sceneprint_client.files import (
    MAXIMUM_CLOUD_BYTES,
    NPY_SIGNATURE,
    naming,
    npy_header,
    read_point_cloud,
)
from sceneprint_client.formats import (
    HEAD,
    CloudFormat,
    foreign_file,
    format_of,
    formats_of,
    function_at,
    titles_of,
)
from sceneprint_client.poses import rigid_transform
from sceneprint_client.ros_messages import cloud_blocks, cloud_table
from sceneprint_client.sidecars import UNSAID, Position, Unsaid

_KITTI_ROW = 16  #: bytes: x, y, z, intensity


def read_kitti(data: bytes) -> FilePoints:
    """Read the points of a KITTI scan: rows of x, y, z, intensity as little-endian float32.

    Raise UnreadableCloud if the size is not a multiple of a row, or the rows have another length.
    """
    count, rest = divmod(len(data), _KITTI_ROW)
    if (floats := _row_length(data)) is not None:
        row = ",".join(("x", "y", "z", "i", "ring", "time", "a", "b")[:floats])
        raise UnreadableCloud(
            f"Judging by its values, the file has {floats} numbers per row, but a KITTI scan has "
            f'4. Specify them with `--row {row}` or with "row" in clouds.json, or '
            "send x, y and z as NPY with the shape (N, 3), also if the numbers are float64."
        )
    if rest or not count:
        raise UnreadableCloud(
            f"The file has {len(data)} bytes, but each point of a KITTI scan has {_KITTI_ROW}: "
            "x, y, z and intensity as float32. Copy the file again, or specify its actual format."
        )
    check_count(count, MAXIMUM_POINTS)
    rows = np.frombuffer(data, "<f4").reshape(count, 4)
    return FilePoints(count, (rows[i : i + n, :3].astype(np.float64) for i, n in steps(count)))


#: Recognised row lengths, and minimum number of rows for a decision.
_LENGTHS, _FEWEST_ROWS = range(3, 9), 200
_LEAST_SPREAD = 0.02  #: minimum column spread for a decision
_LEAST_OF_BEST = 0.93  #: minimum column spread at length four, relative to the largest spread


def _row_length(data: bytes) -> int | None:
    """Estimate the number of float32 values per row; return None unless it clearly is not four.

    With a wrong length, columns mix all fields and have similar means. Therefore, the variance of
    the column means, relative to the variance of all values, is maximal for the correct length. In
    57 scans of three sensors, written in rows of 3 to 8 numbers, the value for length four was at
    least .99 of the maximum if four was correct, and at most .87 otherwise. Of 10,944 parts of 100
    to 1000 of their points in rows of four, none was estimated otherwise; of 60 points, 3 of 2,736.
    """
    values = np.frombuffer(data, "<f4", len(data) // 4)
    if len(values) < _FEWEST_ROWS * _KITTI_ROW // 4:
        return None
    spreads = {n: _column_spread(values, n) for n in _LENGTHS}
    best = max(spreads, key=lambda n: (spreads[n] >= _LEAST_OF_BEST * max(spreads.values()), -n))
    if spreads[best] < _LEAST_SPREAD or spreads[4] >= _LEAST_OF_BEST * spreads[best]:
        return None
    return best


def _column_spread(values: Floats32, length: int) -> float:
    """Return the ratio of the variance of column means to that of all values, after compression of
    the range; of values and of absolute values, the greater ratio counts.
    """
    rows = len(values) // length
    chosen = np.linspace(0, rows - 1, min(rows, 20_000 // length)).astype(np.int64)
    table = values[: rows * length].reshape(rows, length)[chosen].astype(np.float64)
    table = np.arcsinh(np.where(np.isfinite(table), table, 0.0))
    return max(
        float(part.mean(axis=0).var() / max(part.var(), 1e-12)) for part in (table, np.abs(table))
    )


def read_npy(data: FileBytes, most: int = MAXIMUM_POINTS) -> FilePoints:
    """Read the points, metres, of a float16, float32 or float64 NPY file, (N, 3) or (N, 4).

    The fourth column is omitted. The blocks can be iterated once.

    Raise UnreadableCloud if the file is not NPY, has another type or shape or more than `most`
    points, or its size contradicts its header.
    """
    if data[: len(NPY_SIGNATURE)] != NPY_SIGNATURE:
        raise UnreadableCloud("This is not an NPY file. Write the points with numpy.save.")
    shapes = (
        "The NPY array does not have the shape of points, (N, 3) or (N, 4). "
        "Write x, y and z of each point in a row."
    )
    advice = "points must be float32, float64 or float16 in metres. Convert it."
    header = npy_header(data[:HEAD], UnreadableCloud, advice, shapes)
    count, width = header.shape
    if width not in (3, 4):
        raise UnreadableCloud(shapes)
    check_count(count, most)
    expected = count * width * header.dtype.itemsize
    if len(data) - header.start != expected:
        raise UnreadableCloud(
            f"The NPY header declares {count} points of {width} values, but "
            f"{len(data) - header.start} of {expected} bytes follow. Copy or write the file again."
        )
    numbers = np.frombuffer(data, header.dtype, offset=header.start)
    rows = numbers.reshape((count, width), order=header.order)
    return FilePoints(count, (rows[i : i + n, :3].astype(np.float64) for i, n in steps(count)))


def read_pointcloud2(data: bytes) -> FilePoints:
    """Read the points of a serialised PointCloud2; points at the origin count as missing.

    Raise UnreadableCloud if the bytes are not such a message, are damaged, lack x, y or z, or their
    sizes contradict each other.
    """
    table = cloud_table(read_point_cloud(data))
    return FilePoints(table.size, cloud_blocks(table))


#: Minimum edge of a voxel, metres. 2^21 such voxels extend over 20 km.
_FINEST = 0.01

Keys = NDArray[np.int64]


def thinned(points: Floats32, most: int, finest: float = _FINEST) -> tuple[Floats32, float]:
    """Thin points to the first point of each voxel; their order is preserved.

    The edge of the voxels is the smallest of `finest` times 1, 1.4, 2, ... that suffices.

    Parameters
    ----------
    points : (N, 3) points with coordinates up to a million times `finest`
    most : maximum number of points; at least 8, because eight voxels of any size meet at the origin
    finest : minimum edge of a voxel

    Returns
    -------
    points : (n, 3) selected points
    edge : edge of the voxels
    """
    slots = 1 << max(4, math.ceil(math.log2(1.5 * most)))
    table, indices = np.empty(slots, np.int64), np.empty(most, np.int32)
    # without a secret, a file could make all voxels collide in the hash table; the selected points
    # do not depend on it
    secret, step = secrets.randbits(62), 0
    while True:
        edge = finest * math.sqrt(2.0) ** step
        n = _first_points(points, 1.0 / edge, secret, table, indices)
        if n >= 0:
            return points[indices[:n]], edge
        step += 1


@kernel
def _first_points(
    points: Floats32, scale: float, secret: int, table: Keys, indices: NDArray[np.int32]
) -> int:
    """Write the index of the first point of each voxel to `indices`.

    Return the number of indices; -1 if `indices` is too short.
    """
    table[:] = -1
    mask, n = len(table) - 1, 0
    for i in range(len(points)):
        key = 0
        for k in range(3):
            key = (key << 21) | (math.floor(points[i, k] * scale) + (1 << 20))
        h = (key ^ secret) * 0x9E3779B97F4A7C1
        h ^= h >> 31
        h *= 0x1D8E4E27C47D124F
        slot = (h >> 20) & mask
        while table[slot] >= 0 and table[slot] != key:
            slot = (slot + 1) & mask
        if table[slot] < 0:
            if n == len(indices):
                return -1
            table[slot] = key
            indices[n] = i
            n += 1
    return n


#: Minimum and maximum number of points in a cloud; larger clouds are thinned.
FEWEST_POINTS, MOST_POINTS = 10, 5_000_000

#: Maximum distance of a point from the viewpoint along an axis, metres.
FARTHEST_M = 10_000.0

#: Maximum coordinate of a viewpoint, metres: half of Earth's circumference.
_FARTHEST_VIEWPOINT_M = 2e7

_READERS = {entry.name: entry.reader for entry in formats_of("cloud")}


@dataclass(frozen=True, eq=False)
class ReadPoints:
    """The content of a point cloud file.

    Parameters
    ----------
    points : (n, 3) float32, metres relative to the viewpoint; finite, at most `FARTHEST_M` per axis
    viewpoint : position of the sensor, metres in the file's axes; None if there is none
    file_points : number of points in the file, including missing points
    """

    points: Floats32
    viewpoint: Position | None
    file_points: int


#: Function with the parameters of `read_points`.
PointsOf = Callable[[bytes, CloudFormat, Position | Unsaid | None, float], ReadPoints]


@dataclass(frozen=True, eq=False)
class Scan:
    """A cloud, and the parameters with which its file was read.

    Parameters
    ----------
    cloud : points relative to the viewpoint
    viewpoint : position of the sensor, metres in the file's axes; None if there is none
    file_points : number of points in the file, including missing points
    """

    cloud: Cloud
    file_format: CloudFormat
    viewpoint: Position | None
    file_points: int


def decode_cloud(
    data: bytes,
    *,
    file_format: CloudFormat | None = None,
    viewpoint: Position | Unsaid | None = UNSAID,
    units_per_metre: float = 1.0,
    name: str = "",
    pose: Floats | None = None,
    points_of: PointsOf | None = None,
) -> Cloud:
    """Decode a point cloud file; see `decode_scan`."""
    return decode_scan(
        data,
        file_format=file_format,
        viewpoint=viewpoint,
        units_per_metre=units_per_metre,
        name=name,
        pose=pose,
        points_of=points_of,
    ).cloud


def decode_scan(
    data: bytes,
    *,
    file_format: CloudFormat | None = None,
    viewpoint: Position | Unsaid | None = UNSAID,
    units_per_metre: float = 1.0,
    name: str = "",
    pose: Floats | None = None,
    points_of: PointsOf | None = None,
) -> Scan:
    """Decode a point cloud file; return its cloud, and the parameters with which it was read.

    Parameters
    ----------
    data : the whole file
    file_format : format of the file; None recognises all formats except KITTI by the first bytes
    viewpoint : position of the sensor, metres in the file's axes; None for points from several
        viewpoints; by default, the VIEWPOINT of a PCD file or the origin
    units_per_metre : units of the file's coordinates per metre, such as 1000 for millimetres
    pose : (4, 4) T_parent_sensor, or None if unknown
    points_of : reader of the file; None selects `read_points`

    Returns
    -------
    scan : points in the file's axes, with the viewpoint at the origin, without missing (NaN or
        infinite) points; more than 5 million points are thinned

    Raises
    ------
    UnreadableCloud : If the bytes have another format or are damaged, there are more than 20
        million points, or a point is more than 10 km from the viewpoint.
    UselessFrame : If there are fewer than 10 points.
    InvalidPose : If the pose is not a rigid transform.
    MissingDependency : If the file is LAZ and lazrs is not installed.
    """
    with naming(name):
        _check_units(units_per_metre)
        if len(data) > MAXIMUM_CLOUD_BYTES:
            raise UnreadableCloud(
                f"The file has {len(data)} bytes; the limit is {MAXIMUM_CLOUD_BYTES}. "
                "Downsample the cloud, or send it in parts."
            )
        recognised = _select_format(data, file_format)
        raw = (points_of or read_points)(data, recognised, viewpoint, units_per_metre)
        points, missing = raw.points, raw.file_points - len(raw.points)
        if len(points) < FEWEST_POINTS:
            raise UselessFrame(
                f"{len(points)} of {raw.file_points} points are valid, but {FEWEST_POINTS} are "
                "required; others are at the sensor or not finite. Check that the sensor saw "
                "surfaces."
            )
        note = f"{missing} missing points skipped" if missing else ""
        if len(points) > MOST_POINTS:
            before = len(points)
            points, edge = thinned(points, MOST_POINTS)
            thinning = f"thinned from {before} points to {len(points)}, {100 * edge:.1f} cm apart"
            note = f"{note}; {thinning}" if note else thinning
            if len(points) < FEWEST_POINTS:
                raise UselessFrame(
                    f"The {before} points occupy {len(points)} voxels of {100 * edge:.1f} cm, but "
                    f"{FEWEST_POINTS} are required. Check that the sensor saw surfaces."
                )
        cloud = Cloud(
            points,
            has_viewpoint=raw.viewpoint is not None,
            name=name,
            pose=None if pose is None else rigid_transform(pose),
            note=note,
        )
        return Scan(cloud, recognised, raw.viewpoint, raw.file_points)


def read_points(
    data: bytes,
    file_format: CloudFormat,
    viewpoint: Position | Unsaid | None,
    units_per_metre: float,
) -> ReadPoints:
    """Read the points of a file in a known format; for the parameters, see `decode_scan`."""
    raw: FilePoints = function_at(_READERS[file_format])(data)
    place = _select_viewpoint(viewpoint, raw, units_per_metre)
    # the reader has already compared the number of points with the size of the file
    points = _relative_points(raw, place or (0.0, 0.0, 0.0), units_per_metre)
    return ReadPoints(points, place, raw.count)


def _select_format(data: bytes, stated: CloudFormat | None) -> CloudFormat:
    """Return the stated or the recognised format; raise UnreadableCloud if neither is valid."""
    recognised = format_of(data)
    if stated == "kitti" and recognised is not None:
        raise UnreadableCloud(
            f"This is not a KITTI scan: it starts like a {recognised.upper()} file. Specify that "
            "format, or omit it."
        )
    if stated is not None and stated not in _READERS:
        raise UnreadableCloud(
            f"{stated!r:.40} is not a point cloud format. Use one of {', '.join(_READERS)}."
        )
    if not data:
        raise UnreadableCloud("The file is empty. Copy or write it again.")
    if stated is None and recognised is None:
        raise UnreadableCloud(
            f"{foreign_file(data)}According to its first bytes, the format is none of "
            f"{titles_of('cloud')}. Write one of these; for a KITTI scan, specify the format kitti."
        )
    chosen = stated or recognised
    assert chosen is not None
    return chosen


def _check_units(units: float) -> None:
    if not (math.isfinite(units) and 1e-6 <= units <= 1e9):
        raise UnreadableCloud(
            f"The units per metre are {units}, not a number from 1e-6 to 1e9. Specify 1 for metres "
            "or 1000 for millimetres."
        )


def _select_viewpoint(
    viewpoint: Position | Unsaid | None, raw: FilePoints, units: float
) -> Position | None:
    """Return the position of the sensor, metres; None for points from several viewpoints."""
    if isinstance(viewpoint, Unsaid):
        x, y, z = raw.viewpoint or (0.0, 0.0, 0.0)
        viewpoint = (x / units, y / units, z / units)
    if viewpoint is not None and not all(
        abs(value) <= _FARTHEST_VIEWPOINT_M for value in viewpoint
    ):
        raise UnreadableCloud(
            f"The viewpoint {viewpoint} has a coordinate that is not finite or exceeds "
            f"{_FARTHEST_VIEWPOINT_M / 1e3:,.0f} km. Specify the position of the sensor, in metres "
            "along the axes of the points."
        )
    return viewpoint


def _relative_points(raw: FilePoints, place: Position, units: float) -> Floats32:
    """Return the valid points (n, 3) relative to the position `place`, metres."""
    points, n = np.empty((raw.count, 3), np.float32), 0
    with np.errstate(all="ignore"):  # overflows are missing points
        for block in raw.blocks:
            block /= units
            block -= place
            present = block[np.isfinite(block).all(axis=1)]
            _check_reach(np.abs(present).max(initial=0.0))
            points[n : n + len(present)] = present
            n += len(present)
    return points if n == raw.count else points[:n].copy()


def _check_reach(far: float) -> None:
    if far > 1e12:
        raise UnreadableCloud(
            f"A coordinate is {far:.6g} m, so the type, byte order or number of the values per "
            "point is wrong. Specify the actual format."
        )
    if far > FARTHEST_M:
        raise UnreadableCloud(
            f"A point is {far:.6g} m from the viewpoint along an axis; the limit is "
            f"{FARTHEST_M:g} m. Specify units_per_metre if the coordinates are not metres. For map "
            "coordinates (UTM), specify the viewpoint, or shift the points to the sensor."
        )
