"""Tests of distances against a simple loop, and of rankings against a full sort."""

import mmap

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
    scan,
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
@pytest.mark.parametrize("n", [0, 1, 15, 17, 33, 63, 65, 200, 4161, 8193, 70_001])
def test_equals_the_oracle(n, metric):
    """Multiples of no width, and past a tile; more rows and queries than go together."""
    queries, database = random_bytes(n, 5, n), random_bytes(n + 1, 6, n)
    expected = oracle(queries, database, metric)
    assert cross_distances(queries, database, metric).tolist() == expected
    assert distances(queries[1], database, metric).tolist() == expected[1]


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("number", [0, 1, 2, 5, 9, 33])
def test_among_each_other(metric, number):
    signatures = random_bytes(number, number, 130)
    actual = pairwise_distances(signatures, metric)
    assert actual.tolist() == oracle(signatures, signatures, metric)
    assert actual.dtype == np.int64


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
        actual = distances(query, database, metric, wanted)
        assert actual.tolist() == whole[wanted].tolist()
        assert actual.dtype == np.int64
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
    one, many = np.zeros(8, np.uint8), np.zeros((3, 8), np.uint8)
    for query, message in (
        (one[:7], "signatures have"), (many, "query has shape"), (one.astype(float), "uint8 arrays")
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            distances(query, many, "l1")
    with pytest.raises(ValueError, match="cosine"):
        distances(one, many, "cosine")


def full_sort(values, size):
    return sorted(range(len(values)), key=lambda i: (int(values[i]), i))[:size]


@settings(max_examples=200)
@given(values=st.lists(st.integers(0, 6), max_size=40), size=st.integers(0, 45))
def test_ranking_equals_a_full_sort(values, size):
    """Few values, hence many ties, also at the cut."""
    given_ = np.array(values, np.int64)
    result = rank(given_, size, 4.0)
    assert result.indices.tolist() == full_sort(given_, size)
    assert result.distances.tolist() == given_[result.indices].tolist()
    assert result.similarities.tolist() == [max(1 - d / 4, 0.0) for d in result.distances.tolist()]
    assert len(result) == min(size, len(values))
    assert (result.indices.dtype, result.distances.dtype) == (np.intp, np.int64)


def test_size_of_a_ranking():
    sizes = {0: 0, 1: 1, 49: 49, 50: 50, 120: 50, 130: 52, 300: 120, 500: 200, 100_000: 200}
    assert {n: ranking_size(n) for n in sizes} == sizes
    with pytest.raises(ValueError, match="-1 frames"):
        ranking_size(-1)


def test_sums_beyond_32_bits():
    """The farthest there are, of a length at which even unsigned integers of 32 bits overflow."""
    n = 2**32 // 255 + 100
    database = np.vstack([np.zeros(n, np.uint8), np.full(n, 255, np.uint8)])
    rows = np.array([0, 1, 0, 1, 1])
    expected = [[0, n * 255, 0, n * 255, n * 255], [n * 255, 0, n * 255, 0, 0]]
    assert scan(database, database, rows).tolist() == expected
    assert scan(database[:1], database, rows).tolist() == expected[:1]


@pytest.mark.parametrize("offset", [1, 31])
def test_any_place_in_memory_and_in_a_mapped_file(offset, tmp_path):
    """Rows on no boundary, read-only; the last one ends where the file does."""
    n, rows = 4096 - 3, np.array([0, 1, 2, 3, 7, 5, 6])
    queries, database = random_bytes(1, 2, n), random_bytes(2, 8, n)
    expected = np.array(oracle(queries, database))[:, rows].tolist()
    path = tmp_path / "signatures"
    path.write_bytes(bytes(offset) + database.tobytes())
    with path.open("rb") as file:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    stored = np.frombuffer(mapped, np.uint8, offset=offset).reshape(8, n)
    assert not stored.flags.writeable
    memory = np.frombuffer(bytes(offset) + queries.tobytes(), np.uint8, offset=offset)
    sent = memory.reshape(2, n)
    assert scan(sent, stored, rows).tolist() == expected
    assert scan(sent[1:], stored, rows).tolist() == expected[1:]
