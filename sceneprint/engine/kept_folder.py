"""Answers that are kept in a folder which the processes of one machine share."""

from __future__ import annotations

import logging
import os
import threading
import time
from pathlib import Path

from sceneprint.engine.kept import (
    DAMAGED,
    HEAD,
    ID,
    MOST_QUERIES,
    Kept,
    Stands,
    read,
    read_head,
    unknown_query,
    written,
)
from sceneprint.writing import write_whole

log = logging.getLogger(__name__)

#: Answers after which a process looks at the folder again, for what others have put there.
_LOOK = 16
#: Share of the bounds that is left after removing: not every answer should remove one.
_LEAVE = 0.9
#: Seconds after which half a file is of a process that died.
_ABANDONED_S = 60.0


class KeptFolder:
    """A folder of answers.

    Parameters
    ----------
    folder : made when the first answer is kept
    seconds : how long each is kept
    most_bytes : of all together; 0 keeps none
    stands : whether one that is found may still be looked at
    """

    def __init__(
        self, folder: Path, seconds: float, most_bytes: int, stands: Stands = lambda _: True
    ) -> None:
        self._stands = stands
        self._folder, self._seconds, self._most = folder, seconds, most_bytes
        self._lock = threading.Lock()
        self._left = 0  # answers until the folder is looked at again
        self._room = 0  # bytes until then
        self._refused = False  # whether the last answer could not be kept

    def keep(self, kept: Kept) -> bool:
        """Keep an answer; False where that cannot be done, which is nobody's error."""
        data = written(kept)
        if len(data) > self._most:
            return False
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._make_room(len(data))
            write_whole(self._folder / kept.answer.query_id, data)
        except OSError as error:  # a full disk, a folder that may only be read
            if not self._refused:  # once, and not with every query
                log.warning("answers cannot be kept", extra={"error": str(error)})
            self._refused = True
            return False
        self._refused = False
        return True

    def find(self, query_id: str) -> Kept:
        """The answer of that id; see `KeptQueries.find`."""
        if ID.fullmatch(query_id):
            try:
                path = self._folder / query_id
                if path.stat().st_mtime + self._seconds > time.time():
                    found = read(path.read_bytes())
                    if self._stands(found):
                        return found
            except (OSError, *DAMAGED):
                pass
        raise unknown_query(query_id)

    def forget(self, stands: Stands) -> int:
        """Remove what is too old, or does not stand; see `KeptQueries.forget`."""
        gone = 0
        for name in os.listdir(self._folder) if self._folder.is_dir() else ():  # noqa: PTH208
            path = self._folder / name
            try:
                if ID.fullmatch(name) and not self._keeps(path, stands):
                    path.unlink(missing_ok=True)
                    gone += 1
            except OSError:  # another process has removed it, or it cannot be
                continue
        return gone

    def _keeps(self, path: Path, stands: Stands) -> bool:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_mtime + self._seconds <= time.time():
                return False
            try:
                beginning = file.read(HEAD)
                found = read_head(beginning, lambda n: beginning + file.read(n - len(beginning)))
            except DAMAGED:
                return False
        return stands(found)

    def _make_room(self, size: int) -> None:
        """Remove what is too old, and the oldest of what is too much."""
        with self._lock:
            self._left -= 1
            self._room -= size
            if self._left >= 0 and self._room >= 0:
                return
            files, now = [], time.time()
            with os.scandir(self._folder) as entries:
                for entry in entries:
                    try:
                        found = entry.stat(follow_symlinks=False)
                    except FileNotFoundError:  # another process has removed it
                        continue
                    whole = ID.fullmatch(entry.name) is not None
                    age = now - found.st_mtime
                    if age > (self._seconds if whole else _ABANDONED_S):
                        _remove(entry.path)
                    elif whole:
                        files.append((found.st_mtime_ns, found.st_size, entry.path))
            files.sort(reverse=True)
            total, fits = size, 0
            for _, one, _ in files:
                if total + one > self._most or fits + 1 >= MOST_QUERIES:
                    break
                total, fits = total + one, fits + 1
            if fits < len(files):  # make room for the next ones too
                while fits and (total > _LEAVE * self._most or fits > _LEAVE * MOST_QUERIES):
                    fits -= 1
                    total -= files[fits][1]
            for _, _, path in files[fits:]:
                _remove(path)
            self._left, self._room = _LOOK, self._most - total


def _remove(path: str) -> None:
    Path(path).unlink(missing_ok=True)
