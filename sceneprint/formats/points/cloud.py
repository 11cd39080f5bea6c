"""The door for points: the bytes of a file in, a `Cloud` out.

bytes  --decode_scan-->  Scan: the cloud, and how it was read
bytes  --read_kitti | read_npy | read_pointcloud2-->  FilePoints

Plain arrays are read here: KITTI's .bin, NPY, and a serialised sensor_msgs/PointCloud2 of ROS 2.
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
    """The points of a KITTI scan: x, y, z, intensity as float32, little-endian, and nothing else.

    Raises
    ------
    UnreadableCloud : it is no whole number of points, or its rows have another length.
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


#: Lengths that rows may have, and the fewest rows that tell.
_LENGTHS, _FEWEST_ROWS = range(3, 9), 500
_LEAST_SPREAD = 0.02  #: of columns, for values that tell
_LEAST_OF_BEST = 0.93  #: spread of rows of four as a share of the largest


def _row_length(data: bytes) -> int | None:
    """Return how many float32 a row has where it is clearly not four; None else.

    Columns of rows that are cut at a wrong length mix all fields, and so have one mean. The spread
    of the means of columns, as a share of that of all values, is largest for the true length. Of
    57 scans of three sensors that were written in rows of 3 to 8, that of rows of four was .99 of
    the largest or more where four was true, and at most .87 elsewhere.
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
    """Return the variance of the means of columns as a share of that of all values, compressed."""
    rows = len(values) // length
    chosen = np.linspace(0, rows - 1, min(rows, 20_000 // length)).astype(np.int64)
    table = values[: rows * length].reshape(rows, length)[chosen].astype(np.float64)
    table = np.arcsinh(np.where(np.isfinite(table), table, 0.0))
    return max(
        float(one.mean(axis=0).var() / max(one.var(), 1e-12)) for one in (table, np.abs(table))
    )


def read_npy(data: FileBytes, most: int = MAXIMUM_POINTS) -> FilePoints:
    """The points, at most so many, of an NPY file of shape (N, 3), or (N, 4), the fourth column
    passed over.

    Raises
    ------
    UnreadableCloud : it is none, of another type or shape, or its size contradicts its header.
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


# Points as ROS 2 sends them.


def read_pointcloud2(data: bytes) -> FilePoints:
    """The points of a serialised PointCloud2, those exactly at the sensor missing.

    Raises
    ------
    UnreadableCloud : the bytes are no such message or damaged, it has no x, y and z, or its sizes
        contradict each other.
    """
    table = cloud_table(read_point_cloud(data))
    return FilePoints(table.size, cloud_blocks(table))


# The door.

#: Edge of the smallest voxels, metres: 2^21 of them are more than 20 km.
_FINEST = 0.01

Keys = NDArray[np.int64]


def thinned(points: Floats32, most: int, finest: float = _FINEST) -> tuple[Floats32, float]:
    """At most so many of the points: of each voxel the first, in their order.

    Voxels are the smallest of 1, 1.4, 2, ... times the finest that leave no more.

    Parameters
    ----------
    points : (N, 3), none beyond a million times the finest
    most : at least 8: so many voxels meet at the origin, of any size
    finest : edge of a voxel

    Returns
    -------
    points : (n, 3)
    edge : of the voxels
    """
    slots = 1 << max(4, math.ceil(math.log2(1.5 * most)))
    table, kept = np.empty(slots, np.int64), np.empty(most, np.int32)
    # who knows the hash can write a file all of whose voxels share a slot; which point is kept
    # does not depend on it
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
    """Indices of the first point of each voxel, and how many; -1 if more than there is room."""
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


#: Fewest and most points of a cloud; of more, one to a voxel is kept.
FEWEST_POINTS, MOST_POINTS = 10, 5_000_000

#: Farthest that a point may be from the viewpoint, metres.
FARTHEST_M = 10_000.0

#: Farthest that a viewpoint may be from the origin of its file, metres: half round the Earth.
_FARTHEST_VIEWPOINT_M = 2e7

_READERS = {one.name: one.reader for one in formats_of("cloud")}


@dataclass(frozen=True, eq=False)
class ReadPoints:
    """What a file of points holds.

    Parameters
    ----------
    points : (n, 3) float32, metres from the viewpoint; finite, none beyond `FARTHEST_M`
    viewpoint : metres in the file's axes; None where there is none
    given : how many points the file has, missing ones too
    """

    points: Floats32
    viewpoint: Position | None
    given: int


#: As `read_points`.
PointsOf = Callable[[bytes, CloudFormat, Position | Unsaid | None, float], ReadPoints]


@dataclass(frozen=True, eq=False)
class Scan:
    """A cloud, and how it was read.

    Parameters
    ----------
    cloud : its points, from the viewpoint
    file_format : of the file
    viewpoint : that was used, metres in the file's axes; None where there is none
    given : how many points the file has, missing ones too
    """

    cloud: Cloud
    file_format: CloudFormat
    viewpoint: Position | None
    given: int


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
    """Return the cloud of a file's bytes, and how it was read.

    Parameters
    ----------
    data : the whole file
    file_format : of it; where None its first bytes tell, which those of a KITTI scan do not
    viewpoint : where the sensor was, metres in the file's axes; None for points of many views;
        nothing said: the VIEWPOINT of a PCD file, else the origin, as sensors write
    units_per_metre : of the file's coordinates, 1000 for millimetres
    name : what to call the frame in lines and errors
    pose : (4, 4) T_parent_sensor, or None where unknown
    points_of : reads the file elsewhere; default: `read_points`

    Returns
    -------
    scan : points at the place of the viewpoint are at the origin, the axes stay; points that are
        missing (NaN, infinite) are left out

    Raises
    ------
    UnreadableCloud : the bytes are of no such format, or damaged; there are more than 20 million
        points, or one is more than 10 km from the viewpoint.
    UselessFrame : fewer than 10 points are there.
    InvalidPose : the pose is not a rigid transform.
    MissingDependency : the file is LAZ, and lazrs is not installed.
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
        points, missing = raw.points, raw.given - len(raw.points)
        if len(points) < FEWEST_POINTS:
            raise UselessFrame(
                f"{missing} of {raw.given} points are missing, and the {len(points)} left are "
                f"fewer than {FEWEST_POINTS}. Check that the sensor saw something."
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
        return Scan(cloud, found, raw.viewpoint, raw.given)


def read_points(
    data: bytes,
    file_format: CloudFormat,
    viewpoint: Position | Unsaid | None,
    units_per_metre: float,
) -> ReadPoints:
    """Read the points of a file; parameters and errors as of `decode_scan`, of a known format."""
    raw: FilePoints = function_at(_READERS[file_format])(data)
    place = _place(viewpoint, raw, units_per_metre)
    # lengths were checked: a header of twenty million points has bytes for them
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
    """Where the sensor was, metres; None where it was nowhere."""
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
    """Points (n, 3) from a place, metres, without those that are missing."""
    points, n = np.empty((raw.count, 3), np.float32), 0
    with np.errstate(all="ignore"):  # what overflows is no number, and so missing
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
