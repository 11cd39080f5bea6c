"""Who needs blobs kept, and who may remove some: one lock for all processes that share them.

The lock of a process that dies is free at once: the kernel releases that of a file, and the
server that of a connection.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from sceneprint.errors import UnusableStore

if TYPE_CHECKING:
    pass


class Locks(Protocol):
    """The lock of some blobs; see `Blobs.kept` and `Blobs.removing`."""

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Hold it with others who need all blobs kept."""

    @contextmanager
    def removing(self) -> Iterator[bool]:
        """Hold it alone, if that can be had at once."""

    def removals(self) -> int | None:
        """A number that any removal changes; None where it cannot be told, or one is under way."""

    def close(self) -> None:
        """Give back what it holds open."""


class FileLocks:
    """Of the processes of one machine: the lock of a folder, or of a file that is made.

    Parameters
    ----------
    path : of it
    make : make a file there where there is none
    """

    def __init__(self, path: Path, *, make: bool = False) -> None:
        self._path = path
        self._flags = os.O_RDWR | os.O_CREAT if make else os.O_RDONLY | os.O_DIRECTORY

    @contextmanager
    def kept(self) -> Iterator[None]:
        """See `Locks`; UnusableStore where it cannot be locked."""
        try:
            descriptor = self._lock(fcntl.LOCK_SH)
        except OSError as error:
            kind = "folder" if self._flags & os.O_DIRECTORY else "file"
            raise UnusableStore(
                f"{self._path}: the {kind} cannot be locked ({error.strerror}). Stop the "
                "service and copy the data folder as it is."
            ) from error
        try:
            yield
        finally:
            os.close(descriptor)

    @contextmanager
    def removing(self) -> Iterator[bool]:
        """See `Locks`."""
        try:
            descriptor = self._lock(fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # held by another, or there are no locks: what stays does no harm
            yield False
            return
        try:
            yield True
        finally:
            os.close(descriptor)

    def removals(self) -> int | None:
        """It is not told."""
        return None

    def close(self) -> None:
        """Nothing is held open."""

    def _lock(self, how: int) -> int:
        # of this call alone: flock then keeps out other threads as well as other processes
        descriptor = os.open(self._path, self._flags | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, how)
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor
