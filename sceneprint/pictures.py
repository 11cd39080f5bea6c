"""Small pictures of frames: depth, normals or patches.

Surface, labels  --depth_view | normals_view | patches_view-->  colours  --picture-->  PNG
Surfaces, transform  --overlay_picture-->  PNG
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.rigid import transform_points
from sceneprint.types import (
    Bytes,
    Floats,
    Floats32,
    Intrinsics,
    Ints32,
    Sphere,
    Surface,
)
from sceneprint_client.api.results import WIDTHS

#: Colour of unknown pixels: a dark grey that represents no normal and no depth.
UNKNOWN = 40


def normal_colours(normals: Floats32, valid: NDArray[np.bool_]) -> Bytes:
    """Return normals as colours as in the paper's Fig. 1: red, green, blue for x, y, z.

    Parameters
    ----------
    normals : (h, w, 3) unit vectors
    valid : (h, w) mask

    Returns
    -------
    (h, w, 3) uint8
    """
    colours = np.rint((normals + 1.0) * 127.5).astype(np.uint8)
    return np.where(valid[..., None], colours, np.uint8(UNKNOWN))


Scalar = TypeVar("Scalar", bound=np.generic)

#: Minimum and maximum number of pixels along the longer side of a view of unordered points.
_LEAST, _MOST = 16, 320
_OPTICAL = "x right, y down, z forward"
_AXES = "x, y and z in the axes of the cloud"


@dataclass(frozen=True, eq=False)
class Vista:
    """A picture of a surface: the index of the point that each pixel shows.

    Parameters
    ----------
    pixels : (h, w) int32, index of each pixel's point; -1 for pixels without a point
    distances : (N,) float64, distances of the points, metres
    what : meaning of `distances`: "depth" along a camera's axis, "range" from a viewpoint, or
        "height"
    axes : description of the axes in which normals are given
    """

    pixels: Ints32
    distances: Floats
    what: Literal["depth", "range", "height"]
    axes: str

    def of(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Return the value (h, w, ...) of each pixel's point; for an empty pixel, any value."""
        chosen: NDArray[Scalar] = values[self.pixels]
        return chosen

    @property
    def shown(self) -> NDArray[np.bool_]:
        """Return a mask (h, w) of the pixels that show a point."""
        return self.pixels >= 0


