"""A surface in the units and axes of its file, as every reader hands it over.

blocks of points  --gather-->  RawSurface

Points are kept in float32 relative to an origin in float64, so coordinates of a country (UTM) keep
their millimetres. Clouds of more points than are kept are thinned while they are read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.cloud import thinned
from sceneprint.types import Floats, Floats32, Ints32

#: Most points of a file, most that are kept of a cloud, and most vertices and triangles of a mesh.
MOST_FILE_POINTS, MOST_POINTS = 60_000_000, 10_000_000
MOST_VERTICES, MOST_TRIANGLES = 15_000_000, 20_000_000
#: Edge of the finest voxels that a cloud is thinned to, metres.
FINEST_M = 0.01
#: Coordinates beyond which an origin is subtracted while reading, units of the file.
_NEAR_UNITS = 1000.0
TOO_LARGE = (
    "A coordinate is larger than any on Earth. Remove points that lie far from the "
    "others, and write the file again."
)
#: Voxels along an axis, at most, from the origin.
_MOST_VOXELS = 1_000_000


@dataclass(frozen=True, eq=False)
class RawSurface:
    """A surface in the units and axes of its file.

    Parameters
    ----------
    points : (N, 3) float32, relative to `origin`; rows that are not finite only in a mesh
    origin : (3,) float64
    triangles : (M, 3) int64 or int32 indices, not checked yet; None for a cloud
    file_points : points of the file, missing ones too
    voxel : edge of the voxels that a cloud was thinned to, units of the file; None if it was not
    units_per_metre : that the file states, or None
    up : (3,) that the file states, or None
    usual_up : (3,) that is up in most files of this format
    notes : sentences on what was left out
    """

    points: Floats32
    origin: Floats
    triangles: Ints32 | None
    file_points: int
    voxel: float | None
    units_per_metre: float | None
    up: Floats | None
    usual_up: Floats
    notes: tuple[str, ...] = ()


def gather(
    blocks: Iterable[Floats],
    count: int,
    units_of: Callable[[Floats32], float] | None,
    most: int = MOST_POINTS,
) -> tuple[Floats32, Floats, float | None]:
    """Return the points of blocks.

    Parameters
    ----------
    blocks : (n, 3) float64 each
    count : of all points
    units_of : of a cloud: how many units are a metre, by the points so far; None for the vertices
        of a mesh, which are all kept, missing ones too
    most : points of a cloud that are kept

    Returns
    -------
    points : (N, 3) float32, relative to the origin
    origin : (3,) float64, whole units; zero unless the points are far from that of the file
    voxel : edge that a cloud was thinned to, units; None where it was not

    Raises
    ------
    UnreadableCloud : there are more points than announced, or a point is too far from the others.
    """
    cloud = _Cloud(count, units_of, most)
    for block in blocks:
        cloud.add(block)
    return cloud.finished()


class _Cloud:
    """Points that are added block by block, and thinned when they are too many."""

    def __init__(self, count: int, units_of: Callable[[Floats32], float] | None, most: int) -> None:
        room = count if units_of is None else min(count, 2 * most)
        self._points = np.empty((room, 3), np.float32)
        self._n = 0
        self._origin: Floats | None = None
        self._units_of, self._most = units_of, most
        self._voxel: float | None = None

    def add(self, block: Floats) -> None:
        """Add points; those of a cloud that are not finite are left out."""
        present = np.asarray(np.isfinite(block).all(axis=1))
        if self._units_of is not None and not present.all():
            block, present = block[present], present[present]
        if self._origin is None and present.any():
            middle = np.median(block[present], axis=0)
            far = bool(np.abs(middle).max() > _NEAR_UNITS)
            self._origin = np.round(middle) if far else np.zeros(3)
        first = 0
        while first < len(block):
            if self._n == len(self._points):
                self._thin()
            piece = block[first : first + len(self._points) - self._n]
            with np.errstate(all="ignore"):  # what overflows is not finite, and so missing
                shifted = piece if self._origin is None else piece - self._origin
                self._points[self._n : self._n + len(piece)] = shifted
            self._n += len(piece)
            first += len(piece)

    def finished(self) -> tuple[Floats32, Floats, float | None]:
        """Return points, origin and voxel."""
        if self._units_of is not None and (self._n > self._most or self._voxel is not None):
            self._thin()
        points = self._points[: self._n]
        origin = np.zeros(3) if self._origin is None else self._origin
        return points if self._n == len(self._points) else points.copy(), origin, self._voxel

    def _thin(self) -> None:
        if self._units_of is None:
            raise UnreadableCloud(
                f"More than the {len(self._points)} vertices follow that the file announces. "
                "Copy or write the file again."
            )
        points = self._points[: self._n]
        reach = float(np.abs(points).max(initial=0.0))
        if not reach < np.inf:
            raise UnreadableCloud(TOO_LARGE)
        finest = max(FINEST_M * self._units_of(points), reach / _MOST_VOXELS, self._voxel or 0.0)
        fewer, self._voxel = thinned(points, self._most, finest)
        self._n = len(fewer)
        self._points[: self._n] = fewer
