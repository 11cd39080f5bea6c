"""Tests of the order of fsyncs: no power failure loses acknowledged data.

The tests cover blobs and indexes; SQLite protects its own files (synchronous = FULL).
"""

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import event

from sceneprint import atomic_files
from sceneprint.index import index_version
from sceneprint.index.index_version import newest, publish
from sceneprint.settings import Settings
from sceneprint.store import FolderBlobs
from sceneprint_client.api import FrameMeta, JobState, NewMap
from tests.whole_engine import Engine

LENGTH = 64


def test_what_a_disk_may_drop(tmp_path, recorded):
    """The model itself, against POSIX by hand."""
    root = tmp_path / "disk"
    root.mkdir()
    (root / "old").write_bytes(b"old")
    with recorded(root) as disk:
        (root / "sub").mkdir()
        with (root / "sub" / "part").open("wb") as file:
            file.write(b"content")
            file.flush()
            os.fsync(file.fileno())
        disk.mark("file synced")
        (root / "sub" / "part").replace(root / "sub" / "whole")
        (root / "old").unlink()
        disk.mark("renamed")
        atomic_files.sync_folder(root / "sub")
        disk.mark("sub synced")
        atomic_files.sync_folder(root)
    left = {}
    for _, what, tree in disk.crashes(seeds=20):
        left.setdefault(what.partition(":")[0], []).append(tree)

    old = {"old": b"old"}
    sub = {"sub": None}
    part, whole = {**sub, "sub/part": b"content"}, {**sub, "sub/whole": b"content"}

    def either(*trees):
        return sorted(trees, key=repr)

    def all_of(what):
        return sorted(left[what], key=repr)

    assert all_of("begin") == [old]
    assert all_of("file synced") == either(old, old | sub, old | part)
    # a rename of a name that is not sure yet may be there without the making of it
    named = [{}, sub, part, whole]
    assert all_of("renamed") == either(*named, *({**old, **one} for one in named))
    assert all_of("sub synced") == either({}, old, whole, old | whole)
    assert all_of("end") == [whole]


@pytest.fixture
def lost_blobs(recorded, after_crash, tmp_path):
    """Put blobs on a disk, and say which promises a loss of power breaks."""
    first, second, large = b"depth" * 300, b"another frame" * 100, b"an archive" * 200
    folder = hashlib.sha256(first).hexdigest()[:2]
    beside = next(
        data
        for data in (f"of the same folder {i}".encode() * 50 for i in range(10_000))
        if hashlib.sha256(data).hexdigest().startswith(folder)
    )

    def run(deaf):
        root = tmp_path / f"disk-{deaf}"
        root.mkdir()
        contents = {hashlib.sha256(one).hexdigest(): one for one in (first, second, beside, large)}
        with recorded(root, deaf) as disk:
            promised = [(0, set())]
            blobs = FolderBlobs(root / "data" / "blobs")
            for data in (large, first, second, beside, first):
                if data is large:
                    with blobs.incoming() as part:
                        part.write(data[:700])
                        part.write(data[700:])
                        digest = part.keep()
                else:
                    digest = blobs.put(data)
                disk.mark("put")
                promised.append((len(disk.states) - 1, promised[-1][1] | {digest}))
            disk.mark("removing")  # its rows are gone: from here on nothing is promised
            blobs.remove(digest)
            promised.append((len(disk.states) - 1, promised[-1][1] - {digest}))
        broken = set()
        for step, what, tree in disk.crashes():
            found = {Path(name).name: data for name, data in tree.items() if data is not None}
            held = {name: data for name, data in found.items() if not name.endswith(".part")}
            if any(contents[name] != data for name, data in held.items()):
                broken.add("a name with another content")
            due = next(names for begun, names in reversed(promised) if begun <= step)
            if due - held.keys():
                broken.add("a blob that is gone")
            if step == len(disk.states) - 1 and digest in held:
                broken.add("a removed blob that is back")
            kept = FolderBlobs(after_crash(tree) / "data" / "blobs")
            for name in held:
                if held[name] == contents[name]:
                    assert kept.get(name) == contents[name], what
        return broken

    return run


def test_a_blob_that_was_put_survives(lost_blobs):
    assert lost_blobs("") == set()


def test_who_does_not_sync_blobs_is_found_out(lost_blobs):
    assert lost_blobs("files") == {"a name with another content"}
    assert lost_blobs("folders") == {"a blob that is gone"}


