"""What the geometry sees of a frame, as a picture.

Frame  --panels-->  depth, normals, patches of each level  --save_picture-->  PNG
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.depth import inverse_depth
from sceneprint.geometry.normals import surface
from sceneprint.models import Model
from sceneprint.signing import describe
from sceneprint.types import Bytes, Floats32, Frame, Ints32
from sceneprint.writing import write_whole

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


def save_picture(frame: Frame, model: Model, path: Path) -> None:
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


def _draw_depth(figure: Any, axis: Any, frame: Frame, model: Model) -> None:
    from matplotlib import colormaps

    p = model.parameters.depth
    used = (frame.depth >= p.minimum_depth) & (frame.depth <= p.maximum_depth)
    colours = colormaps["turbo"].with_extremes(bad=(UNKNOWN / 255,) * 3)
    image = axis.imshow(np.ma.masked_where(~used, frame.depth), cmap=colours)
    axis.set_title(f"depth, {used.mean():.0%} of {frame.depth.size} samples used", fontsize=10)
    figure.colorbar(image, ax=axis, label="metres", shrink=0.8)
