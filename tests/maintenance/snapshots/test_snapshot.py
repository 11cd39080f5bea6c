"""What is in a snapshot, and what comes back of it."""

from __future__ import annotations

import hashlib
import json
import os
import re
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sceneprint.engine import Engine
from sceneprint.engine.admin.operations import list_keys
from sceneprint.errors import SnapshotError, UnusableStore
from sceneprint.maintenance.snapshot import creation
from sceneprint.maintenance.snapshot.creation import take_snapshot
from sceneprint.maintenance.snapshot.restoration import restore_snapshot, verify_snapshot
from sceneprint.store import FolderBlobs
from sceneprint.store.frames import refers_to


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_what_is_in_an_archive(master, archive, rows):
    """Read by the tar of Python, and checked against the folder by hand."""
    with tarfile.open(archive) as tar:
        held = {one.name: tar.extractfile(one).read() for one in tar.getmembers()}
        assert all(one.isreg() and one.mode == 0o600 for one in tar.getmembers())
    names = list(held)
    assert names[:2] == ["manifest.json", "sceneprint.db"]
    assert names[-1] == "damaged.jsonl"
    blobs = names[2:-1]
    assert blobs == sorted(blobs)
    uploads = rows(master, "SELECT blob FROM frames WHERE state != 'deleted'")
    artifacts = rows(master, "SELECT geometry FROM signatures")
    assert (len(uploads), len(artifacts)) == (5, 4)
    assert set(blobs) == {f"blobs/{digest}" for (digest,) in uploads + artifacts}
    for name in blobs:
        assert hashlib.sha256(held[name]).hexdigest() == name.removeprefix("blobs/")
    manifest = json.loads(held["manifest.json"])
    begun = datetime.fromisoformat(manifest.pop("created_at"))
    assert 0 <= (datetime.now(UTC) - begun).total_seconds() < 3600
    ((revision,),) = rows(master, "SELECT version_num FROM alembic_version")
    own = manifest.pop("sha256")
    assert re.fullmatch("[0-9a-f]{64}", own)
    assert manifest.pop("sceneprint")
    assert manifest == {
        "format": "sceneprint-snapshot", "version": 1, "schema_revision": revision,
        "maps": 1, "frames": {"deleted": 1, "indexed": 4, "received": 1}, "signatures": 4,
        "database": {
            "bytes": len(held["sceneprint.db"]),
            "sha256": hashlib.sha256(held["sceneprint.db"]).hexdigest(),
        },
        "blobs": {"count": 9, "bytes": sum(len(held[name]) for name in blobs)},
        "damaged": {"count": 0, "bytes": 0, "sha256": hashlib.sha256(b"").hexdigest()},
        "bytes": archive.stat().st_size,
    }  # fmt: skip
    assert archive.stat().st_mode & 0o777 == 0o600


