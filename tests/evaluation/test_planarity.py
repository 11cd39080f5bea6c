"""Tests of the fraction of the main plane of synthetic surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from sceneprint.types import Floats
from sceneprint_lab.evaluation.run import OFF_PLANE, plane_share


def sheet(n: int, seed: int, noise: float = 0.0) -> Floats:
    """n points of the plane z = 0, some metres wide."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-2, 2, (n, 2)), noise * rng.normal(size=n)])


def test_a_wall_is_all_plane_however_it_stands() -> None:
    wall = sheet(300, 0, noise=OFF_PLANE / 4)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    assert plane_share(wall) > 0.99
    assert plane_share(wall @ turn.T + [3, -1, 2]) > 0.99


def test_of_a_corner_the_greater_side_counts() -> None:
    side = sheet(100, 2)[:, [0, 2, 1]] + [0, 0, 2.0 + OFF_PLANE]
    assert plane_share(np.concatenate([sheet(300, 3), side])) == pytest.approx(0.75, abs=0.01)


def test_a_ball_is_no_plane() -> None:
    ball = np.random.default_rng(4).normal(size=(500, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    assert plane_share(ball) < 0.15  # the widest slab of 10 cm holds 5 %, a cap 2.5 %
    assert plane_share(ball, off=0.5) > 0.45


def test_the_same_each_time_and_nothing_of_nothing() -> None:
    some = np.random.default_rng(5).random((200, 3))
    assert plane_share(some) == plane_share(some.copy())
    assert plane_share(np.empty((0, 3))) == 0.0
    assert plane_share(np.ones((50, 3))) == 0.0  # one point, again and again
