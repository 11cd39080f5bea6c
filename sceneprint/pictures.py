"""What the geometry sees of a frame, as a picture.

Frame  --save_picture-->  PNG: depth, normals, patches of each level
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.atomic_files import write_whole
from sceneprint.geometry.rigid import moved
from sceneprint.geometry.surface.depth_image import inverse_depth, surface
from sceneprint.models import Model
from sceneprint.signing import describe
from sceneprint.types import Bytes, DepthFrame, Floats, Floats32, Ints32, Surface

#: Colour where nothing is known: dark grey, which no normal and no depth has.
UNKNOWN = 40


def normal_colours(normals: Floats32, valid: NDArray[np.bool_]) -> Bytes:
    """The paper's colour map (Fig. 1): red, green, blue in proportion to x, y, z.

    Parameters
    ----------
    normals : (h, w, 3) of unit length
    valid : (h, w)

    Returns
    -------
    (h, w, 3) uint8
    """
    colours = np.rint((normals + 1.0) * 127.5).astype(np.uint8)
    return np.where(valid[..., None], colours, np.uint8(UNKNOWN))


def boundaries(labels: Ints32) -> NDArray[np.bool_]:
    """Pixels whose right or lower neighbour belongs to another patch.

    Parameters
    ----------
    labels : (h, w) int32

    Returns
    -------
    (h, w) bool
    """
    edge = np.zeros(labels.shape, np.bool_)
    edge[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    edge[:-1] |= labels[:-1] != labels[1:]
    return edge


def patch_colours(base: Bytes, labels: Ints32, zoom: int = 4) -> Bytes:
    """A picture with the boundaries of patches drawn over it, thin and black.

    Parameters
    ----------
    base : (h, w, 3) uint8
    labels : (h, w) int32, -1 for none
    zoom : enlargement, so that boundaries are thinner than patches

    Returns
    -------
    (zoom h, zoom w, 3) uint8
    """
    large = base.repeat(zoom, axis=0).repeat(zoom, axis=1)
    edge = boundaries(labels.repeat(zoom, axis=0).repeat(zoom, axis=1))
    return np.where(edge[..., None], np.uint8(0), large)


def save_picture(frame: DepthFrame, model: Model, path: Path) -> None:
    """Depth, normals as colour, and the patches of each level, side by side in a PNG.

    Parameters
    ----------
    frame : depth in metres
    model : whose parameters segment it
    path : of the PNG; its folder must exist

    Raises
    ------
    UselessFrame : nothing to segment.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    patches = describe(frame, model.parameters)
    seen = surface(*inverse_depth(frame, model.parameters.depth), model.parameters.normals)
    colours = normal_colours(seen.normals, seen.valid)
    columns = (len(patches.levels) + 3) // 2
    figure = Figure(figsize=(4.6 * columns, 7.2), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = list(figure.subplots(2, columns, squeeze=False).ravel())
    for axis in axes:
        axis.set_axis_off()
    figure.suptitle(f"{frame.name or 'frame'}   (model {model.label})", fontsize=13)
    _draw_depth(figure, axes[0], frame, model)
    axes[columns].imshow(colours)
    axes[columns].set_title("normals (red x right, green y down, blue z forward)", fontsize=9)
    rest = [axis for i, axis in enumerate(axes) if i not in (0, columns)]
    shown = zip(rest, patches.levels, patches.labels, strict=False)
    for level, (axis, of_level, labels) in enumerate(shown, 1):
        axis.imshow(patch_colours(colours, labels))
        axis.set_title(f"level {level}: {len(of_level)} patches", fontsize=10)
    buffer = BytesIO()
    figure.savefig(buffer, dpi=110, format="png", metadata={"Software": None})
    write_whole(path, buffer.getvalue())


def _draw_depth(figure: Any, axis: Any, frame: DepthFrame, model: Model) -> None:
    from matplotlib import colormaps

    p = model.parameters.depth
    used = (frame.depth >= p.minimum_depth) & (frame.depth <= p.maximum_depth)
    colours = colormaps["turbo"].with_extremes(bad=(UNKNOWN / 255,) * 3)
    image = axis.imshow(np.ma.masked_where(~used, frame.depth), cmap=colours)
    axis.set_title(f"depth, {used.mean():.0%} of {frame.depth.size} samples used", fontsize=10)
    figure.colorbar(image, ax=axis, label="metres", shrink=0.8)


#: Of the query and of the match in overlays.
QUERY_COLOUR, MATCH_COLOUR = "#d9772b", "#2b6cb0"


def save_overlay(
    query: Surface, match: Surface, T_match_query: Floats, title: str, path: Path
) -> None:
    """Two frames before and after the transform, from above and from the side, in a PNG.

    Parameters
    ----------
    query, match : points in their own cameras, metres
    T_match_query : (4, 4) query coordinates to the match's
    title : over the picture
    path : of the PNG; its folder must exist
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    of_query = query.points[query.valid].astype(np.float64)
    of_match = match.points[match.valid].astype(np.float64)
    figure = Figure(figsize=(11, 8.4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12)
    axes: Any = figure.subplots(2, 2)
    aligned = moved(T_match_query, of_query)
    everything = np.concatenate([of_match, of_query, aligned])
    low, high = np.percentile(everything, (1, 99), axis=0)  # a few stray points lie far out
    for row, (view, x, y) in enumerate((("above", 0, 2), ("the side", 2, 1))):
        for axis, name, points in zip(
            axes[row], ("before", "after"), (of_query, aligned), strict=True
        ):
            for drawn, colour in ((of_match, MATCH_COLOUR), (points, QUERY_COLOUR)):
                axis.scatter(drawn[:, x], drawn[:, y], s=0.8, c=colour, alpha=0.5, linewidths=0)
            axis.set(
                aspect="equal",
                xlim=(low[x] - 0.2, high[x] + 0.2),
                ylim=(low[y] - 0.2, high[y] + 0.2),
                xlabel=f"{'xyz'[x]}, m",
                ylabel=f"{'xyz'[y]}, m",
            )
            axis.set_title(f"{name} alignment, from {view}", fontsize=10)
            if view == "the side":
                axis.invert_yaxis()  # y points down
    handles = [
        axes[0, 0].scatter([], [], c=colour, label=label)
        for label, colour in (("query", QUERY_COLOUR), ("match", MATCH_COLOUR))
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    buffer = BytesIO()
    figure.savefig(buffer, dpi=110, format="png", metadata={"Software": None})
    write_whole(path, buffer.getvalue())