def vista_of(surface: Surface) -> Vista:
    """Return the picture of a surface from its camera or around its viewpoint.

    Unordered points are viewed along the axis of their smallest extent, vertical in most buildings.

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
        # if the pole is up, azimuth increases to the left; the y axis of an optical frame points
        # down
        flipped = pixels[::-1] if surface.camera.pole == 1 else pixels[:, ::-1]
        return Vista(flipped, np.linalg.norm(points, axis=1), "range", _AXES)
    return _along_least_extent(points, surface.valid.ravel())


def project_labels(vista: Vista, surface: Surface, points: Floats32, labels: Ints32) -> Ints32:
    """Assign the labels of unordered points to the pixels of a picture of the same surface.

    Parameters
    ----------
    vista : picture of `surface`, a result of `vista_of`
    surface : (h', w') points, metres
    points : (N, 3) metres, in the coordinates of `surface`
    labels : (N,) label of each point; -1 for unlabelled points

    Returns
    -------
    labels : (h, w) label of the point nearest to each pixel's point; -1 for pixels without a label
    """
    from scipy.spatial import KDTree

    drawn: Ints32 = np.full(vista.pixels.shape, -1, np.int32)
    _, nearest = KDTree(points).query(surface.points.reshape(-1, 3)[vista.pixels[vista.shown]])
    drawn[vista.shown] = labels[nearest]
    return drawn


def _along_least_extent(points: Floats, valid: NDArray[np.bool_]) -> Vista:
    """Return a view of points (N, 3) along the axis of their smallest extent.
    This axis is vertical for a room, and horizontal for a single wall. Each pixel shows the point
    that is farthest along it.
    """
    indices = np.flatnonzero(valid)
    if not indices.size:
        return Vista(np.full((1, 1), -1, np.int32), np.zeros(len(points)), "height", _AXES)
    centred = points - points[indices].mean(axis=0)
    _, axes = np.linalg.eigh(centred[indices].T @ centred[indices])
    for i in (0, 2):  # orient the axes like the nearest coordinate axes
        axes[:, i] *= np.sign(axes[np.argmax(np.abs(axes[:, i])), i])
    above, right = axes[:, 0], axes[:, 2]
    heights = centred @ above
    flat = np.stack([centred @ np.cross(right, above), centred @ right], axis=1)  # down, right
    low = flat[indices].min(axis=0)
    size = np.maximum(flat[indices].max(axis=0) - low, 1e-6)
    longer = min(max(math.isqrt(len(indices)), _LEAST), _MOST)
    cell = size.max() / (longer - 1)
    rows, columns = np.rint((flat[indices] - low) / cell).astype(np.intp).T
    pixels: Ints32 = np.full((rows.max() + 1, columns.max() + 1), -1, np.int32)
    order = np.argsort(heights[indices], kind="stable")  # the highest point is written last
    pixels[rows[order], columns[order]] = indices[order]
    return Vista(pixels, heights, "height", _AXES)


#: Maximum number of rows of a picture; larger pictures are scaled down.
MOST_ROWS = 2560

#: Percentiles of depth at the ends of the colour map, so that stray samples do not compress it.
_RANGE = (1.0, 99.0)
#: Equally spaced colours of viridis; linear interpolation errs by at most 6 of 255.
_VIRIDIS = np.array(
    [
        (68, 1, 84), (72, 24, 106), (71, 45, 123), (66, 64, 134), (59, 82, 139), (51, 99, 141),
        (44, 114, 142), (38, 130, 142), (33, 145, 140), (31, 160, 136), (40, 174, 128),
        (63, 188, 115), (94, 201, 98), (132, 212, 75), (173, 220, 48), (216, 226, 25),
        (253, 231, 37),
    ],
    np.float64,
)  # fmt: skip
#: Number of additional colours, so that the last patches can also choose from several colours.
_SPARE = 64
#: Matrices from Oklab to the cube roots of cone responses, and from cone responses to linear sRGB.
_TO_CONES = np.array(
    [(1, 0.3963377774, 0.2158037573), (1, -0.1055613458, -0.0638541728),
     (1, -0.0894841775, -1.2914855480)]
)  # fmt: skip
_TO_PRIMARIES = np.array(
    [(4.0767416621, -3.3077115913, 0.2309699292), (-1.2684380046, 2.6097574011, -0.3413193965),
     (-0.0041960863, -0.7034186147, 1.7076147010)]
)  # fmt: skip


def depth_view(surface: Surface) -> tuple[Bytes, dict[str, str]]:
    """Return depths in a perceptually uniform colour map: near is yellow, far is violet.

    Return the ranges of a cloud with a viewpoint, and the heights of another cloud: high is yellow.

    Parameters
    ----------
    surface : (h, w) points, metres

    Returns
    -------
    colours : (h', w', 3) uint8, pixels of `vista_of`; dark grey if unknown
    meaning : `near_m` and `far_m`, depths or ranges at the ends of the colour map, or `low_m` and
        `high_m`, heights relative to the mean; and a description
    """
    vista = vista_of(surface)
    z, shown = vista.of(vista.distances), vista.shown
    shown_depths = z[shown]
    near, far = np.percentile(shown_depths, _RANGE).tolist() if shown_depths.size else (0.0, 0.0)
    share = (far - z) / max(far - near, 1e-9)
    mixed = viridis(1.0 - share if vista.what == "height" else share)
    ends, words = ("near_m", "far_m"), (f"{near:.2f} m or nearer", f"{far:.2f} m or farther")
    if vista.what == "height":
        ends, words = ("low_m", "high_m"), (f"{far:.2f} m or higher", f"{near:.2f} m or lower")
    meaning = {
        **dict(zip(ends, (f"{near:.4f}", f"{far:.4f}"), strict=True)),
        "Description": f"{vista.what}: yellow is {words[0]}, violet is {words[1]}, dark grey is "
        "unknown",
    }
    return np.where(shown[..., None], mixed, UNKNOWN), meaning


def viridis(shares: Floats) -> Bytes:
    """Map shares (...) to colours (..., 3): violet at 0 and below, yellow at 1 and above."""
    place = np.clip(shares, 0.0, 1.0) * (len(_VIRIDIS) - 1)
    steps = np.arange(len(_VIRIDIS))
    mixed = np.stack([np.interp(place, steps, _VIRIDIS[:, c]) for c in range(3)], axis=-1)
    return np.rint(mixed).astype(np.uint8)


def normals_view(surface: Surface) -> tuple[Bytes, dict[str, str]]:
    """Return unit normals in the sensor's axes as colours: (r, g, b) = 127.5 (1 + (x, y, z)).

    Parameters
    ----------
    surface : (h, w) normals

    Returns
    -------
    colours : (h', w', 3) uint8, pixels of `vista_of`; dark grey if unknown
    meaning : description of the colours
    """
    vista = vista_of(surface)
    frame = "optical frame" if vista.what == "depth" else "sensor's frame"
    text = (
        f"normals in the {frame}: red, green, blue are 127.5 (1 + n) of {vista.axes}; dark grey is "
        "unknown"
    )
    normals = vista.of(surface.normals.reshape(-1, 3))
    return normal_colours(normals, vista.shown), {"Description": text}


def patches_view(labels: Ints32) -> tuple[Bytes, dict[str, str]]:
    """Colour patches so that neighbours differ.

    Parameters
    ----------
    labels : (h, w) index of each pixel's patch; -1 for pixels without a patch

    Returns
    -------
    colours : (h, w, 3) uint8, deterministic; dark grey for pixels without a patch
    meaning : description of the colours
    """
    count = int(labels.max(initial=-1)) + 1
    palette = np.concatenate([_assign_colours(labels, count), np.full((1, 3), UNKNOWN, np.uint8)])
    text = f"{count} patches of the finest level, one colour per patch; dark grey is unassigned"
    return palette[labels], {"patches": str(count), "Description": text}


def picture(colours: Bytes, width: int, text: Mapping[str, str]) -> bytes:
    """Encode colours as a PNG file, scaled to `width`; scaling does not mix pixels.

    Parameters
    ----------
    colours : (h, w, 3) uint8
    width : number of columns, reduced if the picture would have more than MOST_ROWS rows
    text : values of the file's tEXt chunks, by keyword

    Raises
    ------
    ValueError : If the width is outside WIDTHS
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    if not WIDTHS[0] <= width <= WIDTHS[1]:
        raise ValueError(f"The width {width} is not in the range {WIDTHS[0]} to {WIDTHS[1]}.")
    scale = min(width / colours.shape[1], MOST_ROWS / colours.shape[0])
    rows, columns = (_sample_indices(n, max(round(n * scale), 1)) for n in colours.shape[:2])
    info = PngInfo()
    for name, value in text.items():
        info.add_text(name, value)
    buffer = io.BytesIO()
    Image.fromarray(colours[rows[:, None], columns]).save(buffer, "PNG", pnginfo=info)
    return buffer.getvalue()


