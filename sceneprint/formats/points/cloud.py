"""Read clouds: the bytes of a file become a `Cloud`.

bytes  --decode_scan-->  Scan: the cloud, and how it was read
bytes  --read_kitti | read_npy | read_pointcloud2-->  FilePoints

This module reads plain arrays itself: KITTI's .bin, NPY, and serialised messages of the type
sensor_msgs/PointCloud2 of ROS 2.
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
    format_of,
    formats_of,
    function_at,
    titles_of,
)
from sceneprint_client.poses import rigid_transform
from sceneprint_client.ros_messages import cloud_blocks, cloud_table
from sceneprint_client.sidecars import UNSAID, Position, Unsaid

# Plain arrays: KITTI's .bin, and NPY.

_KITTI_ROW = 16  #: bytes: x, y, z, intensity


def read_kitti(data: bytes) -> FilePoints:
    """Return the points of a KITTI scan: rows of x, y, z, intensity as little-endian float32.

    Raises
    ------
    UnreadableCloud : The size is no whole number of rows, or the rows have another length.
    """
    count, rest = divmod(len(data), _KITTI_ROW)
    if (floats := _row_length(data)) is not None:
        row = ",".join(("x", "y", "z", "i", "ring", "time", "a", "b")[:floats])
        raise UnreadableCloud(
            f"A row of the file holds {floats} numbers, by their values, and one of a KITTI scan "
            f'holds 4. Name them with `--row {row}` or with "row" in clouds.json, or send x, y and '
            "z as NPY of shape (N, 3)."
        )
    if rest or not count:
        raise UnreadableCloud(
            f"The file has {len(data)} bytes, and each point of a KITTI scan has {_KITTI_ROW}: "
            "x, y, z and intensity as float32. Copy the file again, or say its true format."
        )
    check_count(count, MAXIMUM_POINTS)
    rows = np.frombuffer(data, "<f4").reshape(count, 4)
    return FilePoints(count, (rows[i : i + n, :3].astype(np.float64) for i, n in steps(count)))


#: Row lengths that are recognised, and minimum number of rows for a decision.
_LENGTHS, _FEWEST_ROWS = range(3, 9), 500
_LEAST_SPREAD = 0.02  #: minimum spread of columns for a decision
_LEAST_OF_BEST = 0.93  #: minimum spread of rows of four, relative to the largest


def _row_length(data: bytes) -> int | None:
    """Return the number of float32 in a row if it is clearly not four, else None.

    At a wrong length, columns mix all fields and have similar means. The variance of the means of
    columns, relative to that of all values, is largest for the true length. In 57 scans of three
    sensors, written in rows of 3 to 8, the value for rows of four was at least .99 of the largest
    if four was true, and at most .87 otherwise.
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
    """Return the variance of the means of columns relative to that of all values, compressed."""
    rows = len(values) // length
    chosen = np.linspace(0, rows - 1, min(rows, 20_000 // length)).astype(np.int64)
    table = values[: rows * length].reshape(rows, length)[chosen].astype(np.float64)
    table = np.arcsinh(np.where(np.isfinite(table), table, 0.0))
    return max(
        float(one.mean(axis=0).var() / max(one.var(), 1e-12)) for one in (table, np.abs(table))
    )


def read_npy(data: FileBytes, most: int = MAXIMUM_POINTS) -> FilePoints:
    """Return the points of an NPY file of shape (N, 3) or (N, 4), without the fourth column.

    Raises
    ------
    UnreadableCloud : The file is not NPY, has another type or shape or more than `most` points, or
        its size contradicts its header.
    """
    if data[: len(NPY_SIGNATURE)] != NPY_SIGNATURE:
        raise UnreadableCloud("This is no NPY file. Write the points with numpy.save.")
    shapes = (
        "The shape of the NPY array is not that of points, (N, 3) or (N, 4). "
        "Write x, y and z of each point in a row."
    )
    advice = "points are float32 in metres (float64 and float16 are taken too). Convert it."
    header = npy_header(data[:HEAD], UnreadableCloud, advice, shapes)
    count, width = header.shape
    if width not in (3, 4):
        raise UnreadableCloud(shapes)
    check_count(count, most)
    expected = count * width * header.dtype.itemsize
    if len(data) - header.start != expected:
        raise UnreadableCloud(
            f"The NPY header announces {count} points of {width} values, and "
            f"{len(data) - header.start} of {expected} bytes follow. Copy or write the file again."
        )
    numbers = np.frombuffer(data, header.dtype, offset=header.start)
    rows = numbers.reshape((count, width), order=header.order)
    return FilePoints(count, (rows[i : i + n, :3].astype(np.float64) for i, n in steps(count)))


# Points of ROS 2.


def read_pointcloud2(data: bytes) -> FilePoints:
    """Return the points of a serialised PointCloud2; those at the origin count as missing.

    Raises
    ------
    UnreadableCloud : The bytes are no such message, damaged, lack x, y or z, or their sizes
        contradict each other.
    """
    table = cloud_table(read_point_cloud(data))
    return FilePoints(table.size, cloud_blocks(table))


# Thinning and decoding of clouds.

#: Edge of the smallest voxels, metres: 2^21 voxels extend over 20 km.
_FINEST = 0.01

Keys = NDArray[np.int64]


def thinned(points: Floats32, most: int, finest: float = _FINEST) -> tuple[Floats32, float]:
    """Return the first point of each voxel, at most `most` points, in their order.

    The edge of the voxels is the smallest of 1, 1.4, 2, ... times `finest` that suffices.

    Parameters
    ----------
    points : (N, 3), none beyond a million times `finest`
    most : maximum number; at least 8, because eight voxels of any size meet at the origin
    finest : smallest edge of a voxel

    Returns
    -------
    points : (n, 3)
    edge : edge of the voxels
    """
    slots = 1 << max(4, math.ceil(math.log2(1.5 * most)))
    table, kept = np.empty(slots, np.int64), np.empty(most, np.int32)
    # a secret, because a file could be written whose voxels all share a slot of a known hash; the
    # choice of points does not depend on it
    secret, step = secrets.randbits(62), 0
    while True:
        edge = finest * math.sqrt(2.0) ** step
        n = _firsts(points, 1.0 / edge, secret, table, kept)
        if n >= 0:
            return points[kept[:n]], edge
        step += 1


@kernel
def _firsts(
    points: Floats32, scale: float, secret: int, table: Keys, kept: NDArray[np.int32]
) -> int:
    """Write the indices of the first point of each voxel to `kept`; return their number, or -1 if
    there is no room.
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
            if n == len(kept):
                return -1
            table[slot] = key
            kept[n] = i
            n += 1
    return n


#: Minimum and maximum number of points of a cloud; larger ones are thinned.
FEWEST_POINTS, MOST_POINTS = 10, 5_000_000

#: Maximum distance of a point from the viewpoint, metres.
FARTHEST_M = 10_000.0

#: Maximum distance of a viewpoint from the origin of its file, metres: half round the Earth.
_FARTHEST_VIEWPOINT_M = 2e7

_READERS = {one.name: one.reader for one in formats_of("cloud")}


@dataclass(frozen=True, eq=False)
class ReadPoints:
    """The content of a file of points.

    Parameters
    ----------
    points : (n, 3) float32, metres from the viewpoint; finite, none beyond `FARTHEST_M`
    viewpoint : metres in the file's axes; None without a viewpoint
    file_points : number of points in the file, including missing points
    """

    points: Floats32
    viewpoint: Position | None
    file_points: int


#: A function with the parameters of `read_points`.
PointsOf = Callable[[bytes, CloudFormat, Position | Unsaid | None, float], ReadPoints]


@dataclass(frozen=True, eq=False)
class Scan:
    """A cloud with the parameters that it was read with.

    Parameters
    ----------
    cloud : points relative to the viewpoint
    file_format : format of the file
    viewpoint : viewpoint that was used, metres in the file's axes; None without a viewpoint
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
    """Return the cloud of a file's bytes; as `decode_scan`."""
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
    """Return the cloud of a file's bytes with the parameters that it was read with.

    Parameters
    ----------
    data : the whole file
    file_format : format of the file; None: recognised by its first bytes, except for KITTI scans
    viewpoint : position of the sensor, metres in the file's axes; None for points of many views;
        default: the VIEWPOINT of a PCD file, else the origin
    units_per_metre : of the file's coordinates: 1000 for millimetres
    name : name of the frame in messages
    pose : (4, 4) T_parent_sensor, or None if unknown
    points_of : reader of the file; default: `read_points`

    Returns
    -------
    scan : points in the file's axes, with the viewpoint at the origin, without missing (NaN or
        infinite) points

    Raises
    ------
    UnreadableCloud : The bytes are of another format or damaged; there are more than 20 million
        points, or one is more than 10 km from the viewpoint.
    UselessFrame : There are fewer than 10 points.
    InvalidPose : The pose is not a rigid transform.
    MissingDependency : The file is LAZ, and lazrs is not installed.
    """
    with naming(name):
        _check_units(units_per_metre)
        if len(data) > MAXIMUM_CLOUD_BYTES:
            raise UnreadableCloud(
                f"The file has {len(data)} bytes, the limit is {MAXIMUM_CLOUD_BYTES}. "
                "Thin the cloud out, or send it in parts."
            )
        found = _format(data, file_format)
        raw = (points_of or read_points)(data, found, viewpoint, units_per_metre)
        points, missing = raw.points, raw.file_points - len(raw.points)
        if len(points) < FEWEST_POINTS:
            raise UselessFrame(
                f"{missing} of {raw.file_points} points are missing, and the {len(points)} valid "
                f"points are fewer than {FEWEST_POINTS}. Check that the sensor saw something."
            )
        note = f"{missing} missing points left out" if missing else ""
        if len(points) > MOST_POINTS:
            before = len(points)
            points, edge = thinned(points, MOST_POINTS)
            told = f"thinned from {before} points to {len(points)}, one to {100 * edge:.1f} cm"
            note = f"{note}; {told}" if note else told
            if len(points) < FEWEST_POINTS:
                raise UselessFrame(
                    f"{before} points lie in {len(points)} places {100 * edge:.1f} cm apart or "
                    f"more, fewer than {FEWEST_POINTS}. Check that the sensor saw something."
                )
        cloud = Cloud(
            points,
            has_viewpoint=raw.viewpoint is not None,
            name=name,
            pose=None if pose is None else rigid_transform(pose),
            note=note,
        )
        return Scan(cloud, found, raw.viewpoint, raw.file_points)


def read_points(
    data: bytes,
    file_format: CloudFormat,
    viewpoint: Position | Unsaid | None,
    units_per_metre: float,
) -> ReadPoints:
    """Return the points of a file of a known format; see `decode_scan`."""
    raw: FilePoints = function_at(_READERS[file_format])(data)
    place = _place(viewpoint, raw, units_per_metre)
    # the reader has checked that the file has bytes for the points that its header announces
    points = _from(raw, place or (0.0, 0.0, 0.0), units_per_metre)
    return ReadPoints(points, place, raw.count)


def _format(data: bytes, told: CloudFormat | None) -> CloudFormat:
    found = format_of(data)
    if told == "kitti" and found is not None:
        raise UnreadableCloud(
            f"This is no KITTI scan: it begins as a {found.upper()} file does. Say that, or "
            "nothing, for its format."
        )
    if told is not None and told not in _READERS:
        raise UnreadableCloud(
            f"{told!r:.40} is no format of points. Known are {', '.join(_READERS)}."
        )
    if not data:
        raise UnreadableCloud("The file is empty. Copy or write it again.")
    if told is None and found is None:
        raise UnreadableCloud(
            f"This is none of {titles_of('cloud')} by its first bytes. Write one of these; for a "
            "KITTI scan, say kitti as its format."
        )
    chosen = told or found
    assert chosen is not None
    return chosen


def _check_units(units: float) -> None:
    if not (math.isfinite(units) and 1e-6 <= units <= 1e9):
        raise UnreadableCloud(
            f"The units per metre are {units}, no such number. Say 1 for metres, 1000 for "
            "millimetres."
        )


def _place(told: Position | Unsaid | None, raw: FilePoints, units: float) -> Position | None:
    """Return the position of the sensor, metres; None for points of many views."""
    if isinstance(told, Unsaid):
        x, y, z = raw.viewpoint or (0.0, 0.0, 0.0)
        told = (x / units, y / units, z / units)
    if told is not None and not all(abs(value) <= _FARTHEST_VIEWPOINT_M for value in told):
        raise UnreadableCloud(
            f"The viewpoint {told} is not finite, or none on Earth. Give where the sensor was, in "
            "metres along the axes of the points."
        )
    return told


def _from(raw: FilePoints, place: Position, units: float) -> Floats32:
    """Return points (n, 3) relative to a place, metres, without missing ones."""
    points, n = np.empty((raw.count, 3), np.float32), 0
    with np.errstate(all="ignore"):  # overflowing points become infinite, and so missing
        for block in raw.blocks:
            block /= units
            block -= place
            present = block[np.isfinite(block).all(axis=1)]
            _check_reach(np.abs(present).max(initial=0.0))
            points[n : n + len(present)] = present
            n += len(present)
    return points if n == raw.count else points[:n].copy()


def _check_reach(far: float) -> None:
    if far > FARTHEST_M:
        raise UnreadableCloud(
            f"A point lies {far:.6g} m from the viewpoint along an axis, and at most "
            f"{FARTHEST_M:g} m is read. Say units_per_metre if these are no metres, and shift "
            "coordinates of a map (UTM) to the sensor, or give the viewpoint in them."
        )
