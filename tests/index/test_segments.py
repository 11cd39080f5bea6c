"""Tests of segments: appending, merging, and exact search over all of them."""

import hashlib
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneprint.errors import DamagedIndex
from sceneprint.index.index_manifest import SegmentFiles
from sceneprint.index.index_version import Tail, newest, publish, search, signatures_of
from sceneprint.index.segment import GONE_SHARE, MOST_SEGMENTS, RATIO, merge_plan, open_segment

LENGTH = 24
NONE = np.empty(0, np.int64), np.empty((0, LENGTH), np.uint8)


def bits(n, seed):
    return np.random.default_rng(seed).integers(0, 2, (n, LENGTH), np.uint8)


def sizes(version):
    return [len(segment) for segment in version.segments]


def names(version):
    return {name for name, _ in version.manifest.files}


def written(before, after):
    """Bytes of the files that a version has and the one before has not."""
    known = set() if before is None else names(before)
    return sum(size for name, size in after.manifest.files if name not in known)


@given(st.lists(st.integers(1, 100_000), min_size=1, max_size=40))
def test_each_segment_is_thrice_as_large_as_the_next(given_sizes):
    groups = merge_plan(given_sizes)
    assert sorted(at for group in groups for at in group) == list(range(len(given_sizes)))
    totals = [sum(given_sizes[at] for at in group) for group in groups]
    assert 1 <= len(groups) <= MOST_SEGMENTS
    first = 1 if len(groups) == MOST_SEGMENTS else 0  # the smallest may be several
    assert all(b >= RATIO * a for a, b in zip(totals[first:], totals[first + 1 :], strict=False))


def test_merges_by_hand():
    assert merge_plan([100, 10]) == [[1], [0]]
    assert merge_plan([99, 33]) == [[1], [0]]
    assert merge_plan([98, 33]) == [[1, 0]]
    assert merge_plan([47, 10, 6]) == [[2, 1, 0]]  # what is merged may merge more
    assert merge_plan([3**i for i in range(10)]) == [[0, 1, 2], *([i] for i in range(3, 10))]


@settings(max_examples=40)
@given(data=st.data(), flat=st.sampled_from([0, 1 << 30]), seed=st.integers(0, 999))
def test_any_history_is_searched_as_one_map(tmp_path_factory, nearest, data, flat, seed):
    folder, rng = tmp_path_factory.mktemp("map"), np.random.default_rng(seed)
    frames = {}
    index = None
    for step in range(data.draw(st.integers(1, 7))):
        new = data.draw(st.sets(st.integers(0, 150), min_size=int(index is None), max_size=70))
        drop = data.draw(st.sets(st.integers(0, 150), max_size=12)) if index is not None else set()
        keys = rng.permutation(np.array(sorted(new), np.int64))
        own = rng.integers(0, 2, (len(keys), LENGTH), np.uint8)
        clean = data.draw(st.booleans())
        index = publish(
            folder, model_id="model", revision=step, blocks=[(keys, own)], previous=index,
            drop=frozenset(drop), clean=clean, flat_bytes=flat,
        )  # fmt: skip
        frames |= dict(zip(keys.tolist(), own, strict=True))
        frames = {key: row for key, row in frames.items() if key not in drop}
        assert not (clean and index.manifest.worn_keys)
        for segment in index.segments:
            assert len(segment.gone) <= GONE_SHARE * len(segment.keys)
    opened = newest(folder, "model", LENGTH)
    assert index is not None
    assert opened is not None
    tail_keys = np.array(sorted(data.draw(st.sets(st.integers(100, 200), max_size=9))), np.int64)
    tail = Tail(tail_keys, bits(len(tail_keys), seed + 1))
    dead = frozenset(data.draw(st.sets(st.integers(0, 200), max_size=30)))
    among = data.draw(st.none() | st.sets(st.integers(0, 220), max_size=120))
    given_keys = None if among is None else rng.permutation(np.array([*among], np.int64))
    everything = frames | dict(zip(tail_keys.tolist(), tail.signatures, strict=True))
    allowed = {
        key: row for key, row in everything.items()
        if key not in dead and (among is None or key in among)
    }  # fmt: skip
    query = bits(1, seed + 2)[0]
    for version in (index, opened):
        assert version.keys.tolist() == sorted(frames)
        assert (len(version), version.manifest.frames) == (len(frames), len(frames))
        candidates = np.arange(-3, 210)
        assert version.has(candidates).tolist() == [int(key) in frames for key in candidates]
        for size, exact in ((1, True), (10, flat == 0), (300, flat == 0)):
            hits = search(
                query, version, tail, size, metric="l2", dead=dead, among=given_keys, exact=exact
            )
            assert (hits.keys.tolist(), hits.distances.tolist()) == nearest(query, allowed, size)
            assert (hits.exact, hits.compared) == (True, len(allowed))
        held = np.array(list(everything), np.int64)
        np.testing.assert_array_equal(
            signatures_of(held, version, tail),
            np.reshape([everything[key] for key in held.tolist()], (-1, LENGTH)),
        )


