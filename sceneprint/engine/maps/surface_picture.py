"""A surface seen from above as a picture: the darker the more of it stands upright there.

axes, box  --plan_frame-->  PlanFrame
PlanFrame, points  --surface_picture-->  PNG, transparent where nothing is
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sceneprint.types import Floats

#: Read on white and on black alike; how opaque a single cell is, and a wall.
_COLOUR, _OPACITIES = (122, 130, 143), (90.0, 255.0)
#: Percentile of the counts of pixels that is fully opaque.
_FULL = 97.0


@dataclass(frozen=True)
class PlanFrame:
    """Where a picture lies on a plan.

    Parameters
    ----------
    m_per_pixel : metres
    width, height : pixels
    left, top : of the upper left corner along the axes, metres
    """

    m_per_pixel: float
    width: int
    height: int
    left: float
    top: float


def plan_frame(
    axes: Floats, low: Sequence[float], high: Sequence[float], cell_m: float, longer: int
) -> PlanFrame:
    """Room for a box.

    Parameters
    ----------
    axes : (2, 3) to the right and to the top
    low, high : (3,) corners of the box, metres
    cell_m : no side is shorter
    longer : pixels of the longer side
    """
    ends = np.stack([low, high])
    corners = np.array([[ends[i, 0], ends[j, 1], ends[k, 2]]
                        for i in (0, 1) for j in (0, 1) for k in (0, 1)]) @ axes.T  # fmt: skip
    first, last = corners.min(axis=0), corners.max(axis=0)
    width, height = np.maximum(last - first, cell_m).tolist()
    pixel = max(width, height) / longer
    sizes = [min(max(math.ceil(side / pixel - 1e-9), 1), longer) for side in (width, height)]
    return PlanFrame(pixel, sizes[0], sizes[1], float(first[0]), float(last[1]))


def surface_picture(
    plan: PlanFrame, axes: Floats, points: Iterable[Floats], cell_m: float,
    heights: tuple[float | None, float | None],
) -> bytes:  # fmt: skip
    """A picture as a PNG.

    Parameters
    ----------
    plan : where it lies
    axes : (2, 3) of the plan
    points : (N, 3) of each tile, metres
    cell_m : width of their cells
    heights : only what lies between these, metres along up; None for no limit
    """
    from PIL import Image

    # no finer than the cells: there would be gaps between them
    step = max(plan.m_per_pixel, cell_m)
    columns, rows = (
        max(math.ceil(side * plan.m_per_pixel / step), 1) for side in (plan.width, plan.height)
    )
    counts = np.zeros((rows, columns))
    up = np.cross(axes[0], axes[1])
    for some in points:
        height = some @ up
        inside = np.ones(len(some), bool)
        if heights[0] is not None:
            inside &= height >= heights[0]
        if heights[1] is not None:
            inside &= height <= heights[1]
        flat = some[inside] @ axes.T
        x = np.floor((flat[:, 0] - plan.left) / step).astype(np.int64).clip(0, columns - 1)
        y = np.floor((plan.top - flat[:, 1]) / step).astype(np.int64).clip(0, rows - 1)
        np.add.at(counts, (y, x), 1.0)
    shown = counts > 0
    most = max(float(np.percentile(counts[shown], _FULL)), 2.0) if shown.any() else 2.0
    share = np.minimum(np.log2(1.0 + counts) / math.log2(1.0 + most), 1.0)
    picture = np.zeros((rows, columns, 4), np.uint8)
    picture[..., :3] = _COLOUR
    least, full = _OPACITIES
    picture[..., 3] = np.where(shown, np.rint(least + share * (full - least)), 0)
    large = Image.fromarray(picture)
    if (columns, rows) != (plan.width, plan.height):
        # the picture may reach a little beyond the plan at the right and at the bottom
        box = (0.0, 0.0, plan.width * plan.m_per_pixel / step,
               plan.height * plan.m_per_pixel / step)  # fmt: skip
        large = large.resize((plan.width, plan.height), Image.Resampling.NEAREST, box=box)
    buffer = io.BytesIO()
    large.save(buffer, "PNG")
    return buffer.getvalue()
