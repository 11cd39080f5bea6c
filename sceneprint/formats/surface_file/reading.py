"""Reading of a whole map file as a `ReferenceSurface` in metres.

bytes, name, options  --read_surface-->  ReadSurface

Units and an up direction that neither the file nor the options state are estimated from the
surface, and a note says so. The axes are those of the file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from sceneprint.errors import UnreadableCloud, UselessFrame
from sceneprint.formats.points.cloud import FARTHEST_M, FEWEST_POINTS, read_npy
from sceneprint.formats.points.e57 import E57Scan, read_e57
from sceneprint.formats.points.las import read_las
from sceneprint.formats.points.pcd import read_pcd
from sceneprint.formats.points.ply import read_ply
from sceneprint.formats.points.rows import FileBytes, FilePoints, check_count
from sceneprint.formats.surface_file.las_units import las_units_per_metre
from sceneprint.formats.surface_file.mesh_file import read_mesh
from sceneprint.formats.surface_file.ply_faces import read_faces
from sceneprint.formats.surface_file.raw_surface import (
    MOST_FILE_POINTS,
    MOST_VERTICES,
    TOO_LARGE,
    RawSurface,
    gather,
)
from sceneprint.geometry.surface.upright import estimate_units, estimate_up
from sceneprint.types import Floats, Floats32, Ints32, ReferenceSurface
from sceneprint_client.api.frames import Axis
from sceneprint_client.files import naming
from sceneprint_client.formats import HEAD, format_at, format_named, titles_of

SurfaceFormat = Literal["pcd", "ply", "las", "npy", "e57", "obj", "stl", "glb", "gltf"]
#: Source of the units or the up direction: the options, the file, or the shape of the surface.
Source = Literal["stated", "file", "estimated"]

AXES: dict[str, Floats] = {
    f"{sign}{name}": value * np.eye(3)[k]
    for k, name in enumerate("xyz") for sign, value in (("", 1.0), ("-", -1.0))
}  # fmt: skip
#: Surfaces whose middle is farther than this from the origin of the file get an offset, metres.
FAR_M = 1000.0
_STL_HEADER, _STL_TRIANGLE = 84, 50  #: bytes
_BLOCK = 1 << 18
#: A value above any coordinate on Earth in all supported units, whose products are finite.
_MOST_UNITS = 1e15
#: Minimum and maximum usual extent of a place, metres; other extents cause a note.
_SMALL_M, _LARGE_M = 1.0, 5000.0


@dataclass(frozen=True)
class SurfaceOptions:
    """Properties of a surface that the user states; None uses the file's value, or an estimate.

    Parameters
    ----------
    units_per_metre : units of the file's coordinates per metre, such as 1000 for millimetres
    up : axis of the file that points up

    Raises
    ------
    UnreadableCloud : If the units or the axis are invalid.
    """

    units_per_metre: float | None = None
    up: Axis | None = None

    def __post_init__(self) -> None:
        units = self.units_per_metre
        if units is not None and not (math.isfinite(units) and 1e-6 <= units <= 1e9):
            raise UnreadableCloud(
                f"The units per metre are {units}, not a valid number. Specify 1 for metres or "
                "1000 for millimetres."
            )
        if self.up is not None and self.up not in AXES:
            raise UnreadableCloud(
                f"{self.up!r:.40} is not an axis. Specify the upward axis: {', '.join(AXES)}."
            )


@dataclass(frozen=True, eq=False)
class ReadSurface:
    """A surface, and the parameters with which its file was read.

    Parameters
    ----------
    surface : surface in metres, in the axes of the file
    units : source of the units
    up_from : source of the up direction
    notes : sentences for the user on estimated values, omitted parts and thinning
    file_points : number of points of the file, including missing points
    voxel : edge of the voxels of a thinned cloud, metres; None if it is not thinned
    """

    surface: ReferenceSurface
    units: Source
    up_from: Source
    notes: tuple[str, ...]
    units_per_metre: float
    file_points: int
    voxel: float | None


def surface_format(head: bytes, name: str, size: int) -> SurfaceFormat:
    """Return the format of a whole map file, from its first bytes or its name.

    Parameters
    ----------
    head : first `HEAD` bytes of the file
    name : name of the file; its suffix identifies OBJ and ascii STL
    size : size of the file, bytes

    Raises
    ------
    UnreadableCloud : If the file is empty or has an unknown format.
    """
    if not size:
        raise UnreadableCloud("The file is empty. Copy or write it again.")
    file_format = format_at(head, "map")
    if file_format is not None:
        return cast(SurfaceFormat, file_format.name)
    if len(head) >= _STL_HEADER:
        triangles = int.from_bytes(head[80:84], "little")
        if size == _STL_HEADER + _STL_TRIANGLE * triangles:
            return "stl"
    by_name = format_named(name, "map")
    if by_name is not None and not by_name.signature:
        return cast(SurfaceFormat, by_name.name)
    if head.lstrip()[:6].lower() == b"solid " and b"facet" in head:
        return "stl"
    raise UnreadableCloud(
        f"According to its first bytes and its name, the format is none of {titles_of('map')}. "
        "Write the map as one of these."
    )


def read_surface(
    data: FileBytes, name: str, options: SurfaceOptions | None = None,
    file_format: SurfaceFormat | None = None,
) -> ReadSurface:  # fmt: skip
    """Read the surface in a whole map file.

    Parameters
    ----------
    data : the whole file, in memory or mapped
    name : name of the file for errors; its suffix identifies formats without a magic number
    options : properties that the user states
    file_format : format of the file; None recognises it

    Returns
    -------
    read : surface without missing points, and without triangles that lack an area or a vertex; a
        cloud of more than 10 million points is thinned to the first point of each voxel

    Raises
    ------
    UnreadableCloud : If the bytes have an unknown format, are damaged, have coordinates in degrees
        or exceed a limit, a triangle refers to a missing vertex, or the surface exceeds 20 km.
    UselessFrame : If there are fewer than 10 points, or no triangle has an area.
    MissingDependency : If lazrs or trimesh is needed and not installed.
    """
    stated = options or SurfaceOptions()
    with naming(name):
        form = file_format or surface_format(data[:HEAD], name, len(data))
        return _convert(_read_raw(data, form, stated), stated)


def _read_raw(data: FileBytes, form: SurfaceFormat, options: SurfaceOptions) -> RawSurface:
    """Read the surface of a file, with the units and the up direction that the file states."""
    if form in ("obj", "stl", "glb", "gltf"):
        mesh = read_mesh(data, form)
        is_gltf = form in ("glb", "gltf")
        points = FilePoints(len(mesh.vertices), mesh.blocks())
        raw = _gather_points(points, mesh.triangles, AXES["z" if form == "stl" else "y"], options)
        stated = (1.0, AXES["y"]) if is_gltf else (None, None)
        return replace(raw, units_per_metre=stated[0], up=stated[1], notes=mesh.notes)
    if form == "ply":
        faces = read_faces(data)
        points = read_ply(data, MOST_FILE_POINTS if faces is None else MOST_VERTICES)
        return _gather_points(points, faces, AXES["z"], options)
    if form == "las":
        points = read_las(data, MOST_FILE_POINTS)  # this checks the header
        units = options.units_per_metre or las_units_per_metre(data)
        raw = _gather_points(points, None, AXES["z"], replace(options, units_per_metre=units))
        return replace(raw, units_per_metre=units, up=AXES["z"])
    if form == "e57":
        in_metres = replace(options, units_per_metre=options.units_per_metre or 1.0)
        raw = _gather_points(_join_scans(read_e57(data)), None, AXES["z"], in_metres)
        return replace(raw, units_per_metre=1.0)
    points = (read_pcd if form == "pcd" else read_npy)(data, MOST_FILE_POINTS)
    return _gather_points(points, None, AXES["z"], options)


def _join_scans(scans: tuple[E57Scan, ...]) -> FilePoints:
    count = sum(scan.count for scan in scans)
    check_count(count, MOST_FILE_POINTS)

    def blocks() -> Iterator[Floats]:
        for scan in scans:
            T = scan.T_world_scan
            for block in scan.points().blocks:
                with np.errstate(all="ignore"):  # overflows are missing points
                    yield block @ T[:3, :3].T + T[:3, 3]

    return FilePoints(count, blocks())


def _gather_points(
    points: FilePoints, triangles: Ints32 | None, usual_up: Floats, options: SurfaceOptions
) -> RawSurface:
    if triangles is not None and not len(triangles):
        triangles = None
    thin: Callable[[Floats32], float] | None = None
    if triangles is None:

        def thin(so_far: Floats32) -> float:
            return options.units_per_metre or _estimate_units(so_far, None, usual_up)

    gathered, origin, voxel = gather(points.blocks, points.count, thin)
    return RawSurface(gathered, origin, triangles, points.count, voxel, None, None, usual_up)


def _estimate_units(points: Floats32, triangles: Ints32 | None, usual_up: Floats) -> float:
    return estimate_units(points, estimate_up(points, triangles, usual_up).up)


def _convert(raw: RawSurface, options: SurfaceOptions) -> ReadSurface:
    """Return a surface in metres, without missing points and triangles."""
    notes = list(raw.notes)
    points, triangles = _clean(raw, notes)
    if not max(float(points.max()), -float(points.min())) < _MOST_UNITS:
        raise UnreadableCloud(TOO_LARGE)
    up, up_from = _select_up(raw, options, points, triangles, notes)
    units, units_from = _select_units(raw, options, points, up, notes)
    offset = _to_metres(points, raw.origin, units)
    extent = float((points.max(axis=0) - points.min(axis=0)).max())
    if units_from != "stated" and not _SMALL_M <= extent <= _LARGE_M:
        notes.append(f"The surface is {extent:.3g} m across, unusual for a place. Check the units.")
    voxel = None if raw.voxel is None else raw.voxel / units
    if voxel is not None:
        notes.append(
            f"The {raw.file_points} points were thinned to {len(points)}, one per voxel of "
            f"{100 * voxel:.3g} cm."
        )
    surface = ReferenceSurface(points, triangles, offset, up)
    return ReadSurface(surface, units_from, up_from, tuple(notes), units, raw.file_points, voxel)


def _select_up(
    raw: RawSurface, options: SurfaceOptions, points: Floats32, triangles: Ints32 | None,
    notes: list[str],
) -> tuple[Floats, Source]:  # fmt: skip
    """Return the up direction (3,) and its source; add a note on an estimate to `notes`."""
    if options.up is not None:
        return AXES[options.up], "stated"
    if raw.up is not None:
        return raw.up, "file"
    estimate = estimate_up(points, triangles, raw.usual_up)
    k = int(np.abs(estimate.up).argmax())
    axis = f"{'-' if estimate.up[k] < 0 else ''}{'xyz'[k]}"
    degrees = math.degrees(math.acos(min(1.0, abs(float(estimate.up[k])))))
    tilt = f", {degrees:.0f} degrees from it" if degrees > 0.5 else ""
    doubt = "" if estimate.is_clear else " The estimate is uncertain."
    notes.append(f"The up axis was estimated: {axis}{tilt}.{doubt} Specify it if this is wrong.")
    return estimate.up, "estimated"


def _select_units(
    raw: RawSurface, options: SurfaceOptions, points: Floats32, up: Floats, notes: list[str]
) -> tuple[float, Source]:
    """Return the units per metre and their source; add a note on an estimate to `notes`."""
    if options.units_per_metre is not None:
        return options.units_per_metre, "stated"
    if raw.units_per_metre is not None:
        return raw.units_per_metre, "file"
    units = estimate_units(points, up)
    x, y, z = (points.max(axis=0) - points.min(axis=0)).tolist()
    name = {1.0: "metres", 100.0: "centimetres", 1000.0: "millimetres"}[units]
    notes.append(
        f"Units were estimated from the extent of {x:.4g} x {y:.4g} x {z:.4g}: {name}. Specify "
        "them if this is wrong."
    )
    return units, "estimated"


def _clean(raw: RawSurface, notes: list[str]) -> tuple[Floats32, Ints32 | None]:
    """Return valid points and triangles (None for clouds); add notes on the others to `notes`."""
    if raw.triangles is None:
        missing = raw.file_points - len(raw.points)
        if missing and raw.voxel is None:
            notes.append(f"{missing} missing points were skipped.")
        if len(raw.points) < FEWEST_POINTS:
            raise UselessFrame(
                f"The file has {len(raw.points)} valid points, fewer than {FEWEST_POINTS}. Check "
                "that it is the right file."
            )
        return raw.points, None
    wrong = (raw.triangles < 0) | (raw.triangles >= len(raw.points))
    if wrong.any():
        first = int(np.flatnonzero(wrong.any(axis=1))[0])
        raise UnreadableCloud(
            f"Triangle {first + 1} of {len(raw.triangles)} refers to a vertex that is not among "
            f"the {len(raw.points)} vertices of the file. Copy or write the file again."
        )
    points, triangles = _remove_flat(raw.points, raw.triangles)
    omitted = len(raw.triangles) - len(triangles)
    if not len(triangles):
        raise UselessFrame(
            f"None of the {omitted} triangles of the file has an area. Check that it is the right "
            "file, and write it again."
        )
    if omitted:
        notes.append(f"{omitted} triangles without area or with missing vertices were skipped.")
    return points, triangles


def _remove_flat(points: Floats32, triangles: Ints32) -> tuple[Floats32, Ints32]:
    """Return the vertices of the triangles that have an area, and these triangles."""
    proper = np.ones(len(triangles), np.bool_)
    present = np.asarray(np.isfinite(points).all(axis=1))
    for first in range(0, len(triangles), _BLOCK):
        block = triangles[first : first + _BLOCK]
        a, b, c = (points[block[:, k]].astype(np.float64) for k in range(3))
        with np.errstate(invalid="ignore", over="ignore"):
            across = np.cross(b - a, c - a)
        proper[first : first + _BLOCK] = present[block].all(axis=1) & (across != 0).any(axis=1)
    if not proper.all():
        triangles = triangles[proper]
    used = np.zeros(len(points), np.bool_)
    used[triangles] = True
    if used.all():
        return points, triangles.astype(np.int32, copy=False)
    places = (np.cumsum(used) - 1).astype(np.int32)
    return points[used], places[triangles]


def _to_metres(points: Floats32, origin: Floats, units: float) -> Floats:
    """Convert points in place to metres relative to an offset; return the offset (3,), metres.

    The offset is the middle of the points in whole metres if the middle is farther than `FAR_M`
    from the origin of the file, otherwise 0.

    Parameters
    ----------
    points : (N, 3) relative to `origin`, in units of the file
    origin : (3,) in units of the file
    units : number of units per metre

    Raises
    ------
    UnreadableCloud : If the points are more than `2 * FARTHEST_M` apart along an axis.
    """
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    widest = float((high - low).max()) / units
    if not widest <= 2 * FARTHEST_M:
        raise UnreadableCloud(
            f"The surface is {widest:.6g} m wide; the limit is {2 * FARTHEST_M:g} m. Specify the "
            "units if the coordinates are not metres, and remove isolated distant points."
        )
    middle = (origin + (low + high) / 2) / units
    is_far = bool(np.linalg.norm(middle) > FAR_M)
    offset = np.round(middle) if is_far else np.zeros(3)
    shift = origin / units - offset
    if units != 1.0 or shift.any():
        for first in range(0, len(points), _BLOCK):
            block = points[first : first + _BLOCK]
            block[:] = block.astype(np.float64) / units + shift
    return offset
