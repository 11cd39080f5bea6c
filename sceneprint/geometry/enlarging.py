"""A depth image with more pixels, for what reads the nearest one: steps become slopes again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats32, Frame

#: Samples within this share of the nearest lie on one surface.
SAME_SURFACE = 0.05


@kernel
def _doubled(depth: Floats32, same_surface: float) -> Floats32:
    height, width = depth.shape
    large = np.zeros((2 * height, 2 * width), np.float32)
    for y in range(2 * height):
        v = max(min((y + 0.5) / 2 - 0.5, height - 1.0), 0.0)
        y0 = min(int(v), max(height - 2, 0))
        for x in range(2 * width):
            own = depth[y // 2, x // 2]
            large[y, x] = own
            if not own > 0 or height < 2 or width < 2:
                continue
            u = max(min((x + 0.5) / 2 - 0.5, width - 1.0), 0.0)
            x0 = min(int(u), width - 2)
            a, b = depth[y0, x0], depth[y0, x0 + 1]
            c, d = depth[y0 + 1, x0], depth[y0 + 1, x0 + 1]
            least, most = min(a, b, c, d), max(a, b, c, d)
            if not (least > 0 and most - least <= same_surface * least):
                continue  # nothing is invented between an edge and its background
            s, t = u - x0, v - y0
            # a plane is linear in inverse depth
            inverse = (1 - t) * ((1 - s) / a + s / b) + t * ((1 - s) / c + s / d)
            large[y, x] = np.float32(1.0 / inverse)
    return large


def doubled(frame: Frame) -> Frame:
    """A frame of twice the width and height, interpolated where it sees one surface.

    Parameters
    ----------
    frame : depth (H, W) in metres, 0 where missing

    Returns
    -------
    the same view, (2 H, 2 W)
    """
    k = frame.intrinsics
    camera = replace(
        k, width=2 * k.width, height=2 * k.height, fx=2 * k.fx, fy=2 * k.fy,
        cx=2 * k.cx + 0.5, cy=2 * k.cy + 0.5,
    )  # fmt: skip
    depth = np.ascontiguousarray(frame.depth, np.float32)
    return replace(frame, depth=_doubled(depth, SAME_SURFACE), intrinsics=camera)
