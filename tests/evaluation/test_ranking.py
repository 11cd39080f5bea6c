"""Tests of R and C, for both computations of the distances within R."""

import numpy as np
import pytest

from sceneprint_lab.evaluation import judgement
from sceneprint_lab.evaluation.judgement import rank


def test_by_hand():
    queries = np.array([[10, 10]], np.uint8)
    database = np.array([[10, 16], [10, 11], [12, 12], [14, 13], [10, 11]], np.uint8)
    allowed = np.array([[True, True, True, True, False]])
    (found,) = rank(queries, database, allowed, metric="l1", candidates=2)
    assert found.ranking == [1, 2, 0, 3]
    assert found.distances.tolist() == [1, 4, 6, 7]
    assert found.selection[0] == 1
    assert len(found.selection) == 2
    (found,) = rank(queries, database, allowed, metric="l2", candidates=2)
    assert found.ranking == [1, 2, 3, 0]
    assert found.distances.tolist() == [1, 8, 25, 36]
    assert set(found.milliseconds) == {"rank", "compare_ranking", "diversify"}


def test_a_query_that_may_find_nothing():
    one = np.zeros((1, 4), np.uint8)
    (found,) = rank(one, one, np.zeros((1, 1), bool), metric="l1")
    assert (found.ranking, found.selection) == ([], [])


@pytest.mark.parametrize("metric", ["l1", "l2"])
def test_both_ways_to_compare_give_the_same(metric, monkeypatch):
    rng = np.random.default_rng(3)
    database = rng.integers(0, 255, (150, 64), dtype=np.uint8)
    queries = rng.integers(0, 255, (12, 64), dtype=np.uint8)
    allowed = rng.random((12, 150)) < 0.8
    whole = rank(queries, database, allowed, metric=metric)
    monkeypatch.setattr(judgement, "TIMED", 99)
    each = rank(queries, database, allowed, metric=metric)
    assert [one.selection for one in whole] == [one.selection for one in each]
    for i, one in enumerate(each):
        assert allowed[i, one.ranking].all()
        assert (np.diff(one.distances) >= 0).all()
        assert set(one.selection) <= set(one.ranking)
