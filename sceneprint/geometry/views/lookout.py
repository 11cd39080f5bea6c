"""Visibility of a surface from a place.

    Surfels, place  --Lookout.look-->  Sight

Pieces of the surface are drawn on the faces of a cube around the place, with pixels of a few
degrees. An element is a piece of surface, seen from a direction and a distance: (piece, azimuth,
octave).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.views.raster import draw_discs, pinhole
from sceneprint.geometry.views.render import cube_faces, rays_of
from sceneprint.geometry.views.samples import Surfels, sort_into_blocks
from sceneprint.types import Floats, Floats32, Intrinsics, Ints32, Ints64

#: Number of pixels along an edge of the cube; each is three degrees wide.
_FACE_PX = 28
#: Maximum elevation of directions that count as horizontal, rad.
_BESIDE = math.radians(30.0)
#: Number of azimuths from which a piece can be seen, and number of octaves of distance.
SIDES, OCTAVES = 6, 3
#: Bit of a mask that is set if a piece is seen from behind, against its normal.
BEHIND = np.uint32(1 << 31)
#: Tolerance of the depth buffer: a share of the distance, plus a multiple of the cell side.
_SAME_SHARE, _SAME_CELLS = 0.03, 1.5


@dataclass(frozen=True, eq=False)
class Sight:
    """The parts of a surface that are visible from a place.

    Parameters
    ----------
    elements : (E,) int32 visible elements
    masks : (E,) uint32; bit d is set if view d shows the element, BEHIND if it is seen from behind
    hit : (D,) share of each view that shows a surface within range
    beside : share of the directions from the horizon to 30 degrees above it that show a surface
    back : (D,) share of the surface in each view that is seen from behind
    close : (D,) share of the surface in each view that is too near
    nearest : distance of the nearest piece, metres
    """

    elements: Ints32
    masks: NDArray[np.uint32]
    hit: Floats
    beside: float
    back: Floats
    close: Floats
    nearest: float


@kernel
def _write_visible(
    points: Floats32, normals: Floats32, starts: Ints64, ends: Ints64, place: Floats, turn: Floats,
    size: int, depth: Floats32, reach: float, gap: float, views: Floats, limits: Floats,
    elements: Ints32, masks: NDArray[np.uint32],
) -> int:  # fmt: skip
    """Write the visible elements on a face of the cube, and their masks; return the count."""
    count = 0
    half = size / 2.0
    for block in range(len(starts)):
        for i in range(starts[block], ends[block]):
            x, y, z = points[i, 0] - place[0], points[i, 1] - place[1], points[i, 2] - place[2]
            ahead = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z
            if not ahead > 1e-3:
                continue
            u = (turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z) / ahead * half + half
            v = (turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z) / ahead * half + half
            if not (0 <= u < size and 0 <= v < size):
                continue
            distance = np.sqrt(x * x + y * y + z * z)
            if distance > reach or ahead > depth[int(v), int(u)] * (1.0 + _SAME_SHARE) + gap:
                continue
            mask = np.uint32(0)
            for d in range(len(views)):
                own = views[d]
                deep = own[0, 2] * x + own[1, 2] * y + own[2, 2] * z
                if limits[0] > 0.0:  # the sensor sees all around
                    if abs(z) <= limits[0] * distance:
                        mask |= np.uint32(1) << np.uint32(d)
                    continue
                if not deep > 0:
                    continue
                across = (own[0, 0] * x + own[1, 0] * y + own[2, 0] * z) / deep
                down = (own[0, 1] * x + own[1, 1] * y + own[2, 1] * z) / deep
                if limits[1] < across < limits[2] and limits[3] < down < limits[4]:
                    mask |= np.uint32(1) << np.uint32(d)
            if mask == 0:
                continue
            if normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z > 0:
                mask |= np.uint32(1) << np.uint32(31)
            side = int((np.arctan2(-y, -x) + np.pi) / (2.0 * np.pi) * SIDES) % SIDES
            octave = int(np.floor(np.log2(reach / max(distance, 1e-9))))
            octave = min(max(octave, 0), OCTAVES - 1)
            elements[count] = (i * SIDES + side) * OCTAVES + octave
            masks[count] = mask
            count += 1
    return count


@kernel
def _sum_solid_angles(
    depth: Floats32, item: Ints32, normals: Floats32, rays: Floats, lengths: Floats,
    inside: NDArray[np.bool_], forward: Floats, farthest: float, close: float, sums: Floats,
) -> None:  # fmt: skip
    """Sum the solid angles of each view's rays, hits, hits from behind, and hits too near."""
    for n in range(len(depth)):
        distance, weight, i = depth[n] * lengths[n], lengths[n] ** -3.0, item[n]
        behind = False
        if distance < farthest:
            a, b, c = normals[i, 0], normals[i, 1], normals[i, 2]
            behind = a * rays[n, 0] + b * rays[n, 1] + c * rays[n, 2] > 0
        for d in range(len(inside)):
            if inside[d, n]:
                sums[d, 0] += weight
                if distance < farthest:
                    sums[d, 1] += weight
                    sums[d, 2] += weight if behind else 0.0
                    sums[d, 3] += weight if distance * forward[d, n] < close else 0.0


