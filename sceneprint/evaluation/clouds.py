"""One query's validated views, merged by their estimated transforms into the query's frame.

query, pairs  --merged-->  Cloud  --to_ply, cloud_figure-->  PLY, picture
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sceneprint.clouds import write_ply
from sceneprint.evaluation.diversity import FARTHEST
from sceneprint.evaluation.plots import new_figure
from sceneprint.evaluation.records import Pair
from sceneprint.geometry.levelling import levelling
from sceneprint.geometry.rigid import inverse, moved
from sceneprint.types import Bytes, Floats, Frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: One for each view, the query's first.
PALETTE = np.array(
    [(90, 96, 105), (43, 108, 176), (217, 119, 43), (47, 158, 99), (160, 80, 170), (196, 160, 50)],
    np.uint8,
)
#: Two neighbouring pixels this much farther apart than wide belong to two surfaces.
_JUMP = 0.05
_SIDE = 700  #: of a rendered view, pixels
_SLAB = 0.10  #: depth within which surfaces count as one, metres


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of several views.

    Parameters
    ----------
    points, normals : (N, 3) metres and unit length, in the query's frame
    of : (N,) the view: 0 the query, then the matches in order
    views : how many, the query not counted
    """

    points: Floats
    normals: Floats
    of: NDArray[np.intp]
    views: int

    @property
    def colours(self) -> Bytes:
        """(N, 3) uint8, one colour for each view."""
        return PALETTE[self.of % len(PALETTE)]


def merged(query: Frame, pairs: Sequence[Pair], database: Callable[[int], Frame]) -> Cloud:
    """The query and its matches, brought to the query's frame; no true pose is used.

    Parameters
    ----------
    query : its depth
    pairs : validated, each with a transform
    database : gives the frame of a database index
    """
    parts = [_oriented(query)]
    for pair in pairs:
        T = pair.validation.T_match_query
        if T is None:
            raise ValueError(f"match {pair.match} has no transform")
        points, normals = _oriented(database(pair.match))
        back = inverse(T)
        parts.append((moved(back, points), normals @ back[:3, :3].T))
    return Cloud(
        np.concatenate([p for p, _ in parts]),
        np.concatenate([n for _, n in parts]),
        np.repeat(np.arange(len(parts)), [len(p) for p, _ in parts]),
        len(pairs),
    )


def _oriented(frame: Frame) -> tuple[Floats, Floats]:
    """Points and normals of every second pixel that lies on a smooth surface."""
    k = frame.intrinsics
    y, x = np.mgrid[0 : k.height : 2, 0 : k.width : 2]
    z = frame.depth[::2, ::2].astype(float)
    points = np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=-1)
    right, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normals = np.cross(down, right)
    length = np.linalg.norm(normals, axis=-1)
    middle, depth = points[1:-1, 1:-1], z[1:-1, 1:-1]
    around = np.stack([z[1:-1, 2:], z[1:-1, :-2], z[2:, 1:-1], z[:-2, 1:-1]])
    smooth = (np.abs(around - depth) < _JUMP * depth).all(axis=0)
    good = (depth > 0) & (depth < FARTHEST) & (around > 0).all(axis=0) & smooth & (length > 0)
    return middle[good], normals[good] / length[good][:, None]


def to_ply(cloud: Cloud) -> bytes:
    """Binary PLY: positions in metres, normals, colours."""
    return write_ply(cloud.points, cloud.normals, cloud.colours)


def cloud_figure(name: str, ranked: Cloud, diverse: Cloud, ratio: float | None) -> Figure:
    """Both clouds from above and at a slant, at one scale; the paper's last figure."""
    figure = new_figure(11.5, 11.0)
    axes = figure.subplots(2, 2)
    everything = np.concatenate([ranked.points, diverse.points])
    level = levelling(np.concatenate([ranked.normals, diverse.normals]))
    for line, cloud, what in (
        (axes[0], ranked, "without diversification (VR)"),
        (axes[1], diverse, "with diversification (VDR)"),
    ):
        for cell, (view, turned) in zip(line, turns().items(), strict=True):
            cell.imshow(rendered(cloud, turned @ level, everything))
            cell.set_axis_off()
            cell.set_title(f"{cloud.views} views {what}, {view}", loc="left", fontsize=10)
    covers = f"; VDR covers {ratio:.2f} times the voxels of VR" if ratio else ""
    figure.suptitle(
        f"{name}{covers}\nvalidated views by their estimated transforms, one colour each, the "
        "query grey",
        x=0.01, ha="left", fontsize=12, parse_math=False,
    )  # fmt: skip
    return figure


def turns() -> dict[str, Floats]:
    """Rotations from the query's frame to a viewer's: x right, y down, z away from him."""
    return {"from above": _about_x(90), "at a slant": _about_x(35) @ _about_y(30)}


def _about_x(degrees: float) -> Floats:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _about_y(degrees: float) -> Floats:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def rendered(cloud: Cloud, turned: Floats, scale_of: Floats) -> Bytes:
    """(side, side, 3) uint8: the cloud without perspective, nearest points in front.

    Of views that lie within a slab of each other the earlier one is shown: what a later view
    adds then stands out in its colour.

    Parameters
    ----------
    cloud : what to draw
    turned : (3, 3) rotation to the viewer's axes
    scale_of : (M, 3) points that fill the picture, so that two clouds get one scale
    """
    frame = scale_of @ turned.T
    low, high = np.percentile(frame[:, :2], [0.5, 99.5], axis=0)
    scale = 0.94 * _SIDE / max(float((high - low).max()), 1e-6)
    seen = cloud.points @ turned.T
    pixels = np.rint((seen[:, :2] - (low + high) / 2) * scale + _SIDE / 2).astype(int)
    light = turned.T @ np.array([0.3, -0.5, -0.8])
    light = light / np.linalg.norm(light)
    shade = 0.55 + 0.45 * np.abs(cloud.normals @ light)
    colours = np.clip(cloud.colours * shade[:, None], 0, 255).astype(np.uint8)
    picture = np.full((_SIDE, _SIDE, 3), 255, np.uint8)
    # far first, and in a slab later views first: the last one written stays
    order = np.lexsort((-seen[:, 2], -cloud.of, -np.floor(seen[:, 2] / _SLAB)))
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
        x, y = pixels[order, 0] + dx, pixels[order, 1] + dy
        inside = (x >= 0) & (x < _SIDE) & (y >= 0) & (y < _SIDE)
        picture[y[inside], x[inside]] = colours[order][inside]
    return picture
