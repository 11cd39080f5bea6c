"""Tests of exact search against a simple loop, with and without filters."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneprint.index.index_version import (
    Tail,
    search,
    signatures_of,
)

LENGTH = 256
search_l2 = partial(search, metric="l2")


def answer(hits):
    return hits.keys.tolist(), hits.distances.tolist()


def frames_of(keys, signatures):
    return dict(zip(keys.tolist(), signatures, strict=True))


@settings(max_examples=60)
@given(
    n=st.integers(0, 12),
    size=st.integers(0, 14),
    seed=st.integers(0, 99),
    dead=st.sets(st.integers(0, 12)),
    metric=st.sampled_from(["l1", "l2"]),
)
def test_a_tail_alone(n, size, seed, dead, metric):
    rng = np.random.default_rng(seed)
    keys, signatures = rng.permutation(n).astype(np.int64), rng.integers(0, 4, (n, 3), np.uint8)
    query = rng.integers(0, 4, 3, np.uint8)
    hits = search(query, None, Tail(keys, signatures), size, metric=metric, dead=frozenset(dead))
    power = {"l1": 1, "l2": 2}[metric]
    alive = {k: x for k, x in frames_of(keys, signatures).items() if k not in dead}
    right = sorted(
        (int((np.abs(x.astype(int) - query) ** power).sum()), k) for k, x in alive.items()
    )
    assert answer(hits) == ([k for _, k in right[:size]], [d for d, _ in right[:size]])
    assert (hits.exact, hits.compared) == (True, len(alive))


def test_distances_that_floats_cannot_hold_are_exact(published, nearest):
    """Above 2^24 FAISS rounds: neighbours that differ by one would be equal."""
    signatures = np.full((40, 512), 255, np.uint8)
    for i in range(40):
        signatures[i, : 40 - i] = 254
    keys, query = np.arange(40, dtype=np.int64), np.zeros(512, np.uint8)
    version = published(keys, signatures)
    for size in (1, 3, 40):
        hits = search_l2(query, version, Tail.empty(512), size)
        assert hits.distances[0] > 1 << 24
        assert answer(hits) == nearest(query, frames_of(keys, signatures), size)


def test_an_empty_map(published, walk):
    query = walk(1)[0]
    for version in (None, published(np.arange(0), walk(0), published(np.arange(3), walk(3)),
                                       drop=frozenset({0, 1, 2}))):  # fmt: skip
        hits = search_l2(query, version, Tail.empty(LENGTH), 5)
        assert answer(hits) == ([], [])
        assert (hits.exact, hits.compared) == (True, 0)


def test_signatures_of_hits(published, walk):
    signatures = walk(60)
    version = published(
        np.arange(20, 50), signatures[20:50], published(np.arange(20), signatures[:20])
    )
    tail = Tail(np.array([55, 3]), signatures[[55, 54]])
    wanted = np.array([55, 49, 3, 0, 20, 49])
    np.testing.assert_array_equal(
        signatures_of(wanted, version, tail), signatures[[55, 49, 54, 0, 20, 49]]
    )
    np.testing.assert_array_equal(signatures_of(wanted[[2, 0]], None, tail), signatures[[54, 55]])
    assert signatures_of(wanted[:0], None, tail).shape == (0, LENGTH)
    for where in (version, None):
        with pytest.raises(ValueError, match=r"no frames \[50, 51\]"):
            signatures_of(np.array([3, 50, 51]), where, tail)


def test_mistakes_are_refused(published, walk):
    signatures = walk(10)
    version, empty = published(np.arange(10), signatures), Tail.empty(LENGTH)
    query = signatures[0]
    for wrong in (query[None], query.astype(np.int16)):
        with pytest.raises(ValueError, match="for a query"):
            search_l2(wrong, version, empty, 1)
    with pytest.raises(ValueError, match="-1 for a query"):
        search_l2(query, version, empty, -1)
    with pytest.raises(ValueError, match=r"\[255, 256\] bytes where 256"):
        search_l2(query, version, Tail.empty(255), 1)
    with pytest.raises(ValueError, match=r"\[256\] bytes where 255"):
        search_l2(query[1:], version, empty, 1)
    with pytest.raises(ValueError, match=r"\[255, 256\]"):
        signatures_of(np.array([1]), version, Tail.empty(255))
    with pytest.raises(ValueError, match=r"\[4\] occur twice"):
        Tail(np.array([4, 3, 4]), signatures[:3])
    with pytest.raises(ValueError, match="keys"):
        Tail(np.arange(3), signatures[:2])
