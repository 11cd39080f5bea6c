"""The result of all readers of surfaces, in the units and axes of the file.

blocks of points  --gather-->  RawSurface

Points are float32 relative to a float64 origin, so that map coordinates (UTM) have a precision of
millimetres. Large clouds are thinned while they are read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.points.cloud import thinned
from sceneprint.types import Floats, Floats32, Ints32

#: Maximum number of points in a file and in a thinned cloud, and of vertices and triangles in a
#: mesh.
MOST_FILE_POINTS, MOST_POINTS = 60_000_000, 10_000_000
MOST_VERTICES, MOST_TRIANGLES = 15_000_000, 20_000_000
#: Minimum voxel edge length of a thinned cloud, metres.
FINEST_M = 0.01
#: Maximum coordinate for which no origin is subtracted, units of the file.
_NEAR_UNITS = 1000.0
TOO_LARGE = (
    "A coordinate is larger than any coordinate on Earth. Remove isolated distant points, and "
    "write the file again."
)
#: Maximum number of voxels along an axis from the origin.
_MOST_VOXELS = 1_000_000


@dataclass(frozen=True, eq=False)
class RawSurface:
    """A surface in the units and axes of its file.

    Parameters
    ----------
    points : (N, 3) float32, relative to `origin`; vertices of a mesh may be NaN or infinite
    origin : (3,) float64
    triangles : (M, 3) int64 or int32 indices that have not been checked; None for a cloud
    file_points : number of points of the file, including missing points
    voxel : voxel edge length of a thinned cloud, units of the file; None if it is not thinned
    units_per_metre : units that the file states; None if it states none
    up : (3,) up direction that the file states; None if it states none
    usual_up : (3,) up direction of most files of this format
    notes : sentences for users on omitted parts
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
    """Concatenate the points of all blocks; thin large clouds.

    Parameters
    ----------
    blocks : coordinates in blocks (n, 3) of float64
    count : declared number of points
    units_of : function that estimates the units per metre of a cloud from its first points; None
        for the vertices of a mesh, which are returned completely, including missing vertices
    most : maximum number of points of the thinned cloud

    Returns
    -------
    points : (N, 3) float32, relative to the origin
    origin : (3,) float64 with integer values; zero unless the points are far from the file's origin
    voxel : edge of the voxels of the thinned cloud, units; None if it is not thinned

    Raises
    ------
    UnreadableCloud : If a mesh has more vertices than declared, or a point of a cloud that is
        thinned is too far from the others.
    """
    cloud = _Cloud(count, units_of, most)
    for block in blocks:
        cloud.add(block)
    return cloud.finish()


class _Cloud:
    """A cloud to which points are added in blocks, and which is thinned when it is too large."""

    def __init__(self, count: int, units_of: Callable[[Floats32], float] | None, most: int) -> None:
        room = count if units_of is None else min(count, 2 * most)
        self._points = np.empty((room, 3), np.float32)
        self._n = 0
        self._origin: Floats | None = None
        self._units_of, self._most = units_of, most
        self._voxel: float | None = None

    def add(self, block: Floats) -> None:
        """Add points; for clouds, omit points that are not finite."""
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
            with np.errstate(all="ignore"):  # overflows are missing points
                shifted = piece if self._origin is None else piece - self._origin
                self._points[self._n : self._n + len(piece)] = shifted
            self._n += len(piece)
            first += len(piece)

    def finish(self) -> tuple[Floats32, Floats, float | None]:
        """Return the points, origin and voxel; see `gather`."""
        if self._units_of is not None and (self._n > self._most or self._voxel is not None):
            self._thin()
        points = self._points[: self._n]
        origin = np.zeros(3) if self._origin is None else self._origin
        return points if self._n == len(self._points) else points.copy(), origin, self._voxel

    def _thin(self) -> None:
        """Thin the points to make room; raise UnreadableCloud for the vertices of a mesh."""
        if self._units_of is None:
            raise UnreadableCloud(
                f"The file declares {len(self._points)} vertices, but more follow. Copy or write "
                "the file again."
            )
        points = self._points[: self._n]
        reach = float(np.abs(points).max(initial=0.0))
        if not reach < np.inf:
            raise UnreadableCloud(TOO_LARGE)
        finest = max(FINEST_M * self._units_of(points), reach / _MOST_VOXELS, self._voxel or 0.0)
        fewer, self._voxel = thinned(points, self._most, finest)
        self._n = len(fewer)
        self._points[: self._n] = fewer