def test_the_blobs_are_those_that_no_sweep_would_remove(master, archive, settings):
    with tarfile.open(archive) as tar:
        held = {name.removeprefix("blobs/") for name in tar.getnames() if "/" in name}
    with Engine(settings(master)) as engine, engine.store.database.read() as connection:
        all_there = set(engine.store.blobs.digests())
        assert held == {digest for digest in all_there if refers_to(connection, digest)}
    assert len(all_there) == len(held) + 1  # the orphan


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_what_is_restored_is_what_was_there(
    data, archive, tmp_path, content, answers, uploads, settings
):
    snapshot = restore_snapshot(archive, tmp_path / "new" / "data")
    new = tmp_path / "new" / "data"
    assert names_in(tmp_path / "new") == ["data"]
    assert names_in(new) == ["blobs", "sceneprint.db"]
    original = content(data)
    orphan = hashlib.sha256(b"nothing refers to this").hexdigest()
    del original[f"blobs/{orphan[:2]}/{orphan}"]
    assert content(new) == original
    asked = uploads[:8]
    told = answers(data, asked)
    assert {one.status for one in told} >= {"found"}
    assert answers(new, asked) == told
    with Engine(settings(new)) as engine:  # the frame that waited is signed, and found
        work = engine.claim("w")
        assert work is not None
        assert engine.run(work) == "succeeded"
        assert engine.get_map("hall").frames == {"deleted": 1, "indexed": 5}
        assert [key.name for key in list_keys(engine.store).items] == ["robot"]
    assert snapshot.manifest.n_frames == 5


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_a_snapshot_of_a_snapshot_is_the_same(archive, tmp_path, settings):
    """Byte for byte, but for the manifest and the time in the headers."""
    restore_snapshot(archive, tmp_path / "new")
    take_snapshot(settings(tmp_path / "new"), tmp_path / "again.tar")
    members = []
    for path in (archive, tmp_path / "again.tar"):
        with tarfile.open(path) as tar:
            members.append([(one.name, tar.extractfile(one).read()) for one in tar][2:])
    assert members[0] == members[1]


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_the_commands(master, tmp_path, sceneprint, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = sceneprint("snapshot", "--data", master)
    (name,) = names_in(tmp_path)
    assert re.fullmatch(r"sceneprint-\d{8}T\d{6}Z\.tar", name)
    size = f"{(tmp_path / name).stat().st_size / 1e6:,.1f} MB"
    held = f"1 maps, 5 frames, 9 blobs, {size}"
    assert re.fullmatch(rf"{re.escape(f'{name}: {held}')} in \d+\.\d s\n", said.stdout)
    assert said.stderr == ""
    (tmp_path / "folder").mkdir()
    sceneprint("snapshot", "--data", master, "--out", "folder")
    assert len(names_in(Path("folder"))) == 1
    before = (tmp_path / name).read_bytes()
    assert (
        "nothing is overwritten"
        in sceneprint("snapshot", "--data", master, "--out", name, expect=2).stderr
    )
    assert (tmp_path / name).read_bytes() == before
    said = sceneprint("restore", "--verify-only", name)
    assert re.fullmatch(rf"{name} is complete: {held} of \S{{20}} in \d+\.\d s\n", said.stdout)
    said = sceneprint("restore", name, "--data", "new")
    assert said.stdout.startswith(f"{name} is restored to new: {held} of ")
    assert names_in(tmp_path) == sorted([name, "folder", "new"])


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_it_is_in_nobodys_way(data, tmp_path, settings):
    """Taken while somebody holds the right to write, with his changes not yet committed."""
    with closing(sqlite3.connect(data / "sceneprint.db", isolation_level=None)) as writer:
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("UPDATE maps SET title = 'half done'")
        taken = take_snapshot(settings(data), tmp_path / "a.tar")
        writer.execute("COMMIT")
    assert taken.damaged == []
    restore_snapshot(tmp_path / "a.tar", tmp_path / "new")
    with closing(sqlite3.connect(tmp_path / "new" / "sceneprint.db")) as new:
        assert new.execute("SELECT title FROM maps").fetchall() == [(None,)]


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_damaged_blobs_are_left_out_and_named(data, tmp_path, sceneprint, rows, settings):
    (first, second) = rows(data, "SELECT id, blob FROM frames WHERE state = 'indexed' LIMIT 2")
    ((artifact,),) = rows(
        data, "SELECT geometry FROM signatures JOIN frames ON number = frame_number"
        f" WHERE id = '{second[0]}'"
    )  # fmt: skip
    path = data / "blobs" / first[1][:2] / first[1]
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    (data / "blobs" / artifact[:2] / artifact).unlink()
    out = tmp_path / "a.tar"
    said = sceneprint("snapshot", "--data", data, "--out", out, expect=1)
    lines = sorted(
        [
            f"not in it: blob {first[1][:12]}, damaged",
            f"not in it: blob {artifact[:12]}, missing",
        ]
    )
    told = said.stderr.splitlines()
    assert told[:-1] == lines
    assert (
        told[-1]
        == "Everything else is included. Run `sceneprint fsck` to see what can be repaired."
    )
    with tarfile.open(out) as tar:
        names = tar.getnames()
        listed = [json.loads(line) for line in tar.extractfile("damaged.jsonl")]
    assert len([name for name in names if name.startswith("blobs/")]) == 7
    assert listed == sorted(
        [
            {"digest": first[1], "why": "damaged"},
            {"digest": artifact, "why": "missing"},
        ],
        key=lambda one: one["digest"],
    )
    assert sceneprint("restore", "--verify-only", out, expect=1).stderr.splitlines()[:-1] == lines
    said = sceneprint("restore", out, "--data", tmp_path / "new", expect=1)
    assert said.stderr.splitlines()[:-1] == lines
    with Engine(settings(tmp_path / "new")) as engine:
        assert len(engine.list_frames("hall").items) == 5
        assert len(list(engine.store.blobs.digests())) == 7


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_what_cannot_be_taken(data, tmp_path, sceneprint, monkeypatch):
    def refused(text: str, folder: Path = data) -> None:
        said = sceneprint("snapshot", "--data", folder, "--out", tmp_path / "a.tar", expect=2)
        assert text in said.stderr
        assert names_in(tmp_path) == ["data"]

    refused("there is no database", tmp_path / "typo")
    said = sceneprint("snapshot", "--data", data, "--out", tmp_path / "no" / "a.tar", expect=2)
    assert "No such file or directory" in said.stderr
    monkeypatch.setenv("SCENEPRINT_DATABASE_URL", "postgresql://u:secret@127.0.0.1:1/maps")
    said = sceneprint("snapshot", "--data", data, "--out", tmp_path / "a.tar", expect=2)
    assert "postgresql://u@127.0.0.1:1/maps: connection failed" in said.stderr
    assert "secret" not in said.stderr
    monkeypatch.setenv("SCENEPRINT_DATABASE_URL", f"sqlite:///{tmp_path}/other.db")
    said = sceneprint("restore", tmp_path / "a.tar", "--data", tmp_path / "new", expect=2)
    assert "SCENEPRINT_DATABASE_URL is set" in said.stderr
    monkeypatch.delenv("SCENEPRINT_DATABASE_URL")
    with closing(sqlite3.connect(data / "sceneprint.db")) as database:
        database.execute("UPDATE alembic_version SET version_num = '9999'")
        database.commit()
    refused("9999")
    with closing(sqlite3.connect(data / "sceneprint.db")) as database:
        database.execute("DROP TABLE alembic_version")
        database.commit()
    refused("no database of sceneprint")
    (data / "sceneprint.db").write_bytes(b"SQLite format 3\0" + bytes(5000))
    refused("the database cannot be copied")


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_a_database_that_could_not_be_restored_is_not_taken(data, tmp_path, settings):
    with closing(sqlite3.connect(data / "sceneprint.db")) as database:
        database.execute("DELETE FROM maps")  # foreign keys are not looked after here
        database.commit()
    with pytest.raises(UnusableStore, match=r"a row of (frames|jobs) refers to one of maps .*fsck"):
        take_snapshot(settings(data), tmp_path / "a.tar")
    assert names_in(tmp_path) == ["data"]


AS_NOBODY = """
import os, sys
from pathlib import Path
from sceneprint.maintenance.snapshot.creation import take_snapshot
from sceneprint.settings import Settings
os.setgroups([]), os.setgid(65534), os.setuid(65534)
folder = Path(sys.argv[1])
settings = Settings(data_dir=folder / "data", database_url=None)
taken = take_snapshot(settings, folder / "out" / "a.tar")
print(taken.manifest.blobs.count, len(taken.damaged))
"""


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_a_read_only_folder_can_be_taken(master):
    """By another user, who may write nothing there; nor is anything written."""
    with tempfile.TemporaryDirectory() as name:  # pytest's own folders are closed to others
        folder = Path(name)
        folder.chmod(0o755)
        data, out = Path(shutil.copytree(master, folder / "data")), folder / "out"
        out.mkdir()
        out.chmod(0o777)
        for path in (data, *data.rglob("*")):  # of its owner alone, as it was made
            path.chmod(0o755 if path.is_dir() else 0o644)
        before = names_in(data)
        done = subprocess.run(
            [sys.executable, "-c", AS_NOBODY, name], capture_output=True, text=True
        )
        assert done.stdout == "9 0\n", done.stderr
        assert names_in(data) == before
        assert verify_snapshot(out / "a.tar").manifest.blobs.count == 9


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_large_blobs_go_in_parts(data, tmp_path, settings, rows, monkeypatch):
    """The same archive, and the same that is left out of it."""
    [(lost,), (broken,), *_] = rows(
        data, "SELECT DISTINCT blob FROM frames WHERE state <> 'deleted'"
    )
    (data / "blobs" / lost[:2] / lost).unlink()
    (data / "blobs" / broken[:2] / broken).write_bytes(b"no picture, and no small one either")
    asked: list[str] = []
    monkeypatch.setattr(FolderBlobs, "open", _told(FolderBlobs.open, asked))
    small = take_snapshot(settings(data), tmp_path / "small.tar")
    assert asked == []
    monkeypatch.setattr(creation, "_LARGE", 20)
    large = take_snapshot(settings(data), tmp_path / "large.tar")
    assert len(asked) == large.manifest.blobs.count == small.manifest.blobs.count > 0
    assert large.damaged == small.damaged
    assert {one.digest: one.why for one in large.damaged} == {lost: "missing", broken: "damaged"}
    held = []
    for name in ("small.tar", "large.tar"):
        with tarfile.open(tmp_path / name) as tar:
            held.append({one.name: tar.extractfile(one).read() for one in tar.getmembers()[2:]})
    assert held[0] == held[1]


def _told(call: Callable[..., object], names: list[str]) -> Callable[..., object]:
    def told(blobs: object, digest: str) -> object:
        names.append(digest)
        return call(blobs, digest)

    return told


def test_interrupted_it_leaves_nothing(master, tmp_path, settings):
    def stop(done: int, total: int) -> None:
        if done > total // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        take_snapshot(settings(master), tmp_path / "a.tar", stop)
    assert names_in(tmp_path) == []
    take_snapshot(settings(master), tmp_path / "a.tar")
    with pytest.raises(KeyboardInterrupt):
        restore_snapshot(tmp_path / "a.tar", tmp_path / "new", progress=stop)
    assert names_in(tmp_path) == ["a.tar"]


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_progress_goes_from_nothing_to_all(master, tmp_path, settings):
    seen: list[tuple[int, int]] = []
    take_snapshot(settings(master), tmp_path / "a.tar", lambda *one: seen.append(one))
    done = [one for one, _ in seen]
    assert done == sorted(done)
    assert len({total for _, total in seen}) == 1
    assert done[-1] == seen[0][1]
    seen.clear()
    verify_snapshot(tmp_path / "a.tar", lambda *one: seen.append(one))
    assert 0 < seen[0][0] < seen[-1][0] <= (tmp_path / "a.tar").stat().st_size == seen[0][1]


@pytest.fixture
def longest_file() -> Iterator[Callable[[int], None]]:
    """Let no file of this process grow beyond a limit, as on a disk that becomes full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_where_there_is_no_room(master, archive, tmp_path, sceneprint, longest_file):
    """In the copy of the database, in the archive, and in a blob that is unpacked."""
    database = (master / "sceneprint.db").stat().st_size
    between = (database + archive.stat().st_size) // 2
    snapshot = ("snapshot", "--data", master, "--out", tmp_path / "a.tar")
    restore = ("restore", archive, "--data", tmp_path / "new")
    for size, arguments, text in (
        (database // 2, snapshot, "the database cannot be copied"),
        (
            between,
            snapshot,
            "a.tar: cannot be written (File too large)",
        ),
        (database // 2, restore, "new: cannot be written (File too large)"),
    ):
        longest_file(size)
        said = sceneprint(*arguments, expect=2)
        assert text in said.stderr
        assert names_in(tmp_path) == []


def test_errors_that_are_meant(tmp_path, archive):
    for name, data in (("png", b"\x89PNG" + bytes(5000)), ("none", b""), ("short", bytes(100))):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(SnapshotError, match="no snapshot of sceneprint"):
            verify_snapshot(tmp_path / name)
    with pytest.raises(SnapshotError, match="there is no such file"):
        verify_snapshot(tmp_path)
