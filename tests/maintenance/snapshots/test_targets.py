"""Where a snapshot is restored to: nothing is overwritten, nothing removed, nothing half there."""

from __future__ import annotations

import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from sceneprint.engine import Engine
from sceneprint.errors import SnapshotError
from sceneprint.maintenance.snapshot.restoration import restore_snapshot

#: Holds the database as an idle service does, and as any other reader.
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
    (tmp_path / "notes").mkdir()
    for name in "dcba":
        (tmp_path / "notes" / name).touch()
    said = sceneprint("restore", archive, "--data", tmp_path / "notes", expect=2)
    assert "notes holds a, b, c and 1 more" in said.stderr
    (tmp_path / "file").write_bytes(b"x")
    said = sceneprint("restore", archive, "--data", tmp_path / "file", expect=2)
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
    assert "small: what is in the snapshot takes" in lines[1]
    assert "small: a snapshot of the database alone takes" in lines[3]
    assert lines[2::2] == [f"{held} []"] * 2


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_restored_by_the_command_it_serves(archive, tmp_path, settings):
    restore_snapshot(archive, tmp_path / "a" / "b")
    with Engine(settings(tmp_path / "a" / "b")) as engine:
        assert [one.name for one in engine.list_maps().items] == ["hall"]
