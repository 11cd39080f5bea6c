"""Recordings of the file operations of code under test, and folders after a loss of power.

The code writes real files. An audit hook and `os.fsync` record the order of operations.
"""

import os
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.faults.disk import Disk

_EVENTS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.truncate")
#: The active disk; audit hooks cannot be removed.
_listening = []


@pytest.fixture(scope="session")
def _hooked():
    def hook(event, arguments):
        if event not in _EVENTS or not _listening:
            return
        disk = _listening.pop()  # this code opens files itself
        try:
            if event == "open" and not arguments[2] & (os.O_CREAT | os.O_TRUNC):
                return
            places = [os.fsdecode(one) for one in arguments if isinstance(one, str | bytes)]
            if any(Path(place).absolute().is_relative_to(disk.root) for place in places):
                disk.about_to(event)
        finally:
            _listening.append(disk)

    sys.addaudithook(hook)


@pytest.fixture
def recorded(_hooked, monkeypatch):
    """`with recorded(folder) as disk:` records this thread's file operations in a folder."""
    fsync, fdatasync = os.fsync, os.fdatasync

    def listen(after):
        def sync(file):
            number = file if isinstance(file, int) else file.fileno()
            after(number)
            if _listening:
                disk = _listening.pop()
                try:
                    disk.synced(number)
                finally:
                    _listening.append(disk)

        return sync

    monkeypatch.setattr(os, "fsync", listen(fsync))
    monkeypatch.setattr(os, "fdatasync", listen(fdatasync))

    @contextmanager
    def record(root, deaf=""):
        assert not _listening
        disk = Disk(root, deaf)
        _listening.append(disk)
        try:
            yield disk
        finally:
            _listening.clear()
            disk.mark("end")

    return record


@pytest.fixture
def after_crash(tmp_path):
    """A function that creates the folder after a crash with a new name, as files may be mapped."""
    made = iter(range(1_000_000))

    def make(tree):
        root = tmp_path / f"crashed-{next(made)}"
        root.mkdir()
        for name, content in tree.items():  # folders before their content
            if content is None:
                (root / name).mkdir()
            else:
                (root / name).write_bytes(content)
        return root

    return make
