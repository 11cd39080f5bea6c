"""Tests of atomic file writes: order of operations, and remains after a failure."""

import errno
import os
import stat
from pathlib import Path

import pytest

from sceneprint.atomic_files import whole_file, write_durable, write_whole


@pytest.fixture
def calls(monkeypatch):
    """What is synced and renamed, in order, with what the file held at that moment."""
    seen = []
    fsync, replace = os.fsync, os.replace

    def recording_fsync(number):
        name = Path(f"/proc/self/fd/{number}").readlink()
        folder = stat.S_ISDIR(os.fstat(number).st_mode)
        seen.append(("fsync", str(name), b"" if folder else name.read_bytes()))
        fsync(number)

    def recording_replace(source, target):
        seen.append(("replace", str(target), Path(source).read_bytes()))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", recording_fsync)
    monkeypatch.setattr(os, "replace", recording_replace)
    return seen


def test_a_durable_file_is_synced_before_its_name_and_the_name_after(tmp_path, calls):
    folder = tmp_path / "new"
    folder.mkdir()
    write_durable(folder / "a", b"content" * 9000)
    assert (folder / "a").read_bytes() == b"content" * 9000
    assert [p.name for p in folder.iterdir()] == ["a"]
    part = calls[0][1]
    assert Path(part).parent == folder
    assert part.endswith(".part")
    assert calls == [
        ("fsync", part, b"content" * 9000),  # flushed: all of it is there to be synced
        ("replace", str(folder / "a"), b"content" * 9000),
        ("fsync", str(folder), b""),
        ("fsync", str(tmp_path), b""),
    ]


@pytest.mark.parametrize("write", [write_whole, write_durable])
def test_the_old_file_stays_until_the_new_one_is_whole(tmp_path, write, monkeypatch):
    path = tmp_path / "a"
    write(path, b"old")

    def fail(*_):
        assert path.read_bytes() == b"old"
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="No space left on device") as caught:
        write(path, b"new")
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(path))
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("which", [0, 1])
def test_a_name_that_cannot_be_made_durable_is_an_error(tmp_path, which, monkeypatch):
    folder = tmp_path / "new"
    folder.mkdir()
    fsync = os.fsync
    left = [which]

    def fail(number):
        if stat.S_ISDIR(os.fstat(number).st_mode):
            if left[0] == 0:
                raise OSError(errno.EIO, "Input/output error")
            left[0] -= 1
        fsync(number)

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="Input/output error") as caught:
        write_durable(folder / "a", b"content")
    named = (folder, tmp_path)[which]
    assert (caught.value.errno, caught.value.filename) == (errno.EIO, str(named))
    assert [path.name for path in folder.iterdir()] == ["a"]  # whole, and no part of it beside


@pytest.mark.parametrize("write", [write_whole, write_durable])
def test_an_interruption_leaves_nothing(tmp_path, write, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "a", b"content")
    assert list(tmp_path.iterdir()) == []


def test_a_library_writes_beside_the_file(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"old")
    with whole_file(path) as part:
        part.write_bytes(b"new")
        assert path.read_bytes() == b"old"
        assert part.parent == tmp_path
    assert path.read_bytes() == b"new"
    with whole_file(path):
        pass  # nothing was written, so nothing changes

    def interrupted():
        with whole_file(path) as part:
            part.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a", b"new")]
