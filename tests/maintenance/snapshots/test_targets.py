"""Where a snapshot is restored to: nothing is overwritten, nothing removed, nothing half there."""

from __future__ import annotations

import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from sceneprint.engine import Engine
from sceneprint.errors import SnapshotError
from sceneprint.maintenance.snapshot.restoration import RestoreTarget, restore_snapshot

#: Holds the database as an idle service does, and as any other reader.
ENGINE = """
import sys
from pathlib import Path
from sceneprint.engine import Engine
from sceneprint.settings import Settings
with Engine(Settings(data_dir=Path(sys.argv[1]), database_url=None)) as engine:
    print("held", flush=True)
    sys.stdin.read()
"""

READER = """
import sqlite3, sys
database = sqlite3.connect(sys.argv[1] + "/sceneprint.db")
database.execute("SELECT * FROM maps").fetchall()
print("held", flush=True)
sys.stdin.read()
"""

MOUNTED = """
import os, subprocess, sys
from pathlib import Path
from sceneprint.errors import SnapshotError
from sceneprint.maintenance.snapshot.restoration import restore_snapshot
from sceneprint.maintenance.snapshot.creation import take_snapshot
from sceneprint.settings import Settings

archive, folder = map(Path, sys.argv[1:])
volume, small = folder / "volume", folder / "small"
for place, size in ((volume, "64m"), (small, "100k")):
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", place], check=True)
(volume / "lost+found").mkdir()
restore_snapshot(archive, volume)
print(sorted(os.listdir(volume)))
for attempt in (
    lambda: restore_snapshot(archive, volume, replace=True),
    lambda: restore_snapshot(archive, small),
    lambda: take_snapshot(Settings(data_dir=volume, database_url=None), small / "a.tar"),
):
    try:
        attempt()
    except SnapshotError as error:
        print(error)
    print(sorted(os.listdir(volume)), os.listdir(small))
"""


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_what_is_there_stays(archive, data, tmp_path, content, sceneprint):
    before = content(data)
    said = sceneprint("restore", archive, "--data", data, expect=2)
    assert "data holds blobs, sceneprint.db" in said.stderr
    assert "--replace" in said.stderr
    (tmp_path / "notes").mkdir()
    for name in "dcba":
        (tmp_path / "notes" / name).touch()
    said = sceneprint("restore", archive, "--data", tmp_path / "notes", expect=2)
    assert "notes holds a, b, c and 1 more" in said.stderr
    (tmp_path / "file").write_bytes(b"x")
    for flags in ([], ["--replace"]):
        said = sceneprint("restore", archive, "--data", tmp_path / "file", *flags, expect=2)
        assert "file is no folder" in said.stderr
    assert names_in(tmp_path) == ["data", "file", "notes"]
    assert content(data) == before


def test_an_empty_folder_is_filled_and_stays_the_same_one(archive, tmp_path, content):
    """It may be a mount, a link, or have its owner and mode for a reason."""
    folder, link = tmp_path / "folder", tmp_path / "link"
    folder.mkdir(0o750)
    link.symlink_to(folder)
    before = folder.stat().st_ino
    restore_snapshot(archive, link)
    assert link.is_symlink()
    assert (folder.stat().st_ino, folder.stat().st_mode & 0o777) == (before, 0o750)
    assert names_in(folder) == ["blobs", "sceneprint.db"]
    restore_snapshot(archive, tmp_path / "new")
    assert content(folder) == content(tmp_path / "new")


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_replaced_it_is_moved_aside(archive, data, tmp_path, content, sceneprint, rows):
    rows(data, "UPDATE maps SET title = 'as it was'")
    (data / "index").mkdir()
    (data / "note").write_text("mine")
    data.chmod(0o710)
    before = content(data)
    said = sceneprint("restore", archive, "--data", data, "--replace")
    (aside,) = set(names_in(tmp_path)) - {"data"}
    assert aside.startswith("data.before-2")
    assert said.stderr == f"the previous contents are now in {tmp_path / aside}\n"
    assert content(tmp_path / aside) == before
    assert (tmp_path / aside / "note").read_text() == "mine"
    assert names_in(data) == ["blobs", "sceneprint.db"]
    assert data.stat().st_mode & 0o777 == 0o710
    assert rows(data, "SELECT title FROM maps") == [(None,)]


