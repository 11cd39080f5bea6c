"""Tests of publication: appending, merging, removal, reopening, and concurrent readers."""

import threading
import time

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.atomic_files import folder_turn
from sceneprint.index.index_manifest import newest_number
from sceneprint.index.index_version import Tail, clear, newest, publish, search

LENGTH = 256


def holds(version, frames):
    """Whether a version holds these frames with these signatures, in the order of their keys."""
    keys = np.array(sorted(frames), np.int64)
    assert version.keys.tolist() == keys.tolist()
    assert len(version) == version.manifest.frames == len(keys)
    expected = np.array([frames[int(key)] for key in keys], np.uint8).reshape(-1, LENGTH)
    np.testing.assert_array_equal(version.vectors_of(keys[::-1]), expected[::-1])
    assert version.has(keys).all()
    for segment in version.segments:
        assert len(segment.keys) == len(segment.vectors) == segment.index.ntotal
    return True


def frames_of(keys, signatures):
    return dict(zip(keys.tolist(), signatures, strict=True))


def files(folder):
    return {path.name for path in folder.iterdir()}


def test_what_is_published_is_what_is_opened(walk, published, tmp_path):
    keys, signatures = np.arange(300)[::-1] * 7 - 50, walk(300)
    written = published(keys, signatures, revision=41, anchor=lambda: "an event")
    opened = newest(tmp_path / "map", "model", LENGTH)
    for version in (written, opened):
        assert holds(version, frames_of(keys, signatures))
        assert (version.number, version.revision, version.model_id) == (1, 41, "model")
        assert (version.manifest.dimension, len(version)) == (LENGTH, 300)
        assert version.manifest.anchor == "an event"
        (segment,) = version.segments
        assert not segment.vectors.flags.writeable
        with pytest.raises(ValueError, match="no frames"):
            version.vectors_of(np.array([keys[0], 3]))


def test_nothing_is_found_where_nothing_is(walk, published, tmp_path):
    assert newest(tmp_path / "map", "model", LENGTH) is None
    assert newest_number(tmp_path / "map") is None
    published(np.arange(5), walk(5))
    assert newest_number(tmp_path / "map") == 1
    assert newest(tmp_path / "map", "another", LENGTH) is None
    assert newest(tmp_path / "map", "model", LENGTH + 1) is None


@pytest.mark.parametrize("step", [1, 37, 1000])
def test_appending_gives_the_bytes_of_publishing_at_once(
    walk, published, tmp_path, monkeypatch, step
):
    monkeypatch.setattr("sceneprint.index.segment.BLOCK_BYTES", step * LENGTH)
    signatures, again = walk(120), walk(30, seed=5)
    first = published(np.arange(99, -1, -1), signatures[99::-1])
    keys = np.concatenate([np.arange(10, 40), np.arange(100, 120)])
    second = published(
        keys, np.concatenate([again, signatures[100:]]), first,
        drop=frozenset({0, 1, 2, 50, 110, 999}),
    )  # fmt: skip
    expected = frames_of(np.arange(120), signatures) | frames_of(np.arange(10, 40), again)
    for gone in (0, 1, 2, 50, 110):
        del expected[gone]
    assert holds(second, expected)
    assert holds(newest(tmp_path / "map", "model", LENGTH), expected)
    assert holds(first, frames_of(np.arange(100), signatures[:100]))  # a live one never changes
    third = published(np.arange(0), signatures[:0], second, revision=9)  # nothing but a revision
    assert holds(third, expected)
    assert (third.number, third.revision, third.manifest.files) == (3, 9, second.manifest.files)
    once = published(
        np.array(sorted(expected)), np.stack([expected[key] for key in sorted(expected)]),
        folder=tmp_path / "once",
    )  # fmt: skip
    # what is written again without anything of what is gone, is written as at once
    clean = published(np.arange(0), signatures[:0], third, clean=True)
    assert once.manifest.files == clean.manifest.files  # names are checksums


def test_all_frames_may_go(walk, published, tmp_path):
    signatures = walk(30)
    first = published(np.arange(30), signatures)
    last = published(np.arange(0), signatures[:0], first, drop=frozenset(range(30)))
    opened = newest(tmp_path / "map", "model", LENGTH)
    for version in (last, opened):
        assert (len(version), version.manifest.files) == (0, ())
        assert version.manifest.dimension == LENGTH
    anew = published(np.arange(3), signatures[:3], opened)
    assert holds(anew, frames_of(np.arange(3), signatures[:3]))


