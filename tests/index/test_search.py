"""Search: exact where it says so, against a naive oracle; nearly so from a shortlist."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneprint.index import (
    SHORTLIST,
    Generation,
    Hits,
    Tail,
    is_compared,
    search,
    signatures_of,
)
from sceneprint.types import Bytes

Walk = Callable[..., Bytes]
Publish = Callable[..., Generation]
Nearest = Callable[..., tuple[list[int], list[int]]]
LENGTH = 256


def answer(hits: Hits) -> tuple[list[int], list[int]]:
    return hits.keys.tolist(), hits.distances.tolist()


def frames_of(keys: np.ndarray, signatures: Bytes) -> dict[int, Bytes]:
    return dict(zip(keys.tolist(), signatures, strict=True))


@pytest.fixture
def coarse_bytes() -> Callable[[int, int, int], Bytes]:
    """Signatures of 0 and 1 alone, so that many distances are equal."""

    def make(n: int, length: int, seed: int) -> Bytes:
        return np.random.default_rng(seed).integers(0, 2, (n, length), np.uint8)

    return make


@pytest.mark.parametrize("size", [0, 1, 7, 40, 400])
@pytest.mark.parametrize("exact", [False, True])
def test_a_map_in_parts_is_searched_as_one(
    coarse_bytes: Callable[[int, int, int], Bytes],
    published: Publish,
    nearest: Nearest,
    size: int,
    exact: bool,
) -> None:
    """Ties, deleted, replaced and doubled frames, three segments, and a tail."""
    signatures = coarse_bytes(200, 24, 1)
    keys = np.random.default_rng(2).permutation(1000)[:200].astype(np.int64)
    first = published(keys[:90], signatures[:90])
    second = published(keys[90:120], signatures[90:120], first, drop=frozenset(keys[:9].tolist()))
    replaced = coarse_bytes(10, 24, 3)
    third = published(keys[20:30], replaced, second)
    newer = coarse_bytes(5, 24, 4)
    tail = Tail(
        np.concatenate([keys[40:45], keys[120:]]), np.concatenate([newer, signatures[120:]])
    )
    dead = frozenset([*keys[60:70].tolist(), *keys[120:125].tolist(), 5000])
    frames = frames_of(keys, signatures)
    frames |= frames_of(keys[20:30], replaced) | frames_of(keys[40:45], newer)
    for gone in (*keys[:9].tolist(), *dead):
        frames.pop(gone, None)
    assert len(frames) == 200 - 9 - 15
    query = coarse_bytes(1, 24, 5)[0]
    hits = search(query, third, tail, size, dead=dead, exact=exact)
    assert answer(hits) == nearest(query, frames, size)
    assert (hits.exact, hits.compared, len(hits)) == (True, 176, min(size, 176))
    assert {hits.keys.dtype, hits.distances.dtype} == {np.dtype(np.int64)}


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(0, 12),
    size=st.integers(0, 14),
    seed=st.integers(0, 99),
    dead=st.sets(st.integers(0, 12)),
)
def test_a_tail_alone(nearest: Nearest, n: int, size: int, seed: int, dead: set[int]) -> None:
    rng = np.random.default_rng(seed)
    keys, signatures = rng.permutation(n).astype(np.int64), rng.integers(0, 4, (n, 3), np.uint8)
    query = rng.integers(0, 4, 3, np.uint8)
    hits = search(query, None, Tail(keys, signatures), size, dead=frozenset(dead))
    alive = {k: x for k, x in frames_of(keys, signatures).items() if k not in dead}
    assert answer(hits) == nearest(query, alive, size)
    assert (hits.exact, hits.compared) == (True, len(alive))


def test_an_empty_map(published: Publish, walk: Walk) -> None:
    query = walk(1)[0]
    for generation in (None, published(np.arange(0), walk(0), published(np.arange(3), walk(3)),
                                       drop=frozenset({0, 1, 2}))):  # fmt: skip
        hits = search(query, generation, Tail.empty(LENGTH), 5)
        assert answer(hits) == ([], [])
        assert (hits.exact, hits.compared) == (True, 0)


@pytest.mark.parametrize("readonly", [False, True])
def test_a_query_may_be_any_array_of_bytes(published: Publish, walk: Walk, readonly: bool) -> None:
    signatures = walk(50)
    generation = published(np.arange(50), signatures)
    query: Bytes = np.repeat(signatures[7], 2)[::2]
    query.flags.writeable = not readonly
    assert answer(search(query, generation, Tail.empty(LENGTH), 1)) == ([7], [0])


def test_a_shortlist_is_compared_exactly_and_says_so(
    published: Publish, walk: Walk, nearest: Nearest
) -> None:
    signatures = walk(400, walks=3)
    generation = published(np.arange(300), signatures[:300])
    tail = Tail(np.arange(300, 400), signatures[300:])
    query = walk(31, seed=8)[30]
    frames = frames_of(np.arange(400), signatures)
    hits = search(query, generation, tail, 10, shortlist=50)
    assert (hits.exact, hits.compared, len(hits)) == (False, 150, 10)
    oracle = {k: int(np.abs(x.astype(int) - query).sum()) for k, x in frames.items()}
    assert [oracle[k] for k in hits.keys.tolist()] == hits.distances.tolist()
    # no longer than the shortlist: whole; and a shortlist is never shorter than the answer
    whole = search(query, generation, tail, 10, shortlist=300)
    assert answer(whole) == nearest(query, frames, 10)
    assert (whole.exact, whole.compared) == (True, 400)
    longer = search(query, generation, tail, 120, shortlist=50)
    assert (longer.exact, longer.compared, len(longer)) == (False, 220, 120)
    asked = search(query, generation, tail, 10, shortlist=50, exact=True)
    assert (answer(asked), asked.exact) == (answer(whole), True)
    assert SHORTLIST == 500


def test_a_shortlist_is_full_however_many_are_gone(published: Publish, walk: Walk) -> None:
    """Deleted frames, and those in the tail, are passed over before the shortlist is cut."""
    signatures = walk(300)
    generation = published(np.arange(300) * 2, signatures)
    query = signatures[100]
    near = search(query, generation, Tail.empty(LENGTH), 80, exact=True).keys
    dead = frozenset(near[:60].tolist())
    tail = Tail(near[60:70], np.full((10, LENGTH), 255, np.uint8))  # signed again, now far away
    hits = search(query, generation, tail, 30, dead=dead, shortlist=40)
    assert (hits.exact, hits.compared, len(hits)) == (False, 50, 30)
    assert not dead & set(hits.keys.tolist())
    assert not set(near[60:70].tolist()) & set(hits.keys.tolist())
    assert len(np.unique(hits.keys)) == 30
    assert hits.keys[:5].tolist() == near[70:75].tolist()
    last = search(query, generation, tail, 240, dead=dead, shortlist=1)
    assert (last.exact, last.compared, len(last)) == (True, 240, 240)
    assert last.keys[-10:].tolist() == sorted(near[60:70].tolist())


def test_a_shortlist_finds_the_nearest_of_walks(published: Publish, walk: Walk) -> None:
    """Recall of the ten nearest of 6,000, at a sixth, a thirtieth and a hundredth of the map."""
    signatures, empty = walk(6000, 512, walks=12), Tail.empty(512)
    generation = published(np.arange(6000), signatures)
    # places that no walk of the map has been at, and places of the map with other noise
    noise = np.random.default_rng(7).normal(0, 4, (40, 512))
    again = np.clip(signatures[70::150] + noise, 0, 255).astype(np.uint8)
    queries = np.concatenate([walk(40, 512, seed=s)[-2:] for s in range(20)] + [again])
    right = [search(query, generation, empty, 10, exact=True) for query in queries]
    # the former are hard to tell apart: the tenth is hardly farther than the first
    assert np.median([hits.distances[9] / hits.distances[0] for hits in right[:40]]) < 1.15
    recalls = {}
    for shortlist in (1000, 200, 60):
        found = [search(query, generation, empty, 10, shortlist=shortlist) for query in queries]
        assert not any(hits.exact for hits in found)
        kept = [np.isin(a.keys, b.keys).mean() for a, b in zip(right, found, strict=True)]
        recalls[shortlist] = float(np.mean(kept))
    assert recalls[1000] >= 0.999
    assert recalls[200] >= 0.995
    assert recalls[60] >= 0.97


def test_a_code_of_a_growing_map_still_finds(published: Publish, walk: Walk) -> None:
    """Just before the refit half of the frames are of walks that the code has never seen."""
    signatures, empty = walk(3998, 512, walks=8), Tail.empty(512)
    first = published(np.arange(2000), signatures[:2000])
    second = published(np.arange(2000, 3998), signatures[2000:], first)
    assert second.code.id == first.code.id
    noise = np.random.default_rng(7).normal(0, 4, (40, 512))
    queries = np.clip(signatures[2010:3998:50] + noise, 0, 255).astype(np.uint8)
    kept = []
    for query in queries:
        right = search(query, second, empty, 10, exact=True)
        found = search(query, second, empty, 10, shortlist=200)
        kept.append(np.isin(right.keys, found.keys).mean())
    assert np.mean(kept) >= 0.99


def test_signatures_of_hits(published: Publish, walk: Walk) -> None:
    signatures = walk(60)
    generation = published(
        np.arange(20, 50), signatures[20:50], published(np.arange(20), signatures[:20])
    )
    tail = Tail(np.array([55, 3]), signatures[[55, 54]])
    wanted = np.array([55, 49, 3, 0, 20, 49])
    np.testing.assert_array_equal(
        signatures_of(wanted, generation, tail), signatures[[55, 49, 54, 0, 20, 49]]
    )
    np.testing.assert_array_equal(signatures_of(wanted[[2, 0]], None, tail), signatures[[54, 55]])
    assert signatures_of(wanted[:0], None, tail).shape == (0, LENGTH)
    for where in (generation, None):
        with pytest.raises(ValueError, match=r"no frames \[50, 51\]"):
            signatures_of(np.array([3, 50, 51]), where, tail)


def test_mistakes_are_refused(published: Publish, walk: Walk) -> None:
    signatures = walk(10)
    generation, empty = published(np.arange(10), signatures), Tail.empty(LENGTH)
    query = signatures[0]
    for wrong in (query[None], query.astype(np.int16)):
        with pytest.raises(ValueError, match="for a query"):
            search(wrong, generation, empty, 1)
    with pytest.raises(ValueError, match="-1 of 500"):
        search(query, generation, empty, -1)
    with pytest.raises(ValueError, match="1 of 0"):
        search(query, generation, empty, 1, shortlist=0)
    with pytest.raises(ValueError, match=r"\[255, 256\] bytes where 256"):
        search(query, generation, Tail.empty(255), 1)
    with pytest.raises(ValueError, match=r"\[256\] bytes where 255"):
        search(query[1:], generation, empty, 1)
    with pytest.raises(ValueError, match=r"\[255, 256\]"):
        signatures_of(np.array([1]), generation, Tail.empty(255))
    with pytest.raises(ValueError, match=r"\[4\] are there twice"):
        Tail(np.array([4, 3, 4]), signatures[:3])
    with pytest.raises(ValueError, match="keys"):
        Tail(np.arange(3), signatures[:2])


def test_what_is_compared_is_what_a_search_could_find(walk: Walk, published: Publish) -> None:
    """With a ranking as long as all that is compared, found and compared are the same frames."""
    signatures, keys = walk(400), np.arange(400, dtype=np.int64)
    generation = published(keys[:380], signatures[:380])
    tail = Tail(keys[376:], signatures[376:])  # four of them in both
    query, dead = walk(1, seed=3)[0], frozenset([5, 6, 379, 390])
    for among in (None, keys[::2]):
        how = {"dead": dead, "among": among, "shortlist": 40}
        hits = search(query, generation, tail, 1, **how)
        assert (hits.exact, hits.compared) == (False, 40 + (22 if among is None else 11))
        told = [key for key in range(410) if is_compared(query, generation, tail, 1, key, **how)]
        assert len(told) == hits.compared
        by_search = search(query, generation, Tail.empty(LENGTH), 40, **how).keys.tolist()
        of_tail = {k for k in range(376, 400) if k not in dead and (among is None or k % 2 == 0)}
        assert {*told} >= of_tail
        near = [k for k in told if k < 376]
        assert len(near) == 40
        assert {k for k in by_search if k < 376} <= {*near}
    assert is_compared(query, generation, tail, 1, 7, exact=True, shortlist=1)
    assert not is_compared(query, generation, tail, 1, 5, dead=dead, exact=True)
    assert not is_compared(query, None, tail, 1, 7)