def test_a_segment_of_which_too_much_is_gone_is_written_again(published):
    rows = bits(500, 2)
    version = published(np.arange(400), rows[:400])
    version = published(np.arange(400, 440), rows[400:440], version)
    before = version.segments
    version = published(*NONE, version, drop=frozenset(range(100)))  # a quarter
    assert [len(segment.keys) for segment in version.segments] == [400, 40]
    version = published(*NONE, version, drop=frozenset([100]))
    assert [len(segment.keys) for segment in version.segments] == [299, 40]
    assert version.segments[1] is before[1]
    version = published(*NONE, version, drop=frozenset(range(400, 440)))  # nothing stays of it
    assert [len(segment.keys) for segment in version.segments] == [299]


def test_cleaning_writes_only_segments_that_something_is_gone_of(walk, published, tmp_path):
    signatures = walk(207, LENGTH)
    version = published(np.arange(150), signatures[:150])
    for start, end in ((150, 190), (190, 203), (203, 207)):
        version = published(np.arange(start, end), signatures[start:end], version)
    version = published(*NONE, version, drop=frozenset([160]))
    assert sizes(version) == [150, 39, 13, 4]
    content = b"".join(path.read_bytes() for path in (tmp_path / "map").iterdir())
    assert signatures[160].tobytes() in content
    clean = published(*NONE, version, clean=True)
    content = b"".join(path.read_bytes() for path in (tmp_path / "map").iterdir())
    assert signatures[160].tobytes() not in content
    assert signatures[161].tobytes() in content
    assert [a is b for a, b in zip(version.segments, clean.segments, strict=True)] == [
        True, False, True, True,
    ]  # fmt: skip
    assert written(version, clean) < 40 * (LENGTH + 8) + 200
    assert clean.manifest.worn_keys == ()


def test_a_map_that_becomes_large_gets_sketches_for_what_it_has(walk, published, tmp_path):
    length = 64
    signatures = walk(3000, length, walks=20)
    flat = 2500 * length
    version = published(np.arange(2000), signatures[:2000], flat_bytes=flat)
    version = published(np.arange(2000, 2500), signatures[2000:2500], version, flat_bytes=flat)
    assert [segment.sketches for segment in version.segments] == [None, None]
    assert version.manifest.recall.sample == 0
    known = version.segments
    version = published(np.arange(2500, 2530), signatures[2500:2530], version, flat_bytes=flat)
    assert sizes(version) == [2000, 500, 30]
    assert [segment.sketches is None for segment in version.segments] == [False, False, True]
    for segment, before in zip(version.segments, known, strict=False):
        assert segment.record.file("faiss") == before.record.file("faiss")
        assert segment.record.recall.frames == len(segment)
    opened = newest(tmp_path / "map", "model", length)
    each = [segment.sketches.probes for segment in opened.segments if segment.sketches is not None]
    recall = opened.manifest.recall
    assert recall.probes == sum(each)
    assert recall.share == min(segment.record.recall.share for segment in opened.segments) < 1.001
    assert recall.sample == sum(segment.record.recall.sample for segment in opened.segments) > 0
    hits = search(signatures[2999], opened, Tail.empty(length), 10, metric="l2")
    assert not hits.exact
    assert 30 + 10 <= hits.compared < 2530
    less = published(*[part[:0] for part in (np.arange(0), signatures)], version,
                     drop=frozenset(range(2500, 2530)), flat_bytes=flat)  # fmt: skip
    assert [segment.sketches for segment in less.segments] == [None, None]
    assert less.manifest.recall.probes == 0


@pytest.fixture
def worn(walk, published, tmp_path):
    signatures = walk(40, LENGTH)
    first = published(np.arange(40), signatures)
    published(*NONE, first, drop=frozenset([7]))
    (path,) = (tmp_path / "map").glob("*.gone")
    assert path.read_bytes() == np.array([7], "<i8").tobytes()
    return tmp_path / "map", path


def test_a_list_of_what_is_gone_that_is_damaged_is_passed_over(worn):
    folder, path = worn
    actual = newest(folder, "model", LENGTH)
    assert (actual.number, len(actual)) == (2, 39)
    for data in (b"", bytes(7), bytes(8), path.read_bytes() + bytes(8), None):
        path.unlink()
        if data is not None:
            path.write_bytes(data)
        actual = newest(folder, "model", LENGTH)
        assert (actual.number, len(actual)) == (1, 40)  # readers know of the deletion themselves


@pytest.mark.parametrize(
    ("gone", "why"), [([7, 40], "not in the segment"), ([9, 7], "not in ascending order")]
)
def test_a_list_of_other_frames_is_refused(worn, gone, why):
    folder, _ = worn
    actual = newest(folder, "model", LENGTH)
    data = np.array(gone, "<i8").tobytes()
    name = f"{hashlib.sha256(data).hexdigest()}.gone"
    (folder / name).write_bytes(data)
    record = actual.segments[0].record
    other = SegmentFiles(files=(*record.files[:2], (name, len(data))), recall=record.recall)
    with pytest.raises(DamagedIndex, match=why):
        open_segment(folder, other, LENGTH)


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
        hits = search_l2(query, version, Tail.empty(256), 5)
        assert answer(hits) == ([], [])
        assert (hits.exact, hits.compared) == (True, 0)
