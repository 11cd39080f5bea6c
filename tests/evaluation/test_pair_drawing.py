"""Tests of the sampling of pairs from given overlaps."""

from dataclasses import replace

import numpy as np

from sceneprint_lab.evaluation.pair_run import BINS, Drawing, FrameOrigin, draw, inside
from sceneprint_lab.evaluation.protocol import Overlaps

ALL = Drawing(pairs=1000, negatives=0, apart=1)
NO_PLANES = np.zeros(100, bool)


def places(scene, n, run="run"):
    return [FrameOrigin(scene, f"{scene}/{run}", i) for i in range(n)]


def of_matrix(least, mean=None):
    both = np.maximum(least, least.T)
    return Overlaps(both if mean is None else np.maximum(mean, mean.T), both)


def couples(drawn, name):
    return {(one.query, one.match) for one in drawn if one.bin == name}


def test_the_edges_of_the_bins():
    assert BINS == ("10-30", "30-50", "50-70", "70-100")
    overlap = np.array([0.0, 0.099, 0.1, 0.299, 0.3, 0.5, 0.7, 1.0])
    found = {name: np.flatnonzero(inside(overlap, name)).tolist() for name in BINS}
    assert found == {"10-30": [2, 3], "30-50": [4], "50-70": [5], "70-100": [6, 7]}


def test_every_pair_has_its_bin_and_the_later_frame_asks():
    least = np.zeros((5, 5))
    least[1, 0], least[2, 0], least[2, 1], least[3, 0], least[3, 1] = 0.2, 0.4, 0.6, 1.0, 0.05
    mean = least.copy()
    mean[4, 0] = 0.02  # one direction sees something
    drawn = draw(places("a", 5), of_matrix(least, mean), NO_PLANES[:5], ALL)
    assert couples(drawn, "10-30") == {(1, 0)}
    assert couples(drawn, "30-50") == {(2, 0)}
    assert couples(drawn, "50-70") == {(2, 1)}
    assert couples(drawn, "70-100") == {(3, 0)}
    assert couples(drawn, None) == {(3, 2), (4, 1), (4, 2), (4, 3)}  # (3, 1) is neither
    assert {one.kind for one in drawn if one.bin is None} == {"same_scene"}
    assert {one.overlap_least for one in drawn if one.bin == "50-70"} == {0.6}


def test_neighbours_of_one_sequence_are_left_out():
    four = [*places("a", 3), *places("a", 3, "other")]
    drawn = draw(four, of_matrix(np.full((6, 6), 0.8)), NO_PLANES[:6], replace(ALL, apart=2))
    within = {(2, 0), (5, 3)}
    between = {(i, j) for i in (3, 4, 5) for j in (0, 1, 2)}  # two runs have no neighbours
    assert couples(drawn, "70-100") == within | between
