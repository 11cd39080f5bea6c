"""Loading all code and tables before the first request asks for them."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from sceneprint.errors import FrameError
from sceneprint.pipeline import Signer, prepare, validate
from sceneprint.types import Frame, Intrinsics


def warm(signer: Signer) -> None:
    """Sign and validate a corner of a room, so that kernels are compiled or loaded.

    Parameters
    ----------
    signer : whose table is touched
    """
    with suppress(FrameError):  # a model of another range may see nothing there
        _, geometry = prepare(_corner(), signer)
        validate(geometry, geometry)


def _corner() -> Frame:
    """Two walls, a floor and a box, two metres away."""
    camera = Intrinsics(256, 192, 220, 220, 127.5, 95.5)
    y, x = np.mgrid[0:192, 0:256]
    right, down = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    walls = [2.4 / np.maximum(1 + 0.8 * right, 0.1), 2.4 / np.maximum(1 - 0.8 * right, 0.1)]
    floor = 1.2 / np.maximum(down, 1e-3)
    box = np.where((abs(right) < 0.2) & (down > 0.1), 1.5, np.inf)
    depth = np.minimum.reduce([*walls, floor, box]).astype(np.float32)
    return Frame(depth, camera)
