"""Tests of blobs: round trips and errors."""

import errno
import hashlib
import os
import resource
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from sceneprint.errors import DamagedBlob, ReadOnlyStore, StoreFull, UnusableStore
from sceneprint.store import Blobs, FolderBlobs
from sceneprint.store.blobs.folder import MARK, FileLocks
from sceneprint.store.blobs.object_client import open_objects
from sceneprint.store.blobs.object_store import ObjectBlobs

DIGEST = hashlib.sha256(b"depth").hexdigest()
KEY = f"blobs/{DIGEST[:2]}/{DIGEST}"


@dataclass
class Kept:
    """Blobs somewhere, and what lies there by itself."""

    blobs: Blobs
    files: Callable[[], list[str]]
    write: Callable[[str, bytes], object]


def files(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


@pytest.fixture
def blobs(tmp_path):
    return FolderBlobs(tmp_path / "blobs")


@pytest.fixture(params=["folder", "s3"])
def bucket(request, tmp_path):
    """A new place for blobs, of each kind there is."""
    if request.param == "folder":
        return Kept(
            FolderBlobs(tmp_path / "blobs"), lambda: files(tmp_path),
            lambda key, data: (tmp_path / key).write_bytes(data),
        )  # fmt: skip
    objects = open_objects(f"{request.getfixturevalue('bucket')}/pre/fix")
    locks = FileLocks(tmp_path / "lock", make=True)
    return Kept(
        ObjectBlobs(objects, locks, lambda: "me"),
        lambda: sorted(entry.key for entry in objects.list("") if entry.key != MARK),
        objects.put,
    )


def test_a_blob_lies_under_the_hash_of_its_content(bucket):
    assert bucket.blobs.put(b"depth") == bucket.blobs.put(b"depth") == DIGEST
    assert bucket.files() == [KEY]
    assert bucket.blobs.get(DIGEST) == b"depth"
    assert (bucket.blobs.size(DIGEST), bucket.blobs.size("0" * 64)) == (5, None)
    assert bucket.blobs.place(DIGEST).endswith(f"/{KEY}")
    empty = bucket.blobs.put(b"")
    assert empty == hashlib.sha256(b"").hexdigest()
    assert bucket.blobs.get(empty) == b""
    assert sorted(bucket.blobs.digests()) == sorted([DIGEST, empty])


def test_one_flipped_bit_is_noticed(bucket, tmp_path):
    bucket.blobs.put(b"depth")
    assert bucket.blobs.condition(DIGEST) == "sound"
    data = bytearray(b"depth")
    data[4] ^= 1
    bucket.write(KEY, bytes(data))
    with pytest.raises(DamagedBlob, match=f"{DIGEST[:12]} is damaged"):
        bucket.blobs.get(DIGEST)
    assert bucket.blobs.condition(DIGEST) == "damaged"
    assert bucket.blobs.condition(DIGEST, quick=True) == "sound"
    with bucket.blobs.locks.removing() as allowed:
        assert allowed
        place = bucket.blobs.quarantine(DIGEST, tmp_path / "away")
    assert place == tmp_path / "away" / f"blob-{DIGEST}"
    assert place.read_bytes() == bytes(data)
    assert bucket.blobs.condition(DIGEST) == bucket.blobs.condition("x") == "missing"
    with bucket.blobs.locks.removing():
        assert bucket.blobs.quarantine(DIGEST, tmp_path / "away") is None


@pytest.mark.parametrize("left", [b"", b"dEpth"])
def test_putting_the_bytes_again_mends_a_damaged_blob(bucket, left):
    bucket.blobs.put(b"depth")
    bucket.write(KEY, left)
    assert bucket.blobs.put(b"depth") == DIGEST
    assert bucket.blobs.get(DIGEST) == b"depth"


def test_a_missing_blob_is_said(bucket):
    with pytest.raises(DamagedBlob, match=r"(does not exist|No such file).*upload it again"):
        bucket.blobs.get(DIGEST)
    with pytest.raises(FileNotFoundError):
        bucket.blobs.open(DIGEST)
    assert not bucket.blobs.holds(DIGEST)
    bucket.blobs.put(b"depth")
    assert bucket.blobs.holds(DIGEST)
    bucket.blobs.remove(DIGEST)
    assert not bucket.blobs.holds(DIGEST)
    bucket.blobs.remove(DIGEST)  # of no consequence
    assert list(bucket.blobs.digests()) == []


@pytest.mark.parametrize(
    "text",
    ["", "../../etc/passwd", DIGEST[:-1], DIGEST + "\n", DIGEST.upper(), "/" * 64, "\u0660" * 64],
)
def test_nothing_but_a_digest_becomes_a_path(blobs, text):
    others = ObjectBlobs(open_objects("memory:///"), FileLocks(Path("/none")), lambda: "me")
    for each in (blobs, others):
        for call in (each.get, each.open, each.holds, each.size, each.remove):
            with pytest.raises(ValueError, match="is not a digest"):
                call(text)
        assert each.condition(text) == "missing"


def test_a_blob_in_parts_is_there_whole_or_not_at_all(bucket):
    parts = [bytes([number]) * 3_000_000 for number in range(7)]  # more than a store takes at once
    whole = b"".join(parts)
    with bucket.blobs.incoming() as blob:
        blob.write(parts[0])
    assert bucket.files() == []
    with bucket.blobs.incoming() as blob:
        for part in parts:
            blob.write(part)
        digest = blob.keep()
    assert digest == hashlib.sha256(whole).hexdigest()
    assert bucket.files() == [f"blobs/{digest[:2]}/{digest}"]
    assert bucket.blobs.get(digest) == whole
    assert bucket.blobs.condition(digest) == "sound"
    with bucket.blobs.open(digest) as file:
        file.seek(2_999_990)
        assert file.read(20) == b"\0" * 10 + b"\1" * 10
        assert file.seek(-5, os.SEEK_END) == len(whole) - 5
        assert file.read() == b"\6" * 5
        assert file.read(1) == b""


def test_a_full_disk_leaves_no_part_of_a_blob(bucket):
    def fill():
        with bucket.blobs.incoming() as blob:
            for _ in range(20):
                blob.write(b"x" * 5000)

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (65536, before[1]))  # stands for a full disk
    try:
        with pytest.raises(UnusableStore, match=r"cannot be written \(File too large\)"):
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert bucket.files() == []