def test_two_versions_are_kept_and_only_our_files_removed(walk, published, tmp_path):
    folder, signatures = tmp_path / "map", walk(160)
    version = published(np.arange(100), signatures[:100])
    left = [".0123456789ab.part", *(f"{'0' * 64}.{kind}" for kind in ("keys", "faiss", "gone"))]
    for name in left:  # of a killed builder, of no manifest
        (folder / name).write_bytes(b"left")
    (folder / "notes.txt").write_text("of somebody else")
    for key in range(100, 105):
        version = published(np.array([key]), signatures[key : key + 1], version)
    names = files(folder)
    assert {".lock", "notes.txt"} <= names
    kinds = sorted(name.rpartition(".")[2] for name in names - {".lock", "notes.txt"})
    # of 100 and of 5 frames; of 100, of 3 and of 1
    assert kinds == ["faiss"] * 4 + ["json"] * 2 + ["keys"] * 4
    assert newest_number(folder) == 6
    (folder / left[2]).write_bytes(b"left")
    assert clear(folder, keep=5)
    assert newest_number(folder) == 5
    assert clear(folder)
    assert files(folder) == {".lock", "notes.txt"}


def test_one_builds_at_a_time(walk, published, tmp_path):
    folder, signatures = tmp_path / "map", walk(20)
    first = published(np.arange(10), signatures[:10])
    new = (np.arange(10, 20), signatures[10:])
    with folder_turn(folder) as mine:
        assert mine
        with folder_turn(folder) as another:  # of the same process as well
            assert not another
        assert publish(folder, model_id="model", revision=1, blocks=[new], previous=first) is None
        assert not clear(folder)
    assert newest_number(folder) == 1
    second = published(*new, first)
    # the loser of a race has built on what is no longer the newest
    assert publish(folder, model_id="model", revision=1, blocks=[new], previous=first) is None
    assert newest_number(folder) == second.number == 2
    # from nothing is always allowed, and follows in number
    third = published(np.arange(4), signatures[:4])
    assert third.number == 3
    assert holds(newest(folder, "model", LENGTH), frames_of(np.arange(4), signatures[:4]))


def test_an_emptied_folder_is_noticed(walk, published, tmp_path):
    folder, signatures = tmp_path / "map", walk(20)
    first = published(np.arange(10), signatures[:10])
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    new = (np.arange(10, 20), signatures[10:])
    assert publish(folder, model_id="model", revision=1, blocks=[new], previous=first) is None
    assert newest(folder, "model", LENGTH) is None
    assert holds(first, frames_of(np.arange(10), signatures[:10]))


def test_a_publication_that_fails_leaves_the_version_before(walk, published, tmp_path):
    folder, signatures = tmp_path / "map", walk(20)
    first = published(np.arange(10), signatures[:10])
    before = files(folder)

    def broken():
        yield np.arange(10, 12), signatures[10:12]
        raise ConnectionError("the database went away")

    for blocks, error in (
        (broken(), ConnectionError),
        ([(np.array([10, 11, 10]), signatures[10:13])], ValueError),  # a key twice
        ([(np.arange(10, 12), signatures[10:12, 1:])], ValueError),  # too short
    ):
        with pytest.raises(error):
            publish(folder, model_id="model", revision=1, blocks=blocks, previous=first)
    assert files(folder) == before
    published(np.arange(10, 20), signatures[10:], first)
    assert holds(newest(folder, "model", LENGTH), frames_of(np.arange(20), signatures))


def test_readers_go_on_while_versions_pass(walk, published, tmp_path):
    folder, signatures = tmp_path / "map", walk(750, LENGTH)
    first = published(np.arange(300), signatures[:300], revision=300)
    old = {path.name for path in folder.iterdir()}
    tail, errors, done = Tail.empty(LENGTH), [], threading.Event()
    queries = signatures[::97]
    expected = [search(q, first, tail, 20, metric="l2") for q in queries]
    counts = [0, 0]

    def search_old():
        while not done.is_set():
            for query, right in zip(queries, expected, strict=True):
                hits = search(query, first, tail, 20, metric="l2")
                if (hits.keys != right.keys).any() or (hits.distances != right.distances).any():
                    errors.append("an old version has changed")
            counts[0] += 1

    def follow():
        known = None
        while not done.is_set():
            actual = newest(folder, "model", LENGTH, previous=known)
            if actual is None or (known is not None and actual.number < known.number):
                errors.append(f"{actual and actual.number} after {known and known.number}")
                continue
            known = actual
            n = known.revision
            hits = search(signatures[n - 1], known, tail, 1, metric="l2")
            if len(known) != n or hits.keys.tolist() != [n - 1]:
                errors.append(f"version {known.number} has {len(known)} of {n}")
            counts[1] += 1

    def guarded(work):
        def run():
            try:
                work()
            except Exception as error:  # what a thread raises would be lost
                errors.append(repr(error))

        return run

    threads = [threading.Thread(target=guarded(w)) for w in (search_old, search_old, follow)]
    for thread in threads:
        thread.start()
    version = first
    for n in range(300, 750, 30):
        new = np.arange(n, n + 30)
        version = published(new, signatures[new], version, revision=n + 30)
    deadline = time.monotonic() + PATIENCE_S
    while min(counts) < 3 and not errors and time.monotonic() < deadline:
        time.sleep(0.01)
    done.set()
    for thread in threads:
        thread.join(PATIENCE_S)
    assert errors == []
    assert min(counts) >= 3
    assert version.number == 16
    left = {path.name for path in folder.iterdir()}
    assert old & left == {".lock"}  # the first segment has been merged
