"""Simulation of a disk that loses power: all that was not synced is undone.

The content of a file is durable as of its last fsync. A created, changed or removed name is durable
once its folder is synced.
"""

import os
import shutil
import signal
import threading
from contextlib import suppress
from pathlib import Path

#: Beginning of the names of files that SQLite writes and syncs itself.
_DATABASE = "sceneprint.db"


class CutDisk:
    """A folder, what of it is durable, and a power cut. The initial content is durable.

    Contents are bytes of a file, or names and targets of a folder.
    """

    def __init__(self, root):
        self._root = root.resolve()
        self._lock = threading.RLock()  # a restore writes in several threads
        self._ids: dict[int, int] = {}  # for files with a name, since inode numbers are reused
        self._count, self._seen = 0, dict[int, bytes | dict[str, int]]()
        self._top = self._id_of(self._root.stat().st_ino)
        self.look()
        self._sure = dict(self._seen)

    def _id_of(self, real):
        if real not in self._ids:
            self._ids[real] = self._count = self._count + 1
        return self._ids[real]

    def look(self):
        """Record the visible state of the folder."""
        with self._lock:
            while True:
                with suppress(FileNotFoundError):  # another thread has moved or removed a file
                    self._read()
                    return

    def _read(self):
        named = {self._root.stat().st_ino}
        for place, _, _ in os.walk(self._root):
            names = {}
            with os.scandir(place) as entries:
                for each in entries:
                    names[each.name] = at = self._id_of(each.inode())
                    named.add(each.inode())
                    self._seen[at] = {} if each.is_dir() else Path(each.path).read_bytes()
            self._seen[self._ids[Path(place).stat().st_ino]] = names
        self._ids = {real: at for real, at in self._ids.items() if real in named}

    def synced(self, descriptor):
        with self._lock:
            self.look()
            result = os.fstat(descriptor)
            at = self._ids.get(result.st_ino)
            if at is not None and result.st_dev == self._root.stat().st_dev:
                self._sure[at] = self._seen[at]

    def _durable(self, folder, path):
        """Yield paths and durable contents; None for a folder, which precedes its own."""
        for name, at in self._sure.get(folder, {}).items():
            if isinstance(self._seen[at], dict):
                yield f"{path}{name}", None
                yield from self._durable(at, f"{path}{name}/")
            else:
                yield f"{path}{name}", self._sure.get(at, b"")

    def cut(self):
        """Undo all that was not synced, and kill this process. SQLite syncs its files itself."""
        self.look()
        tree = dict(self._durable(self._top, ""))
        for path in sorted(self._root.rglob("*"), reverse=True):
            if str(path.relative_to(self._root)) in tree or path.name.startswith(f"{_DATABASE}-"):
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        for name, content in tree.items():
            path = self._root / name
            if content is None:
                path.mkdir(exist_ok=True)
            elif not path.name.startswith(_DATABASE) or not path.exists():
                path.write_bytes(content)
        os.kill(os.getpid(), signal.SIGKILL)
