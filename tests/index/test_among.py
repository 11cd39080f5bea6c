"""Search among some frames only: as many come back as there are, by the same distances."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneprint.geometry import retrieval
from sceneprint.index import Generation, Hits, Tail, publish, search
from sceneprint.types import Bytes

Walk = Callable[..., Bytes]
Publish = Callable[..., Generation]
Nearest = Callable[..., tuple[list[int], list[int]]]
LENGTH = 256


def answer(hits: Hits) -> tuple[list[int], list[int]]:
    return hits.keys.tolist(), hits.distances.tolist()


def keys_of(*keys: int) -> np.ndarray:
    return np.array(keys, np.int64)


@pytest.fixture(scope="module")
def bits() -> Bytes:
    """Signatures of 0 and 1 alone, so that many distances are equal."""
    return np.random.default_rng(1).integers(0, 2, (200, 24), np.uint8)


@pytest.fixture(scope="module")
def shared(
    tmp_path_factory: pytest.TempPathFactory, bits: Bytes
) -> tuple[Generation, Tail, frozenset[int]]:
    """Two segments, a tail that replaces and adds, and deletions in both."""
    folder, previous = tmp_path_factory.mktemp("map"), None
    for some in (slice(0, 60), slice(60, 120)):
        previous = publish(
            folder, model_id="model", revision=0, previous=previous, drop=frozenset(),
            blocks=[(3 * np.arange(120, dtype=np.int64)[some], bits[some])],
        )  # fmt: skip
    assert previous is not None
    tail = Tail(np.array([3, 30, *range(360, 600, 3)], np.int64), bits[118:200])
    return previous, tail, frozenset([6, 9, 363, 5000])


@settings(max_examples=150, deadline=None)
@given(
    among=st.sets(st.integers(0, 640), max_size=120),
    size=st.integers(0, 130),
    exact=st.booleans(),
    shortlist=st.sampled_from([1, 20, 1000]),
)
def test_only_what_may_be_found_is(
    bits: Bytes, nearest: Nearest, shared: tuple[Generation, Tail, frozenset[int]],
    among: set[int], size: int, exact: bool, shortlist: int,
) -> None:  # fmt: skip
    """Keys that are in neither part, deleted, replaced or in the tail alone are among them."""
    generation, tail, dead = shared
    frames = {3 * i: bits[i] for i in range(120)}
    frames |= dict(zip(tail.keys.tolist(), tail.signatures, strict=True))
    allowed = {key: row for key, row in frames.items() if key in among - dead}
    query = bits[77]
    hits = search(
        query, generation, tail, size, dead=dead, among=keys_of(*among), exact=exact,
        shortlist=shortlist,
    )  # fmt: skip
    assert len(hits) == min(size, len(allowed))  # as many as there are, whatever was proposed
    assert set(hits.keys.tolist()) <= set(allowed)
    own = [int(np.abs(allowed[key].astype(int) - query).sum()) for key in hits.keys.tolist()]
    assert own == hits.distances.tolist()
    if hits.exact:
        assert answer(hits) == nearest(query, allowed, size)
        assert hits.compared == len(allowed)
    in_generation = sum(key < 360 and key not in tail.keys for key in allowed)
    assert hits.exact is (exact or in_generation <= max(shortlist, size))


def test_nothing_among_finds_nothing(shared: tuple[Generation, Tail, frozenset[int]]) -> None:
    generation, tail, dead = shared
    query = tail.signatures[0]
    for among in (keys_of(), keys_of(1, 2), keys_of(6, 363)):
        for part in (generation, None):
            hits = search(query, part, tail, 5, dead=dead, among=among)
            assert (answer(hits), hits.exact, hits.compared) == (([], []), True, 0)


def test_few_among_many_come_from_no_shortlist_of_all(published: Publish, walk: Walk) -> None:
    """The nearest 860 of all are others: filtering a shortlist afterwards would find none."""
    signatures = walk(900, walks=3)
    generation = published(np.arange(900), signatures)
    query = signatures[450]
    order = np.argsort(np.abs(signatures.astype(int) - query).sum(axis=1), kind="stable")
    far = np.sort(order[-40:])
    hits = search(query, generation, Tail.empty(LENGTH), 10, among=far, shortlist=20)
    assert len(hits) == 10
    assert set(hits.keys.tolist()) <= set(far.tolist())
    assert (hits.exact, hits.compared) == (False, 20)


def test_rows_that_may_not_be_found_are_not_read(
    shared: tuple[Generation, Tail, frozenset[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    generation, tail, dead = shared
    read: list[int] = []

    def counted(query: Bytes, stored: Bytes, rows: np.ndarray | None = None) -> np.ndarray:
        read.append(len(stored) if rows is None else len(rows))
        return retrieval.distances(query, stored, rows=rows)

    monkeypatch.setitem(search.__globals__, "distances", counted)
    hits = search(tail.signatures[0], generation, tail, 5, dead=dead, among=keys_of(12, 15, 369))
    assert sorted(hits.keys.tolist()) == [12, 15, 369]
    assert sum(read) == 3
