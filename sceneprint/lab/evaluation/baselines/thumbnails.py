"""The depth image made small: what anyone would try first.

depth (H, W)  --thumbnail-->  (30, 40) inverse depth      two of them  -->  L1 or ZNCC
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np

from sceneprint.errors import UselessFrame
from sceneprint.types import AnyFrame, DepthFrame, Floats, Floats32

ROWS, COLUMNS = 30, 40

Comparison = Literal["l1", "zncc"]


def thumbnail(depth: Floats32, rows: int = ROWS, columns: int = COLUMNS) -> Floats32:
    """Mean inverse depth of the samples in each cell of a grid over the image.

    Parameters
    ----------
    depth : (H, W) metres; 0 where missing
    rows, columns : of the grid

    Returns
    -------
    (rows, columns) float32, 1/metres; 0 where a cell has no sample
    """
    height, width = depth.shape
    y, x = np.nonzero(depth > 0)
    cell = (y * rows // height) * columns + x * columns // width
    inverse = 1.0 / depth[y, x].astype(np.float64)
    total = np.bincount(cell, inverse, rows * columns)
    count = np.bincount(cell, minlength=rows * columns)
    mean: Floats32 = (total / np.maximum(count, 1)).astype(np.float32)
    return mean.reshape(rows, columns)


class Thumbnails:
    """Small inverse depth images, by mean absolute difference or by correlation.

    Parameters
    ----------
    comparison : "l1": mean absolute difference over cells that both have filled, or "zncc":
        1 - zero-mean normalised cross-correlation, empty cells at the mean
    """

    def __init__(self, comparison: Comparison) -> None:
        self.comparison = comparison
        self.name = f"thumbnail_{comparison}"

    def takes(self, frame: AnyFrame) -> bool:
        """Whether the baseline is made for such a frame."""
        return isinstance(frame, DepthFrame)

    def read(self, frame: AnyFrame) -> Floats32:
        """The thumbnail of a depth image."""
        if not isinstance(frame, DepthFrame):
            raise UselessFrame(f"{frame.name}: A thumbnail is of a depth image. Send one.")
        return thumbnail(frame.depth)

    def check(self) -> None:
        """Nothing is needed."""

    def learn(self, database: Iterable[Floats32], count: int, seed: int) -> None:
        """Nothing is learnt."""

    def finish(self, kept: Floats32) -> Floats32:
        """The thumbnail; for correlation at mean 0 and length 1."""
        if self.comparison == "l1":
            return kept
        filled = kept > 0
        mean = float(kept[filled].mean()) if filled.any() else 0.0
        centred = np.where(filled, kept - mean, 0.0)
        length = float(np.linalg.norm(centred))
        return (centred / length if length > 0 else centred).astype(np.float32)

    def distances(self, query: Floats32, database: Floats32) -> Floats:
        """Distance of one finished thumbnail to each of (N, rows, columns): (N,)."""
        own = query.reshape(-1).astype(np.float64)
        others = database.reshape(len(database), -1).astype(np.float64)
        if self.comparison == "zncc":
            correlation: Floats = 1.0 - others @ own
            return correlation
        both = (own > 0) & (others > 0)
        total = np.where(both, np.abs(others - own), 0.0).sum(axis=1)
        count = both.sum(axis=1)
        # nothing in common is as far as can be
        return np.where(count > 0, total / np.maximum(count, 1), np.inf)
