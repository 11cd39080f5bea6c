"""The overlay: both frames are drawn, and alignment brings one onto the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from sceneprint.pictures import MATCH_COLOUR, QUERY_COLOUR, save_overlay
from sceneprint.types import Intrinsics, Surface


def wall(shift: float) -> Surface:
    y, x = np.mgrid[-1:1:40j, -1:1:40j]
    points = np.stack([x + shift, y, np.full_like(x, 2.0)], -1).astype(np.float32)
    nothing = np.zeros((40, 40), np.float32)
    valid = np.ones((40, 40), np.bool_)
    return Surface(points, np.zeros_like(points), valid, nothing, Intrinsics(40, 40, 1, 1, 0, 0))


def near(picture: np.ndarray, colour: str) -> np.ndarray:
    """Columns of the pixels of about that colour."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return np.flatnonzero((np.abs(picture.astype(int) - wanted).max(axis=2) < 60).any(axis=0))


def test_an_overlay_shows_both_frames_apart_and_together(tmp_path: Path) -> None:
    T = np.eye(4)
    T[0, 3] = 5.0  # the query's wall is the match's, 5 m to the left
    save_overlay(wall(-5.0), wall(0.0), T, "a wall", tmp_path / "a.png")
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"))
    height, width = picture.shape[:2]
    above = picture[: height // 2]  # from above; the legend is below
    before, after = above[:, : width // 2], above[:, width // 2 :]
    query, match = near(before, QUERY_COLOUR), near(before, MATCH_COLOUR)
    assert query.max() < match.min()  # apart, the query to the left
    assert near(after, QUERY_COLOUR).size > 0
    middle = (match.min() + match.max()) / 2
    assert abs(near(after, QUERY_COLOUR).mean() - middle) < 0.1 * width  # where the match is