def test_what_others_leave_there_is_no_blob(bucket):
    bucket.blobs.put(b"depth")
    bucket.write(f"blobs/{DIGEST[:2]}/.0123456789ab.part", b"half")
    bucket.write("blobs/readme", DIGEST.encode())
    bucket.write(f"blobs/{DIGEST[:2]}/{'0' * 64}", b"of another folder")
    result = {Path(e.place).name: (e.digest, e.unfinished) for e in bucket.blobs.entries()}
    part = result.pop(".0123456789ab.part", None)
    assert part in ((None, True), (None, False), None)  # an object store has no half objects
    assert result == {
        DIGEST: (DIGEST, False), "readme": (None, False), "0" * 64: (None, False),
    }  # fmt: skip


def test_who_needs_blobs_keeps_others_from_removing_them(bucket):
    locks = bucket.blobs.locks
    with locks.block_removals(), locks.block_removals(), locks.removing() as allowed:
        assert not allowed
    with locks.removing() as allowed, locks.removing() as also:
        assert (allowed, also) == (True, False)
    with locks.removing() as allowed:
        assert allowed


def test_a_blob_may_be_put_and_removed_at_once(blobs, tmp_path):
    """What removes is the sweep; an upload of the same content must not stumble over it."""

    def put():
        for _ in range(150):
            blobs.put(b"depth")

    with ThreadPoolExecutor(2) as pool:
        putting = [pool.submit(put) for _ in range(2)]
        while not all(future.done() for future in putting):
            blobs.remove(DIGEST)
    assert [future.result() for future in putting] == [None, None]
    assert not [name for name in files(tmp_path) if name.endswith(".part")]


@pytest.mark.parametrize(
    ("number", "kind", "advice"),
    [
        (errno.ENOSPC, StoreFull, "The disk is full. Free some space."),
        (errno.EDQUOT, StoreFull, "The disk is full. Free some space."),
        (errno.EROFS, ReadOnlyStore, "It is read-only. Make it writable, or use another folder."),
        (errno.EIO, UnusableStore, "Check the folder and its permissions."),
    ],
)
def test_what_to_do_depends_on_what_failed(blobs, tmp_path, monkeypatch, number, kind, advice):
    def fail(_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(UnusableStore) as caught:
        blobs.put(b"depth")
    assert caught.type is kind
    assert str(caught.value).endswith(f"cannot be written ({os.strerror(number)}). {advice}")
    assert files(tmp_path) == []


def test_what_is_there_already_is_made_durable_too(blobs, monkeypatch):
    """Who put it first may have been killed between the name and its fsync."""
    blobs.put(b"depth")
    synced = []
    monkeypatch.setattr(os, "fsync", lambda number: synced.append(os.fstat(number).st_ino))
    blobs.put(b"depth")
    folder = blobs.path(DIGEST).parent
    assert folder.stat().st_ino in synced