def test_a_link_to_it_stays_one(archive, data, tmp_path, content):
    before, link = content(data), tmp_path / "elsewhere" / "link"
    link.parent.mkdir()
    link.symlink_to(data)
    _, aside = restore_snapshot(archive, link, replace=True)
    assert aside is not None
    assert aside.parent == tmp_path
    assert content(aside) == before
    assert names_in(link.parent) == ["link"]
    assert link.is_symlink()
    assert names_in(link) == ["blobs", "sceneprint.db"]


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_in_use_it_is_not_replaced(archive, data, tmp_path, sceneprint):
    with subprocess.Popen(
        [sys.executable, "-c", ENGINE, str(data)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as holder:  # fmt: skip
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        said = sceneprint("restore", archive, "--data", data, "--replace", expect=2)
        assert "data is in use" in said.stderr
        assert names_in(tmp_path) == ["data"]
        holder.communicate()
    sceneprint("restore", archive, "--data", data, "--replace")
    assert len(names_in(tmp_path)) == 2


@contextmanager
def in_the_way(path: Path):
    """Something comes to be at a path when most of an archive has been read."""

    def come(done: int, total: int) -> None:
        if done > total // 2 and not path.exists():
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(b"somebody else's")

    yield come
    assert path.read_bytes() == b"somebody else's"


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("name", ["sceneprint.db", "blobs", "other"])
def test_somebody_else_is_faster(archive, tmp_path, exists, name):
    folder = tmp_path / "new"
    if exists:
        folder.mkdir()
    with in_the_way(folder / name) as come:
        if exists and name == "other":  # a file that does no harm
            restore_snapshot(archive, folder, progress=come)
            assert names_in(folder) == ["blobs", "other", "sceneprint.db"]
        else:
            with pytest.raises(SnapshotError, match="cannot be put there"):
                restore_snapshot(archive, folder, progress=come)
            assert names_in(folder) == [name]
    assert names_in(tmp_path) == ["new"]


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_a_replacement_that_fails_is_undone(archive, data, tmp_path, content):
    """The database is opened at the last moment, by nobody who could be seen before."""
    before, holders = content(data), []

    def come(done: int, total: int) -> None:
        if not holders:
            holders.append(
                subprocess.Popen(
                    [sys.executable, "-c", READER, str(data)],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                )
            )  # fmt: skip
            assert holders[0].stdout.readline() == "held\n"

    with pytest.raises(SnapshotError, match="in use"):
        restore_snapshot(archive, data, replace=True, progress=come)
    holders[0].communicate()
    assert names_in(tmp_path) == ["data"]
    assert content(data) == before


def test_what_was_moved_aside_comes_back(data, tmp_path, content):
    """What should take its place goes with it, and is then not where it was."""
    before = content(data)
    with pytest.raises(SnapshotError, match="Nothing was changed"):
        RestoreTarget(data, replace=True).put(
            data / "blobs", blobs="blobs", database="sceneprint.db"
        )
    assert names_in(tmp_path) == ["data"]
    assert content(data) == before


def test_what_killed_ones_have_left_is_removed_and_nothing_else(archive, tmp_path):
    """Known by its name, and by nobody holding it."""
    folder = tmp_path / "new"
    names = [
        "new.restoring-0123456789ab",
        "new.restoring-0123456789abc",
        "old.restoring-0123456789ab",
    ]
    for name in names:
        (tmp_path / name / "blobs").mkdir(parents=True)
    restore_snapshot(archive, folder)
    assert names_in(tmp_path) == ["new", *names[1:]]
    (tmp_path / "empty" / ".restoring-0123456789ab").mkdir(parents=True)
    restore_snapshot(archive, tmp_path / "empty")
    assert names_in(tmp_path / "empty") == ["blobs", "sceneprint.db"]


def test_two_at_once_leave_each_other_alone(archive, tmp_path):
    """A restore that begins while another is under way; the first to end has the name."""
    inner: list[object] = []

    def come(done: int, total: int) -> None:
        if not inner:
            inner.append(None)
            inner[0] = restore_snapshot(archive, tmp_path / "new")

    with pytest.raises(SnapshotError, match="cannot be put there"):
        restore_snapshot(archive, tmp_path / "new", progress=come)
    assert inner[0] is not None
    assert names_in(tmp_path) == ["new"]


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_a_mount_is_filled_and_never_moved(archive, tmp_path):
    if subprocess.run(["unshare", "-rm", "true"], capture_output=True).returncode != 0:
        pytest.skip("this machine lets nobody mount anything")
    done = subprocess.run(
        ["unshare", "-rm", sys.executable, "-c", MOUNTED, str(archive), str(tmp_path)],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    held = "['blobs', 'lost+found', 'sceneprint.db']"
    assert lines[0] == held
    assert "is a mount of its own" in lines[1]
    assert "small: what is in the snapshot takes" in lines[3]
    assert "small: a snapshot of the database alone takes" in lines[5]
    assert lines[2::2] == [f"{held} []"] * 3


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_restored_by_the_command_it_serves(archive, tmp_path, settings):
    restore_snapshot(archive, tmp_path / "a" / "b")
    with Engine(settings(tmp_path / "a" / "b")) as engine:
        assert [one.name for one in engine.list_maps().items] == ["hall"]
