"""Tests of the sketches of a large map: exact parts, and measured recall."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from sceneprint.index import sketches
from sceneprint.index.index_version import Tail, newest, search
from sceneprint.index.sketches import LEAST_SELECTED, draw, make_sketches, neighbours

LENGTH = 64
EMPTY = Tail.empty(LENGTH)
search_l2 = partial(search, metric="l2")


def only(version):
    (results,) = version.segments
    return results


def sketches_of(version):
    results = only(version).sketches
    assert results is not None
    return results


def codes_of(own):
    return np.stack([own.index.reconstruct(row) for row in range(len(own))])


def differing_bits(query, vectors, means):
    """The oracle: bits in which sketches differ, one by one."""
    return [int(((row > means) != (query > means)).sum()) for row in vectors]


def test_a_map_that_is_large_has_sketches(walk, published, nearest, tmp_path):
    signatures = walk(3000, LENGTH, walks=20)
    keys = np.arange(3000) * 2
    flat = published(keys, signatures, flat_bytes=3000 * LENGTH)
    assert only(flat).sketches is None
    recall = flat.manifest.recall
    assert (recall.share, recall.sample, recall.probes) == (1, 0, 0)
    written = published(keys, signatures, flat_bytes=3000 * LENGTH - 1)
    opened = newest(tmp_path / "map", "model", LENGTH)
    assert opened is not None
    frames = dict(zip(keys.tolist(), signatures, strict=True))
    query = walk(31, LENGTH, seed=8)[30]
    for version in (written, opened):
        own = sketches_of(version)
        assert (len(own), own.probes) == (3000, version.manifest.recall.probes)
        np.testing.assert_array_equal(own.means, signatures.mean(axis=0).astype(np.uint8))
        bits = differing_bits(query, signatures, own.means)
        assert [bits[row] for row in own.nearest(query, 400)] == sorted(bits)[:400]
        hits = search_l2(query, version, EMPTY, 10)
        assert not hits.exact
        assert LEAST_SELECTED <= hits.compared < 1500
        assert (hits.keys.tolist(), hits.distances.tolist()) == nearest(query, frames, 10)
        whole = search_l2(query, version, EMPTY, 10, exact=True)
        assert (whole.keys.tolist(), whole.distances.tolist()) == nearest(query, frames, 10)
        assert (whole.exact, whole.compared) == (True, 3000)


def test_nothing_of_a_deleted_frame_is_in_sketches(walk, published):
    signatures = walk(50, LENGTH, walks=5)
    signatures[7] = 255  # it moves every mean
    before = published(np.arange(50), signatures, flat_bytes=0)
    none = np.empty(0, np.int64), np.empty((0, LENGTH), np.uint8)
    after = published(*none, previous=before, drop=frozenset([7]), flat_bytes=0)
    assert only(after).record.file("sketches") == only(before).record.file("sketches")
    after = published(*none, previous=after, flat_bytes=0, clean=True)
    left, alone = sketches_of(after), make_sketches(np.delete(signatures, 7, axis=0))
    np.testing.assert_array_equal(left.means, alone.means)
    np.testing.assert_array_equal(codes_of(left), codes_of(alone))
    assert (left.means < sketches_of(before).means).any()


def test_recall_is_what_searches_find(walk, published, monkeypatch):
    for name, value in (("LEAST_SELECTED", 10), ("TIMES_WANTED", 1), ("ENOUGH", 0.5)):
        monkeypatch.setattr(sketches, name, value)  # so that some are missed
    signatures = walk(4000, LENGTH, walks=30)
    version = published(np.arange(4000), signatures, flat_bytes=0)
    recall, actual = version.manifest.recall, 0
    assert (recall.near, recall.sample, recall.frames) == (10, sketches.MOST, 4000)
    for row in draw(4000, recall.sample, 0).tolist():
        itself = frozenset([row])
        right = search_l2(signatures[row], version, EMPTY, 10, dead=itself, exact=True)
        hits = search_l2(signatures[row], version, EMPTY, 10, dead=itself)
        actual += int((hits.distances <= right.distances[-1]).sum())
    assert recall.share == pytest.approx(actual / (10 * recall.sample))
    assert 0.5 <= recall.share < 1


def test_more_is_compared_until_almost_all_is_found(published):
    """Sketches of noise say little: 256 of 3000 rows hold less than half of the nearest."""
    noise = np.random.default_rng(8).integers(0, 256, (3000, LENGTH), np.uint8)
    recall = published(np.arange(3000), noise, flat_bytes=0).manifest.recall
    assert recall.share >= 0.995
    assert recall.probes in (1024, 2048, 4096)


def test_as_many_come_back_as_there_are(walk, published, nearest):
    signatures, keys = walk(2000, LENGTH, walks=10), np.arange(2000)
    version = published(keys, signatures, flat_bytes=0)
    query = signatures[1234]
    near = search_l2(query, version, EMPTY, 900, exact=True).keys
    dead = frozenset(near.tolist())
    hits = search_l2(query, version, EMPTY, 300, dead=dead)
    assert len(hits) == 300
    assert not dead & set(hits.keys.tolist())
    assert len(search_l2(query, version, EMPTY, 5000, dead=dead)) == 1100
    # few among many are compared one by one
    among = np.sort(near[-100:])
    few = search_l2(query, version, EMPTY, 10, among=among)
    assert (few.exact, few.compared) == (True, 100)
    frames = {int(k): signatures[k] for k in among}
    assert (few.keys.tolist(), few.distances.tolist()) == nearest(query, frames, 10)


def test_sketches_by_hand():
    vectors = np.array([[0, 0, 9], [9, 9, 9], [0, 8, 0], [9, 9, 0]], np.uint8)
    own = make_sketches(vectors)
    assert own.means.tolist() == [4, 6, 4]
    assert codes_of(own).tolist() == [[0b100], [0b111], [0b010], [0b011]]
    own = replace(own, probes=1)
    query = np.array([5, 9, 4], np.uint8)  # 0b011: 3, 1, 1 and 0 bits are others
    assert own.nearest(query, 4).tolist()[::3] == [3, 0]
    assert own.candidates(query, 0, None).tolist() == [3]
    assert replace(own, probes=3).candidates(query, 0, None).tolist() == [1, 2, 3]
    assert own.candidates(query, 1, None).tolist() == [0, 1, 2, 3]  # four times as many
    free = np.array([True, True, False, False])
    assert own.candidates(query, 0, free).tolist() == [1]
    assert own.candidates(query, 9, free).tolist() == [0, 1]
    assert own.candidates(query, 9, ~free & False).tolist() == []


@pytest.mark.parametrize("most", [1, 20, 299, 400])
def test_neighbours_are_the_nearest_by_exact_distance(walk, monkeypatch, most):
    signatures, chosen = walk(300, LENGTH, walks=3), np.array([0, 6, 7, 150, 299])
    for block in (7 * LENGTH, 1 << 20):
        monkeypatch.setattr(sketches, "BLOCK_BYTES", block)
        actual = list(neighbours(signatures, chosen, most))
        assert [row for row, _ in actual] == chosen.tolist()
        for row, others in actual:
            exact = ((signatures.astype(int) - signatures[row]) ** 2).sum(axis=1)
            assert len(set(others.tolist())) == len(others) == min(most, 299)
            assert row not in others
            right = np.sort(np.delete(exact, row))[:most]
            assert np.sort(exact[others]).tolist() == right.tolist()


def test_one_frame_and_equal_frames_have_lists_too(published, tmp_path):
    for n in (1, 2, 50):
        same = np.full((n, LENGTH), 7, np.uint8)
        version = published(np.arange(n), same, folder=tmp_path / str(n), flat_bytes=0)
        hits = search_l2(same[0], version, EMPTY, 5)
        assert hits.keys.tolist() == list(range(min(n, 5)))
        assert version.manifest.recall.share == 1
