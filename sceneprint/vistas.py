"""What a surface looks like to people: which point each pixel of a picture of it shows.

Surface  --vista_of-->  Vista  --onto-->  labels of other points, pixel by pixel
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from sceneprint.cameras import Intrinsics, Sphere
from sceneprint.types import Floats, Floats32, Ints32, Surface

Scalar = TypeVar("Scalar", bound=np.generic)

#: Pixels along the longer side of a view from above, by the number of points.
_LEAST, _MOST = 16, 320
_OPTICAL = "x right, y down, z ahead"
_AXES = "the x, y and z of its own axes"


@dataclass(frozen=True, eq=False)
class Vista:
    """An image of a surface.

    Parameters
    ----------
    pixels : (h, w) int32, index of the point that a pixel shows; -1 for none
    distances : (N,) float64, metres, of each point
    what : those are: "depth" along a camera's axis, "range" from a viewpoint, or "height"
    axes : of the normals, in words
    """

    pixels: Ints32
    distances: Floats
    what: Literal["depth", "range", "height"]
    axes: str

    def of(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """(h, w, ...) values of the points that are shown; whatever where none is."""
        chosen: NDArray[Scalar] = values[self.pixels]
        return chosen

    @property
    def shown(self) -> NDArray[np.bool_]:
        """(h, w): whether a pixel shows a point."""
        return self.pixels >= 0


def vista_of(surface: Surface) -> Vista:
    """How to draw a surface: as its camera saw it, as one looks about its viewpoint, or, of points
    in no order, from the side of their least extent, which is above in a building.

    Parameters
    ----------
    surface : (h, w) points, metres
    """
    points = surface.points.reshape(-1, 3).astype(np.float64)
    count = np.arange(len(points), dtype=np.int32).reshape(surface.valid.shape)
    pixels = np.where(surface.valid, count, np.int32(-1))
    if isinstance(surface.camera, Intrinsics):
        return Vista(pixels, points[:, 2], "depth", _OPTICAL)
    if isinstance(surface.camera, Sphere):
        # azimuth counts to the left of who has the pole above; an optical frame's y points down
        turned = pixels[::-1] if surface.camera.pole == 1 else pixels[:, ::-1]
        return Vista(turned, np.linalg.norm(points, axis=1), "range", _AXES)
    return _from_above(points, surface.valid.ravel())


def onto(vista: Vista, surface: Surface, points: Floats32, labels: Ints32) -> Ints32:
    """Labels of points in no order, as the pixels of another picture of the same show them.

    Parameters
    ----------
    vista : of `surface`
    surface : what is drawn
    points : (N, 3) metres, in its coordinates
    labels : (N,) of each point, -1 for none

    Returns
    -------
    labels : (h, w) of the nearest point to what a pixel shows; -1 for none
    """
    from scipy.spatial import KDTree

    drawn: Ints32 = np.full(vista.pixels.shape, -1, np.int32)
    _, nearest = KDTree(points).query(surface.points.reshape(-1, 3)[vista.pixels[vista.shown]])
    drawn[vista.shown] = labels[nearest]
    return drawn


def _from_above(points: Floats, valid: NDArray[np.bool_]) -> Vista:
    """Of all points that lie on a pixel the highest is shown."""
    seen = np.flatnonzero(valid)
    if not seen.size:
        return Vista(np.full((1, 1), -1, np.int32), np.zeros(len(points)), "height", _AXES)
    centred = points - points[seen].mean(axis=0)
    _, axes = np.linalg.eigh(centred[seen].T @ centred[seen])
    for i in (0, 2):  # of the two senses the one towards which the axis nearest to it points
        axes[:, i] *= np.sign(axes[np.argmax(np.abs(axes[:, i])), i])
    above, right = axes[:, 0], axes[:, 2]
    heights = centred @ above
    flat = np.stack([centred @ np.cross(right, above), centred @ right], axis=1)  # down, right
    low = flat[seen].min(axis=0)
    size = np.maximum(flat[seen].max(axis=0) - low, 1e-6)
    longer = min(max(math.isqrt(len(seen)), _LEAST), _MOST)
    cell = size.max() / (longer - 1)
    rows, columns = np.rint((flat[seen] - low) / cell).astype(np.intp).T
    pixels: Ints32 = np.full((rows.max() + 1, columns.max() + 1), -1, np.int32)
    order = np.argsort(heights[seen], kind="stable")  # the highest is written last
    pixels[rows[order], columns[order]] = seen[order]
    return Vista(pixels, heights, "height", _AXES)
