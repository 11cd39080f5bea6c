"""Tests of R and C, for both computations of the distances within R."""

import numpy as np

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
