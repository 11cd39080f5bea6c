"""Tests of distances against a simple loop, and of rankings against a full sort."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneprint.geometry.retrieval.ranking import (
    cross_distances,
    distances,
    pairwise_distances,
    rank,
    ranking_size,
    similarity,
)

METRICS = ("l1", "l2")


def oracle(queries, database, metric="l1"):
    """(Q, N), each entry summed by Python's own integers."""
    differences = database.astype(np.int64)[None] - queries.astype(np.int64)[:, None]
    terms = np.abs(differences) if metric == "l1" else differences**2
    return [[sum(row.tolist()) for row in rows] for rows in terms]


def random_bytes(seed, *shape):
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("n", [0, 1, 33, 70_001])
def test_equals_the_oracle(n, metric):
    queries, database = random_bytes(n, 3, n), random_bytes(n + 1, 5, n)
    expected = oracle(queries, database, metric)
    assert cross_distances(queries, database, metric).tolist() == expected
    assert distances(queries[1], database, metric).tolist() == expected[1]


@pytest.mark.parametrize("metric", METRICS)
def test_among_each_other(metric):
    signatures = random_bytes(3, 20, 9001)
    found = pairwise_distances(signatures, metric)
    assert found.tolist() == oracle(signatures, signatures, metric)
    assert found.dtype == np.int64


@pytest.mark.parametrize("metric", METRICS)
def test_nothing_to_compare(metric):
    none, some = np.zeros((0, 8), np.uint8), np.zeros((3, 8), np.uint8)
    assert distances(some[0], none, metric).shape == (0,)
    assert distances(some[0], none, metric).dtype == np.int64
    assert cross_distances(none, some, metric).shape == (0, 3)
    assert cross_distances(some, none, metric).shape == (3, 0)
    assert pairwise_distances(none, metric).shape == (0, 0)
    assert pairwise_distances(some[:1], metric).tolist() == [[0]]


@pytest.mark.parametrize("metric", METRICS)
def test_some_rows_are_compared_where_they_are(metric):
    query, database = random_bytes(6, 1, 1000)[0], random_bytes(7, 50, 1000)
    database.flags.writeable = False
    whole = distances(query, database, metric)
    for rows in ([3, 4, 5, 6, 7, 8], [49, 0, 13, 13, 2], [49], []):
        wanted = np.array(rows, np.int64)
        found = distances(query, database, metric, wanted)
        assert found.tolist() == whole[wanted].tolist()
        assert found.dtype == np.int64
    # of any layout and width of integer
    assert distances(query, database, metric, np.arange(50)[::7]).tolist() == whole[::7].tolist()
    short = np.arange(50, dtype=np.int16)
    assert distances(query, database, metric, short).tolist() == whole.tolist()
    for rows in ([0, 50], [-1, 3], [2**40]):
        with pytest.raises(ValueError, match="the database has 50"):
            distances(query, database, metric, np.array(rows, np.int64))
    for strange in (np.array([0.0, 1.0]), np.array([[0, 1]]), np.array([True, False])):
        with pytest.raises(ValueError, match="integer indices"):
            distances(query, database, metric, strange)


def test_shapes_types_and_metric_must_be_right():
    for query, database in (((8,), (3, 9)), ((1, 8), (3, 8)), ((8,), (8,)), ((8,), (2, 8, 1))):
        with pytest.raises(ValueError, match=r"signatures have|query has shape"):
            distances(np.zeros(query, np.uint8), np.zeros(database, np.uint8), "l1")
    for queries, database in (((2, 8), (3, 9)), ((8,), (3, 8)), ((2, 8), (8,)), ((8,), (8,))):
        with pytest.raises(ValueError, match="signatures have"):
            cross_distances(np.zeros(queries, np.uint8), np.zeros(database, np.uint8), "l1")
    with pytest.raises(ValueError, match="signatures have"):
        pairwise_distances(np.zeros(8, np.uint8), "l1")
    one, many = np.zeros(8, np.uint8), np.zeros((3, 8), np.uint8)
    for dtype in (np.int8, np.float64, np.int64, np.bool_):
        with pytest.raises(ValueError, match="uint8 arrays"):
            distances(one.astype(dtype), many, "l1")
        with pytest.raises(ValueError, match="uint8 arrays"):
            distances(one, many.astype(dtype), "l1")
    with pytest.raises(ValueError, match="cosine"):
        distances(one, many, "cosine")


def full_sort(values, size):
    return sorted(range(len(values)), key=lambda i: (int(values[i]), i))[:size]


@settings(max_examples=200)
@given(values=st.lists(st.integers(0, 6), max_size=40), size=st.integers(0, 45))
def test_ranking_equals_a_full_sort(values, size):
    """Few values, hence many ties, also at the cut."""
    given_ = np.array(values, np.int64)
    found = rank(given_, size, 4.0)
    assert found.indices.tolist() == full_sort(given_, size)
    assert found.distances.tolist() == given_[found.indices].tolist()
    assert found.similarities.tolist() == [max(1 - d / 4, 0.0) for d in found.distances.tolist()]
    assert len(found) == min(size, len(values))
    assert (found.indices.dtype, found.distances.dtype) == (np.intp, np.int64)


def test_similarity_by_hand():
    found = similarity(np.array([0, 50, 200, 300]), 200.0)
    assert found.tolist() == [1.0, 0.75, 0.0, 0.0]


def test_wrong_rankings():
    values = np.arange(5)
    for d0 in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="unrelated"):
            similarity(values, d0)
        with pytest.raises(ValueError, match="unrelated"):
            rank(values, 3, d0)
    for wrong, size in ((values, -1), (values[None], 3), (values.astype(float), 3)):
        with pytest.raises(ValueError, match="distances"):
            rank(wrong, size, 1.0)


def test_size_of_a_ranking():
    sizes = {0: 0, 1: 1, 49: 49, 50: 50, 120: 50, 130: 52, 300: 120, 500: 200, 100_000: 200}
    assert {n: ranking_size(n) for n in sizes} == sizes
    with pytest.raises(ValueError, match="-1 frames"):
        ranking_size(-1)