class Lookout:
    """Computes which pieces of a surface are visible from a place.

    Parameters
    ----------
    pieces : surfels in level axes
    reach : maximum distance of a visible piece, metres
    farthest : range of the sensor, metres
    close : minimum depth; a nearer surface is too near, metres
    views : (D, 3, 3) R_level_view, at most 24
    camera : camera of the views; None for a sensor that sees all around
    elevation : maximum elevation of such a sensor above and below the horizon, rad
    """

    def __init__(
        self, pieces: Surfels, reach: float, farthest: float, close: float, views: Floats,
        camera: Intrinsics | None, elevation: float,
    ) -> None:  # fmt: skip
        self._cell, self._reach = pieces.cell, reach
        self._farthest, self._close = farthest, close
        extents = np.full(len(pieces.points), pieces.cell, np.float32)
        order, self._blocks = sort_into_blocks(pieces.points, reach / 8.0, extents)
        self.points, self.normals = pieces.points[order], pieces.normals[order]
        self._radii = extents * np.float32(0.75)
        self._face, self._turns = cube_faces(_FACE_PX)
        self._pinhole = pinhole(self._face)
        self._views = views
        rays = np.concatenate([rays_of(self._face).reshape(-1, 3) @ R.T for R in self._turns])
        lengths = np.linalg.norm(rays, axis=1)
        self._rays = rays / lengths[:, None]
        self._lengths = lengths
        self._limits = np.array([math.sin(elevation), 0.0, 0.0, 0.0, 0.0])
        self._inside = np.abs(self._rays[None, :, 2]) <= math.sin(elevation)
        self._inside = self._inside.repeat(len(views) + 1, axis=0)
        self._inside[-1] = (self._rays[:, 2] > 0) & (self._rays[:, 2] < math.sin(_BESIDE))
        self._forward = np.ones((len(views) + 1, len(rays)))
        if camera is not None:
            left, top = (-0.5 - camera.cx) / camera.fx, (-0.5 - camera.cy) / camera.fy
            right, bottom = left + camera.width / camera.fx, top + camera.height / camera.fy
            self._limits = np.array([0.0, left, right, top, bottom])
            own = np.einsum("ni,dij->dnj", self._rays, views)
            with np.errstate(divide="ignore", invalid="ignore"):
                across, down = own[..., 0] / own[..., 2], own[..., 1] / own[..., 2]
            within = (own[..., 2] > 0) & (across > left) & (across < right)
            self._inside[:-1] = within & (down > top) & (down < bottom)
            self._forward[:-1] = own[..., 2]
        self._elements = np.empty(len(self.points), np.int32)
        self._masks = np.empty(len(self.points), np.uint32)

    @property
    def universe(self) -> int:
        """Return the number of elements."""
        return len(self.points) * SIDES * OCTAVES

    def look(self, place: Floats) -> Sight:
        """Return the parts of the surface that are visible from a place (3,)."""
        size, gap = _FACE_PX, _SAME_CELLS * self._cell
        depths = np.full((6, size, size), np.inf, np.float32)
        items = np.full((6, size, size), -1, np.int32)
        visible = []
        for R, depth, item in zip(self._turns, depths, items, strict=True):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R.T, -R.T @ place
            starts, ends = self._blocks.in_view(T, self._pinhole, depth.shape, self._farthest)
            draw_discs(
                self.points, self.normals, self._radii, starts, ends, T, self._pinhole, depth, item
            )
            n = _write_visible(
                self.points, self.normals, starts, ends, place, R, size, depth, self._reach, gap,
                self._views, self._limits, self._elements, self._masks,
            )  # fmt: skip
            visible.append((self._elements[:n].copy(), self._masks[:n].copy()))
        elements, masks = (np.concatenate(parts) for parts in zip(*visible, strict=True))
        depth, item = depths.reshape(-1), items.reshape(-1)
        sums = np.zeros((len(self._views) + 1, 4))
        _sum_solid_angles(
            depth, item, self.normals, self._rays, self._lengths, self._inside, self._forward,
            self._farthest, self._close, sums,
        )  # fmt: skip
        shown = np.maximum(sums[:, 1], 1e-9)
        hit = sums[:, 1] / sums[:, 0]
        return Sight(
            elements, masks, hit[:-1], float(hit[-1]), (sums[:, 2] / shown)[:-1],
            (sums[:, 3] / shown)[:-1], float((depth * self._lengths).min()),
        )  # fmt: skip