#: Colours (red, green, blue) of the query and of the match, as on the dashboard.
QUERY_COLOUR, MATCH_COLOUR = (217, 119, 43), (43, 108, 176)
#: Number of pixels along the longer side of a panel, and number of points that saturate a pixel.
_PANEL, _FULL = 480, 1.5


def overlay_picture(query: Surface, match: Surface, T_match_query: Floats, title: str) -> bytes:
    """Draw two frames from above, before and after the transform: two panels, as a PNG file.

    Parameters
    ----------
    query, match : surfaces in their cameras' coordinates, metres
    T_match_query : (4, 4) transform from the query to the match
    title : line of ASCII text above the panels
    """
    from PIL import Image, ImageDraw

    # in the picture, the match's camera has x to the right, and z (its optical axis) up
    ours, theirs = (surface.points[surface.valid].astype(np.float64) for surface in (query, match))
    aligned = transform_points(T_match_query, ours)
    everything = np.concatenate([theirs, ours, aligned])[:, [0, 2]]
    low, high = np.percentile(everything, (1, 99), axis=0)  # exclude stray points
    scale = (_PANEL - 1) / (high - low).max()
    columns, rows = np.ceil((high - low) * scale).astype(int) + 1
    panels = []
    for points in (ours, aligned):
        panel = np.ones((rows, columns, 3))
        for drawn, colour in ((theirs, MATCH_COLOUR), (points, QUERY_COLOUR)):
            x, y = np.rint((drawn[:, [0, 2]] - low) * scale).astype(int).T
            inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
            counts = np.zeros((rows, columns))
            np.add.at(counts, (rows - 1 - y[inside], x[inside]), 1.0)
            ink = np.minimum(counts / _FULL, 1.0)[..., None]
            panel *= 1.0 - ink * (1.0 - np.array(colour) / 255)
        panels.append(np.pad(panel, ((44, 4), (8, 8), (0, 0)), constant_values=1.0))
    image = Image.fromarray(np.rint(np.concatenate(panels, axis=1) * 255).astype(np.uint8))
    pen = ImageDraw.Draw(image)
    pen.text((8, 4), title, "black")
    for i, when in enumerate(("before", "after")):
        pen.text((8 + i * (columns + 16), 24), f"{when} alignment, from above:", "black")
        pen.text((218 + i * (columns + 16), 24), "query", QUERY_COLOUR)
        pen.text((256 + i * (columns + 16), 24), "match", MATCH_COLOUR)
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()


