"""Blobs: what is put is what comes back, or an error."""

from __future__ import annotations

import errno
import hashlib
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from sceneprint.errors import DamagedBlob, ReadOnlyStore, StoreFull, UnusableStore
from sceneprint.store import Blobs

DIGEST = hashlib.sha256(b"depth").hexdigest()

NARROW = """
import resource, sys
from pathlib import Path
from sceneprint.errors import UnusableStore
from sceneprint.store import Blobs

resource.setrlimit(resource.RLIMIT_FSIZE, (65536, 65536))
blobs = Blobs(Path(sys.argv[1]))
small = blobs.put(b"s" * 65536)
for size in (65537, 5_000_000):
    try:
        blobs.put(b"x" * size)
        print("put")
    except UnusableStore as error:
        print(error)
print(blobs.get(small) == b"s" * 65536)
"""


@pytest.fixture
def blobs(tmp_path: Path) -> Blobs:
    return Blobs(tmp_path / "blobs")


def files(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def test_a_blob_lies_under_the_hash_of_its_content(blobs: Blobs, tmp_path: Path) -> None:
    assert blobs.put(b"depth") == DIGEST
    assert files(tmp_path) == [f"blobs/{DIGEST[:2]}/{DIGEST}"]
    assert blobs.get(DIGEST) == b"depth"
    empty = blobs.put(b"")
    assert empty == hashlib.sha256(b"").hexdigest()
    assert blobs.get(empty) == b""
    assert sorted(blobs.digests()) == sorted([DIGEST, empty])


def test_the_same_bytes_put_twice_are_one_file(blobs: Blobs, tmp_path: Path) -> None:
    assert blobs.put(b"depth") == blobs.put(b"depth") == DIGEST
    assert files(tmp_path) == [f"blobs/{DIGEST[:2]}/{DIGEST}"]
    assert blobs.get(DIGEST) == b"depth"


@pytest.mark.parametrize("byte", [0, 2, 4])
def test_one_flipped_bit_is_noticed(blobs: Blobs, tmp_path: Path, byte: int) -> None:
    blobs.put(b"depth")
    path = tmp_path / "blobs" / DIGEST[:2] / DIGEST
    data = bytearray(b"depth")
    data[byte] ^= 1
    path.write_bytes(data)
    with pytest.raises(DamagedBlob, match=f"{DIGEST[:12]} is damaged"):
        blobs.get(DIGEST)


@pytest.mark.parametrize("left", [b"", b"dept", b"depths", b"dEpth"])
def test_putting_the_bytes_again_mends_a_damaged_blob(
    blobs: Blobs, tmp_path: Path, left: bytes
) -> None:
    blobs.put(b"depth")
    (tmp_path / "blobs" / DIGEST[:2] / DIGEST).write_bytes(left)
    assert blobs.put(b"depth") == DIGEST
    assert blobs.get(DIGEST) == b"depth"


def test_a_missing_blob_is_said(blobs: Blobs) -> None:
    with pytest.raises(DamagedBlob, match=r"cannot be read .No such file.*upload it again"):
        blobs.get(DIGEST)
    assert not blobs.holds(DIGEST)
    blobs.put(b"depth")
    assert blobs.holds(DIGEST)
    blobs.remove(DIGEST)
    assert not blobs.holds(DIGEST)
    blobs.remove(DIGEST)  # of no consequence
    assert list(blobs.digests()) == []


@pytest.mark.parametrize(
    "given",
    ["", "../x", "../../etc/passwd", "/etc/passwd", DIGEST[:-1], DIGEST + "0", DIGEST + "\n",
     DIGEST.upper(), "/" * 64, "." * 64, DIGEST[:62] + "/x", "\0" * 64, "\u0660" * 64],
)  # fmt: skip
def test_nothing_but_a_digest_becomes_a_path(blobs: Blobs, given: str) -> None:
    for call in (blobs.get, blobs.holds, blobs.remove):
        with pytest.raises(ValueError, match="is no digest"):
            call(given)


def test_what_others_leave_in_the_folder_is_not_listed(blobs: Blobs, tmp_path: Path) -> None:
    blobs.put(b"depth")
    (tmp_path / "blobs" / DIGEST[:2] / ".0123456789ab.part").write_bytes(b"half")
    (tmp_path / "blobs" / "lost+found").mkdir()
    (tmp_path / "blobs" / "readme").write_text(DIGEST)
    assert list(blobs.digests()) == [DIGEST]


def test_a_full_disk_leaves_nothing_and_hurts_nothing(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", NARROW, str(tmp_path / "blobs")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = done.stdout.splitlines()
    assert len(told) == 3
    assert all("a blob cannot be written (File too large)" in line for line in told[:2])
    assert told[2] == "True"
    kept = hashlib.sha256(b"s" * 65536).hexdigest()
    assert files(tmp_path) == [f"blobs/{kept[:2]}/{kept}"]


def test_a_file_where_a_folder_should_be_is_said(tmp_path: Path) -> None:
    place = tmp_path / "blobs" / DIGEST[:2]
    blobs = Blobs(tmp_path / "blobs")
    place.write_bytes(b"")  # a file where the folder should be
    with pytest.raises(UnusableStore, match="Check the folder and its permissions"):
        blobs.put(b"depth")
    with pytest.raises(UnusableStore, match=r"the folder cannot be made \(Not a directory\)"):
        Blobs(place / "below")


def test_a_blob_may_be_put_and_removed_at_once(blobs: Blobs, tmp_path: Path) -> None:
    """What removes is the sweep; an upload of the same content must not stumble over it."""
    raised: list[BaseException] = []
    over = threading.Event()

    def sweep() -> None:
        while not over.is_set():
            blobs.remove(DIGEST)

    def put() -> None:
        try:
            for _ in range(150):
                blobs.put(b"depth")
        except BaseException as error:
            raised.append(error)

    sweeping = threading.Thread(target=sweep)
    putting = [threading.Thread(target=put) for _ in range(2)]
    for thread in (sweeping, *putting):
        thread.start()
    for thread in putting:
        thread.join()
    over.set()
    sweeping.join()
    assert raised == []
    assert not [name for name in files(tmp_path) if name.endswith(".part")]


@pytest.mark.parametrize(
    ("number", "kind", "advice"),
    [
        (errno.ENOSPC, StoreFull, "The disk is full: free some space."),
        (errno.EDQUOT, StoreFull, "The disk is full: free some space."),
        (errno.EROFS, ReadOnlyStore, "It is read-only: make it writable, or name another folder."),
        (errno.EIO, UnusableStore, "Check the folder and its permissions."),
    ],
)
def test_what_to_do_depends_on_what_failed(
    blobs: Blobs,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    kind: type[UnusableStore],
    advice: str,
) -> None:
    def fail(_: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(UnusableStore) as caught:
        blobs.put(b"depth")
    assert caught.type is kind
    assert str(caught.value).endswith(f"cannot be written ({os.strerror(number)}). {advice}")
    assert not blobs.holds(DIGEST)


def test_what_is_there_already_is_made_durable_too(
    blobs: Blobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who put it first may have been killed between the name and its fsync."""
    blobs.put(b"depth")
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda number: synced.append(os.fstat(number).st_ino))
    blobs.put(b"depth")
    folder = blobs._path(DIGEST).parent
    assert folder.stat().st_ino in synced
