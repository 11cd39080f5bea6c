"""The inverted file of a very large map: exact where it says so, and what it misses is measured."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sceneprint.index import Generation, Tail, faiss_index, newest, search, segment
from sceneprint.index.faiss_index import Lists, centre_lists, grouped, train_lists
from sceneprint.index.generation_files import draw
from sceneprint.index.segment import Segment
from sceneprint.types import Bytes

Walk = Callable[..., Bytes]
Publish = Callable[..., Generation]
Nearest = Callable[..., tuple[list[int], list[int]]]
LENGTH = 64
EMPTY = Tail.empty(LENGTH)
search_l2 = partial(search, metric="l2")


def only(generation: Generation | None) -> Segment:
    """The segment of a generation that has one."""
    assert generation is not None
    (found,) = generation.segments
    return found


def lists_of(generation: Generation | None) -> Lists:
    found = only(generation).lists
    assert found is not None
    return found


def is_partition(generation: Generation) -> bool:
    """Whether each row is in the one list whose centroid is nearest."""
    own = lists_of(generation)
    assert sorted(own.rows.tolist()) == list(range(len(generation)))
    vectors = only(generation).vectors
    squares = ((vectors[:, None].astype(float) - own.centroids) ** 2).sum(axis=2)
    chosen = squares[np.arange(len(generation)), own.assignment()]
    np.testing.assert_allclose(chosen, squares.min(axis=1), rtol=1e-4, atol=0.5)
    return True


def test_a_map_that_is_too_large_has_lists(
    walk: Walk, published: Publish, nearest: Nearest, tmp_path: Path
) -> None:
    signatures = walk(3000, LENGTH, walks=20)
    keys = np.arange(3000) * 2
    flat = published(keys, signatures, flat_bytes=3000 * LENGTH)
    assert only(flat).lists is None
    recall = flat.manifest.recall
    assert (recall.share, recall.sample, recall.probes) == (1, 0, 0)
    made = published(keys, signatures, flat_bytes=3000 * LENGTH - 1)
    opened = newest(tmp_path / "map", "model", LENGTH)
    assert opened is not None
    frames = dict(zip(keys.tolist(), signatures, strict=True))
    for generation in (made, opened):
        assert is_partition(generation)
        own = lists_of(generation)
        assert (len(own), own.trained_on) == (round(4 * 3000**0.5), 3000)
        assert own.probes == generation.manifest.recall.probes >= 1
        assert own.probes & (own.probes - 1) == 0
        query = walk(31, LENGTH, seed=8)[30]
        hits = search_l2(query, generation, EMPTY, 10)
        assert not hits.exact
        assert 10 <= hits.compared < 3000
        assert all(
            int(((frames[k].astype(int) - query) ** 2).sum()) == d
            for k, d in zip(hits.keys.tolist(), hits.distances.tolist(), strict=True)
        )
        whole = search_l2(query, generation, EMPTY, 10, exact=True)
        assert (whole.keys.tolist(), whole.distances.tolist()) == nearest(query, frames, 10)
        assert (whole.exact, whole.compared) == (True, 3000)


def test_no_centroid_outlives_the_only_frame_of_its_list(walk: Walk, published: Publish) -> None:
    """Deleting is for good: nothing of it is left once its segment is written anew."""
    signatures = walk(500, LENGTH, walks=5)
    signatures[77] = 255 - signatures[77]  # far from all others
    made = published(np.arange(500), signatures, flat_bytes=0)
    alone = lists_of(made)
    assert (np.abs(alone.centroids - signatures[77]).max(axis=1) < 0.5).sum() == 1
    none = np.empty(0, np.int64), np.empty((0, LENGTH), np.uint8)
    after = published(*none, previous=made, drop=frozenset([77]), flat_bytes=0)
    assert only(after).record.file("lists") == only(made).record.file("lists")
    after = published(*none, previous=after, flat_bytes=0, clean=True)
    left = lists_of(after)
    assert len(after) == 499
    assert (np.abs(left.centroids - signatures[77]).max(axis=1) < 0.5).sum() == 0
    assert len(left) == len(alone) - 1


def test_recall_is_what_searches_find(walk: Walk, published: Publish) -> None:
    """By searches of the frames that were drawn, each without itself, against the exact scan."""
    signatures = walk(4000, LENGTH, walks=30)
    generation = published(np.arange(4000), signatures, flat_bytes=0)
    recall, found = generation.manifest.recall, 0
    assert (recall.near, recall.sample, recall.frames) == (10, faiss_index.MOST, 4000)
    for row in draw(4000, recall.sample, 0).tolist():
        itself = frozenset([row])
        right = search_l2(signatures[row], generation, EMPTY, 10, dead=itself, exact=True)
        hits = search_l2(signatures[row], generation, EMPTY, 10, dead=itself)
        found += int((hits.distances <= right.distances[-1]).sum())
    assert recall.share == pytest.approx(found / (10 * recall.sample))
    assert faiss_index.ENOUGH <= recall.share <= 1


def test_no_more_lists_are_probed_than_are_needed(
    walk: Walk, published: Publish, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    signatures = walk(4000, LENGTH, walks=30)
    probes = []
    for enough in (0.0, 0.9, 0.995, 1.0):
        monkeypatch.setattr(faiss_index, "ENOUGH", enough)
        folder = tmp_path / str(enough)
        recall = published(np.arange(4000), signatures, folder=folder, flat_bytes=0).manifest.recall
        assert recall.share >= enough
        probes.append(recall.probes)
    assert probes[0] == 1
    assert probes == sorted(probes)
    assert probes[-1] > 1


def test_what_queries_from_elsewhere_find(walk: Walk, published: Publish) -> None:
    """Places of the map with other noise: recall of the ten nearest."""
    signatures = walk(6000, LENGTH, walks=12)
    generation = published(np.arange(6000), signatures, flat_bytes=0)
    noise = np.random.default_rng(7).normal(0, 4, (60, LENGTH))
    kept = []
    for query in np.clip(signatures[70::100][:60] + noise, 0, 255).astype(np.uint8):
        right = search_l2(query, generation, EMPTY, 10, exact=True)
        found = search_l2(query, generation, EMPTY, 10)
        kept.append(np.isin(right.keys, found.keys).mean())
    assert np.mean(kept) >= 0.97


def test_as_many_come_back_as_there_are(walk: Walk, published: Publish, nearest: Nearest) -> None:
    """More lists are probed where those of a query have too few frames that may be found."""
    signatures, keys = walk(2000, LENGTH, walks=10), np.arange(2000)
    generation = published(keys, signatures, flat_bytes=0)
    query = signatures[1234]
    near = search_l2(query, generation, EMPTY, 900, exact=True).keys
    dead = frozenset(near.tolist())
    hits = search_l2(query, generation, EMPTY, 300, dead=dead)
    assert len(hits) == 300
    assert not dead & set(hits.keys.tolist())
    assert len(search_l2(query, generation, EMPTY, 5000, dead=dead)) == 1100
    # few among many are compared one by one
    among = np.sort(near[-100:])
    few = search_l2(query, generation, EMPTY, 10, among=among)
    assert (few.exact, few.compared) == (True, 100)
    frames = {int(k): signatures[k] for k in among}
    assert (few.keys.tolist(), few.distances.tolist()) == nearest(query, frames, 10)


def test_centroids_stay_until_the_map_has_doubled(
    walk: Walk, published: Publish, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    signatures = walk(1000, LENGTH, walks=10)
    made = published(np.arange(400), signatures[:400], flat_bytes=0)
    first = lists_of(made)
    monkeypatch.setattr(segment, "RATIO", 100)  # so that all is merged each time
    for start, end in ((400, 420), (420, 799)):
        made = published(
            np.arange(start, end), signatures[start:end], made, drop=frozenset([start]),
            flat_bytes=0,
        )  # fmt: skip
        own = lists_of(made)
        np.testing.assert_array_equal(own.centroids, first.centroids)
        assert own.trained_on == 400
        assert is_partition(made)
        # as long as the map has hardly grown, what was measured of it holds
        assert made.manifest.recall.frames == (400 if end == 420 else len(made))
        assert lists_of(newest(tmp_path / "map", "model", LENGTH)).probes == own.probes
    made = published(np.arange(799, 1000), signatures[799:], made, flat_bytes=0)
    assert lists_of(made).trained_on == len(made) == 998
    assert is_partition(made)
    again = published(np.arange(0), signatures[:0], made, flat_bytes=1 << 30)
    assert only(again).lists is None  # it is small enough


def test_nothing_of_a_frame_that_is_gone_is_in_a_centroid(walk: Walk, published: Publish) -> None:
    """A list of one frame has that frame for its mean."""
    signatures = walk(300, LENGTH, walks=300)
    made = published(np.arange(300), signatures, flat_bytes=0)
    made = published(np.arange(0), signatures[:0], made, drop=frozenset(range(0, 300, 3)),
                     flat_bytes=0)  # fmt: skip
    made = published(np.arange(0), signatures[:0], made, drop=frozenset([1]), clean=True,
                     flat_bytes=0)  # fmt: skip
    own = lists_of(made)
    assert sorted(own.rows.tolist()) == list(range(199))
    assert (np.diff(own.ends, prepend=0) > 0).all()
    for i, centroid in enumerate(own.centroids):
        members = only(made).vectors[own.assignment() == i]
        np.testing.assert_allclose(centroid, members.mean(axis=0), rtol=1e-5)


def test_lists_by_hand() -> None:
    vectors = np.array([[0, 0], [9, 9], [0, 2], [9, 7], [9, 8]], np.uint8)
    centroids = np.array([[0, 1], [50, 50], [9, 8]], np.float32)
    own = grouped(centroids, np.array([0, 2, 0, 2, 2], np.int32), 5)
    assert (own.rows.tolist(), own.ends.tolist()) == ([0, 2, 1, 3, 4], [2, 2, 5])
    assert own.assignment().tolist() == [0, 2, 0, 2, 2]
    assert own.nearest(np.array([8, 8], np.uint8), 2).tolist() == [2, 0]
    assert own.candidates(np.array([8, 8], np.uint8), 1, None).tolist() == [1, 3, 4]
    assert own.candidates(np.array([8, 8], np.uint8), 4, None).tolist() == [0, 1, 2, 3, 4]
    free = np.array([False, True, True, False, False])
    assert own.candidates(np.array([8, 8], np.uint8), 2, free).tolist() == [1, 2]
    centred = centre_lists(own, vectors)
    assert centred.centroids.tolist() == [[0, 1], [9, 8]]
    assert centred.assignment().tolist() == [0, 1, 0, 1, 1]


def test_the_same_signatures_and_seed_give_the_same_lists(walk: Walk) -> None:
    signatures = walk(500, LENGTH)
    first, again = train_lists(signatures, 3), train_lists(signatures.copy(), 3)
    np.testing.assert_array_equal(first.centroids, again.centroids)
    np.testing.assert_array_equal(first.rows, again.rows)
    one = train_lists(signatures[:1])
    assert (len(one), one.rows.tolist()) == (1, [0])


def test_one_frame_and_equal_frames_have_lists_too(published: Publish, tmp_path: Path) -> None:
    for n in (1, 2, 50):
        same = np.full((n, LENGTH), 7, np.uint8)
        made = published(np.arange(n), same, folder=tmp_path / str(n), flat_bytes=0)
        hits = search_l2(same[0], made, EMPTY, 5)
        assert hits.keys.tolist() == list(range(min(n, 5)))
        assert made.manifest.recall.share == 1


@pytest.mark.parametrize(("n", "limit"), [(5, 5), (5, 9), (100, 7), (1000, 999)])
def test_a_draw_is_one_of_each_stretch(n: int, limit: int) -> None:
    rows = draw(n, limit, 4)
    assert len(rows) == min(n, limit)
    assert (np.diff(rows) > 0).all()
    assert 0 <= rows[0] <= rows[-1] < n
    assert rows.tolist() == draw(n, limit, 4).tolist()