def _sample_indices(n: int, size: int) -> NDArray[np.intp]:
    """Return the indices of the source pixels (of `n`) at the centres of `size` target pixels."""
    return ((np.arange(size) + 0.5) * n / size).astype(np.intp)


def _assign_colours(labels: Ints32, count: int) -> Bytes:
    """Return a colour per patch: the unused colour that differs most from its neighbours'."""
    lab = _palette(count + _SPARE)
    squares = (lab**2).sum(axis=1)[:, None]
    neighbours = _neighbours(labels, count)
    free = np.ones(len(lab), np.bool_)
    chosen = np.full(count, -1, np.intp)
    for patch in range(count):
        beside = chosen[neighbours[patch]]
        beside = beside[beside >= 0]
        if len(beside):
            apart = (squares - 2.0 * lab @ lab[beside].T + squares[beside, 0]).min(axis=1)
            chosen[patch] = np.argmax(np.where(free, apart, -1.0))
        else:
            chosen[patch] = np.argmax(free)
        free[chosen[patch]] = False
    return _to_srgb(lab[chosen])


def _neighbours(labels: Ints32, count: int) -> list[NDArray[np.intp]]:
    """Return, for each patch, the patches that share a pixel edge with it."""
    across = np.stack([labels[:, :-1].ravel(), labels[:, 1:].ravel()], axis=1)
    down = np.stack([labels[:-1].ravel(), labels[1:].ravel()], axis=1)
    pairs = np.concatenate([across, down])
    pairs = pairs[(pairs[:, 0] != pairs[:, 1]) & (pairs.min(axis=1) >= 0)]
    pairs = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    ends = np.searchsorted(pairs[:, 0], np.arange(count + 1))
    return [pairs[ends[i] : ends[i + 1], 1].astype(np.intp) for i in range(count)]


def _palette(count: int) -> Floats:
    """Return colours (count, 3) in Oklab, evenly distributed over hue and lightness."""
    n = np.arange(1, count + 1)
    # powers of the plastic number distribute points evenly over a square (Roberts 2018)
    plastic = 1.32471795724474602596
    lightness = 0.48 + 0.4 * ((0.5 + n / plastic) % 1.0)
    hue = 2.0 * math.pi * ((0.5 + n / plastic**2) % 1.0)
    return np.stack([lightness, 0.11 * np.cos(hue), 0.11 * np.sin(hue)], axis=1)


def _to_srgb(lab: Floats) -> Bytes:
    """Convert Oklab (n, 3) to sRGB."""
    linear = np.clip(((lab @ _TO_CONES.T) ** 3) @ _TO_PRIMARIES.T, 0.0, 1.0)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    colours: Bytes = np.rint(255.0 * curved).astype(np.uint8)
    return colours
