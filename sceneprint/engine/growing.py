"""The tail of a reader while it grows: appended to behind what has been handed out of it."""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UnusableStore
from sceneprint.index import Tail
from sceneprint.store.signatures import Change
from sceneprint.types import Bytes

#: Bytes of signatures up to which they are held in memory. More go to a file that has no name,
#: whose pages the kernel drops and reads again as it likes: a map that has lost its index is
#: scanned whole, and may be larger than the machine's memory.
IN_MEMORY = 256 << 20


class Growing:
    """Signatures in the order of their revisions; what is handed out never changes.

    Parameters
    ----------
    length : bytes of a signature
    folder : where a file for many of them may be made; the system's for temporary files where
        that one cannot be written
    capacity : signatures to make room for at first
    """

    def __init__(self, length: int, folder: Path, capacity: int = 64) -> None:
        self._folder, self._capacity = folder, max(capacity, 64)
        self._keys: NDArray[np.int64] = np.empty(self._capacity, np.int64)
        self._revisions: NDArray[np.int64] = np.empty(self._capacity, np.int64)
        self._rows = self._room(self._capacity, length)
        self._places: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, key: int) -> bool:
        return key in self._places

    @property
    def bytes_held(self) -> int:
        """Memory that the signatures take and nobody but this process can give back."""
        return self._rows.nbytes if self._rows.nbytes <= IN_MEMORY else 0

    def reserve(self, more: int) -> None:
        """Make room for that many more at once: growing step by step would copy all each time.

        Raises
        ------
        UnusableStore : there is no room on the disk.
        """
        n = len(self)
        if n + more > self._capacity:
            length = self._rows.shape[1]
            # twice as many, but no more than memory would be used for at once
            step = min(self._capacity, max(IN_MEMORY // length, 64))
            capacity = max(n + more, self._capacity + step)
            rows = self._room(capacity, length)  # where this fails, all is as it was
            rows[:n] = self._rows[:n]  # views keep the old arrays
            new = np.empty(capacity - n, np.int64)
            self._keys = np.concatenate([self._keys[:n], new])
            self._revisions = np.concatenate([self._revisions[:n], new])
            self._capacity, self._rows = capacity, rows

    def append(self, change: Change, row: Bytes) -> None:
        """Take the signature of a frame that is not there yet."""
        self.reserve(1)
        n = len(self)
        self._keys[n], self._revisions[n], self._rows[n] = change.number, change.revision, row
        self._places[change.number] = n

    def after(self, revision: int) -> Growing:
        """Those indexed after a revision, in arrays of their own."""
        return self._only(self._revisions[: len(self)] > revision)

    def without(self, keys: Collection[int]) -> Growing:
        """All but some, in arrays of their own."""
        return self._only(~np.isin(self._keys[: len(self)], list(keys)))

    def _only(self, wanted: NDArray[np.bool_]) -> Growing:
        places = np.flatnonzero(wanted)
        n = len(places)
        kept = Growing(self._rows.shape[1], self._folder, n)
        kept._keys[:n], kept._revisions[:n] = self._keys[places], self._revisions[places]
        np.take(self._rows, places, axis=0, out=kept._rows[:n], mode="clip")  # no copy beside
        kept._places = {key: place for place, key in enumerate(kept._keys[:n].tolist())}
        return kept

    def revision_of(self, key: int) -> int:
        """The revision with which the signature of a frame came; 0 where it is not there."""
        place = self._places.get(key)
        return 0 if place is None else int(self._revisions[place])

    def tail(self) -> Tail:
        """All that is there now."""
        n = len(self)
        return Tail(self._keys[:n], self._rows[:n])

    def _room(self, capacity: int, length: int) -> Bytes:
        size = capacity * length
        if size <= IN_MEMORY:
            return np.empty((capacity, length), np.uint8)
        mapped = _nameless(self._folder, size)
        return np.frombuffer(mapped, np.uint8).reshape(capacity, length)


def _nameless(folder: Path, size: int) -> mmap.mmap:
    """A file of that size, mapped, that the kernel removes with its last user."""
    failed: OSError | None = None
    for place in (folder, Path(tempfile.gettempdir())):
        try:
            place.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=place) as file:
                # set aside now: a page that has no room when it is written kills the process
                os.posix_fallocate(file.fileno(), 0, size)
                return mmap.mmap(file.fileno(), size)
        except OSError as error:
            failed = error
    raise UnusableStore(
        f"{folder}: no room for {size >> 20} MB of signatures that no index holds "
        f"({failed and failed.strerror}). Free some space, or let a worker publish an index."
    ) from failed