def test_no_commit_refers_to_a_blob_that_may_be_lost(tmp_path, recorded, small_upload):
    """Upload, signing and deletion as they are: with every commit the blobs it refers to."""
    referred = (
        "SELECT blob FROM frames WHERE state != 'deleted' UNION SELECT geometry FROM signatures"
    )
    root = tmp_path / "data" / "blobs"
    commits = []
    with Engine(Settings(data_dir=tmp_path / "data", database_url=None)) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
        with recorded(root) as disk:

            def note(connection):  # before SQLite is asked to commit
                rows = {row[0] for row in connection.exec_driver_sql(referred)}
                disk.mark("commit")
                commits.append((len(disk.states) - 1, rows))

            database = engine.store.database._engine
            event.listen(database, "commit", note)
            added, _ = engine.add_frame("hall", *small_upload)
            work = engine.claim("w")
            assert work is not None
            assert engine.run(work) == JobState.SUCCEEDED
            event.remove(database, "commit", note)
            before_deletion = len(disk.states)
            engine.delete_frame("hall", added.frame_id)
    assert [len(rows) for _, rows in commits] == sorted(len(rows) for _, rows in commits)
    assert len(commits[-1][1]) == 2  # the upload and its artifact
    checked = 0
    for step, what, tree in disk.crashes():
        if step >= before_deletion:
            break
        rows = next((names for begun, names in reversed(commits) if begun <= step), set())
        whole = {
            Path(name).name
            for name, data in tree.items()
            if data is not None and hashlib.sha256(data).hexdigest() == Path(name).name
        }
        assert rows <= whole, what
        checked += bool(rows)
    assert checked > 10


def signatures_at(keys):
    return np.stack([np.random.default_rng(k).integers(0, 256, LENGTH, np.uint8) for k in keys])


#: Keys that each version adds, those it drops, and bytes up to which it has no sketches:
#: a first, an appended, one with sketches, one of deletions with sketches, one without.
STEPS = (
    (range(20), frozenset[int](), 1 << 30),
    (range(20, 26), frozenset({3}), 1 << 30),
    (range(26, 60), frozenset[int](), 0),
    (range(60, 62), frozenset(range(5, 50)), 0),
    (range(62, 70), frozenset[int](), 1 << 30),
)
N_STEPS = len(STEPS)


def expected(number):
    """Keys of a version, by hand."""
    keys = []
    for new, dropped, _ in STEPS[:number]:
        keys = [key for key in [*keys, *new] if key not in dropped]
    return keys


def publish_step(folder, number, previous):
    new, dropped, flat_bytes = STEPS[number - 1]
    keys = np.array(new)
    made = publish(
        folder, model_id="model", revision=10 * number, blocks=[(keys, signatures_at(keys))],
        previous=previous, drop=dropped, flat_bytes=flat_bytes,
    )  # fmt: skip
    assert made is not None
    return made


def read(folder):
    """The newest version, which holds just what it should."""
    found = newest(folder, "model", LENGTH)
    if found is not None:
        number = found.revision // 10
        assert found.keys.tolist() == expected(number)
        np.testing.assert_array_equal(found.vectors_of(found.keys), signatures_at(found.keys))
        for one in found.segments:
            assert (one.sketches is None) == (STEPS[number - 1][2] > 0)
    return found


@pytest.fixture
def lost_versions(recorded, after_crash, tmp_path):
    """Publish five versions, and say which promises a loss of power breaks."""

    def run(deaf="", steps=N_STEPS):
        root = tmp_path / f"index-{deaf}"
        root.mkdir()
        done = [0]  # the state after which each version was published
        with recorded(root, deaf) as disk:
            previous = None
            for number in range(1, steps + 1):
                previous = publish_step(root / "map", number, previous)
                disk.mark("published")
                done.append(len(disk.states) - 1)
        broken, seen, looked_at = set(), set(), set()
        for step, what, tree in disk.crashes(seeds=2):
            published = max(number for number, begun in enumerate(done) if begun <= step)
            if (published, frozenset(tree.items())) in looked_at:
                continue
            looked_at.add((published, frozenset(tree.items())))
            folder = after_crash(tree) / "map"
            found = read(folder)
            number = 0 if found is None else found.revision // 10
            if number not in (published, published + 1):
                broken.add(f"{number or 'none'} after {published} ({what})")
            if what.endswith("nothing unsure") and number < steps and number == published:
                again = publish_step(folder, number + 1, found)  # and it goes on from there
                assert read(folder) is not None
                assert again.revision == 10 * (number + 1)
            seen.add((published, number))
        if not broken:  # in every stretch some crashes keep the old one, and some the new one
            assert seen >= {(n, n) for n in range(steps)} | {(n, n + 1) for n in range(steps)}
        return broken

    return run


def test_a_version_that_was_published_survives(lost_versions):
    assert lost_versions() == set()


@pytest.mark.parametrize("deaf", ["files", "folders"])
def test_who_does_not_sync_an_index_is_found_out(deaf, lost_versions):
    broken = lost_versions(deaf, steps=2)
    assert {one.partition(" (")[0] for one in broken} >= {"none after 1"}


def test_old_versions_removed_too_early_are_found_out(lost_versions, monkeypatch):
    write = index_version.write_manifest

    def remove_first(folder, manifest):
        for path in folder.glob("*.json"):
            path.unlink()
        return write(folder, manifest)

    monkeypatch.setattr(index_version, "write_manifest", remove_first)
    assert any(one.startswith("none after 1") for one in lost_versions(steps=2))


@pytest.fixture(scope="module")
def small_upload(room_frames, small_image):
    data, camera = small_image(room_frames[0], 0, 0)
    return data, FrameMeta(intrinsics=camera)
