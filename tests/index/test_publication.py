"""Tests of publication: appending, merging, removal, and reopening."""

import contextlib
import hashlib
import os
import subprocess
import sys

import faiss
import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.atomic_files import folder_turn
from sceneprint.index.index_manifest import newest_number
from sceneprint.index.index_version import clear, newest, publish

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
    made = published(keys, signatures, revision=41, anchor=lambda: "an event")
    opened = newest(tmp_path / "map", "model", LENGTH)
    for version in (made, opened):
        assert holds(version, frames_of(keys, signatures))
        assert (version.number, version.revision, version.model_id) == (1, 41, "model")
        assert (version.manifest.dimension, len(version)) == (LENGTH, 300)
        assert version.manifest.anchor == "an event"
        (segment,) = version.segments
        assert not segment.vectors.flags.writeable
        with pytest.raises(ValueError, match="no frames"):
            version.vectors_of(np.array([keys[0], 3]))


def test_files_are_keys_and_what_faiss_writes(walk, published, tmp_path):
    """Byte for byte as FAISS serialises an index to which the signatures were added as floats."""
    signatures = walk(100)
    published(np.arange(100) + 5, signatures)
    index = faiss.IndexScalarQuantizer(
        LENGTH, faiss.ScalarQuantizer.QT_8bit_direct, faiss.METRIC_L2
    )
    index.add(signatures.astype(np.float32))
    (path,) = (tmp_path / "map").glob("*.faiss")
    assert path.read_bytes() == faiss.serialize_index(index).tobytes()
    (keys,) = (tmp_path / "map").glob("*.keys")
    assert keys.read_bytes() == (np.arange(100) + 5).astype("<i8").tobytes()
    for each in (path, keys):
        assert each.stem == hashlib.sha256(each.read_bytes()).hexdigest()


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
    """Whatever came when, in blocks of whatever size."""
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
    assert clear(folder, but=5)
    assert newest_number(folder) == 5
    assert clear(folder)
    assert files(folder) == {".lock", "notes.txt"}


def test_what_was_mapped_survives_its_file(walk, tmp_path):
    """In a process of its own, which a lost mapping would kill."""
    code = """
import sys
from pathlib import Path
import numpy as np
from sceneprint.index.index_version import Tail, newest, publish, search

n = 4000
rows = np.random.default_rng(0).integers(0, 256, (n, 256), np.uint8)
for flat in (1 << 30, 0):
    folder = Path(sys.argv[1]) / str(flat)
    publish(folder, model_id="m", revision=1, blocks=[(np.arange(n), rows)], previous=None,
            flat_bytes=flat)
    found = newest(folder, "m", 256)
    for path in folder.iterdir():
        path.unlink()
    vectors = found.segments[0].vectors
    hits = search(rows[777], found, Tail.empty(256), 3, metric="l2")
    assert hits.keys[0] == 777 and hits.distances[0] == 0
    assert (vectors == rows).all()
    where = next(line for line in open("/proc/self/smaps") if f"/{flat}/" in line)
    del found, hits
    assert (vectors == rows).all()  # keeps the mapping alive by itself
    assert where.split()[1].startswith("r--")  # a file is mapped, and nobody may write there
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


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


def test_mistakes_leave_the_version_before(walk, published, tmp_path):
    folder, signatures = tmp_path / "map", walk(20)
    first = published(np.arange(10), signatures[:10])
    before = files(folder)

    def broken():
        yield np.arange(10, 12), signatures[10:12]
        raise ConnectionError("the database went away")

    def attempt(blocks, model="model"):
        publish(folder, model_id=model, revision=1, blocks=blocks, previous=first)

    with pytest.raises(ConnectionError):
        attempt(broken())
    with pytest.raises(ValueError, match=r"\[10\] occur twice"):
        attempt([(np.array([10, 11, 10]), signatures[10:13])])
    with pytest.raises(ValueError, match=r"\[255, 256\] bytes in one map"):
        attempt([(np.arange(10, 12), signatures[10:12, 1:])])
    with pytest.raises(ValueError, match="keys of int32"):
        attempt([(np.arange(10, 12, dtype=np.int32), signatures[10:12])])
    with pytest.raises(ValueError, match=r"keys \(3,\)"):
        attempt([(np.arange(10, 13), signatures[10:12])])
    with pytest.raises(ValueError, match="an index of model model cannot contain frames of other"):
        attempt([], "other")
    with pytest.raises(ValueError, match="there are no frames"):
        publish(folder, model_id="model", revision=1, blocks=[], previous=None)
    assert files(folder) == before
    assert holds(newest(folder, "model", LENGTH), frames_of(np.arange(10), signatures[:10]))
    published(np.arange(10, 20), signatures[10:], first)
    assert holds(newest(folder, "model", LENGTH), frames_of(np.arange(20), signatures))


@pytest.mark.parametrize("n", [10, 60])
def test_a_failure_at_any_step_leaves_the_old_or_the_new(walk, published, tmp_path, monkeypatch, n):
    """A disk that fills, at each of the calls that give a file its name or make it durable.

    Of a publication that appends and deletes, and of one that merges.
    """
    signatures, real = walk(100), {"replace": os.replace, "fsync": os.fsync}
    seen = set()
    for call in ("replace", "fsync"):
        for step in range(100):
            folder = tmp_path / f"{call}-{step}"
            first = published(np.arange(40), signatures[:40], folder=folder)
            keys, gone = np.arange(40, 40 + n), frozenset([3])
            left = step

            def failing(*arguments, call=call):
                nonlocal left
                left -= 1
                if left < 0:
                    raise OSError(28, "No space left on device")
                real[call](*arguments)

            with monkeypatch.context() as patch:
                patch.setattr(os, call, failing)
                with contextlib.suppress(OSError):
                    published(keys, signatures[keys], first, folder=folder, drop=gone, flat_bytes=0)
            found = newest(folder, "model", LENGTH)
            last = {1: 40, 2: 40 + n}[found.number]
            frames = frames_of(np.arange(last), signatures[:last])
            if found.number == 2:
                del frames[3]
            assert holds(found, frames)
            assert not list(folder.glob(".*.part"))
            seen.add((call, found.number))
            if left >= 0:
                break
        assert step >= 3
    assert {("replace", 1), ("replace", 2), ("fsync", 1), ("fsync", 2)} <= seen
