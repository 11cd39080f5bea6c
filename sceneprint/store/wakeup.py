"""The bell: who commits a job wakes the workers that wait, as SQLite tells nobody (`notify`: a
server does).

Every waiting worker makes a FIFO in a folder, and who rings writes one byte to each. It is a hint
and never the truth: where none can be made, or the other is on another machine, workers look
again after a while. So nothing here raises, and no upload fails for it.
"""

from __future__ import annotations

import os
import select
import socket
import stat
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol

from sqlalchemy import Connection

#: Seconds after which a FIFO that nobody reads is removed, and between two signs of life.
STALE_S, ALIVE_S = 300.0, 60.0
#: Longest wait of a worker that has no FIFO, seconds.
DEAF_S = 0.25
#: Longest wait that the system knows of, milliseconds.
MOST_MS = 2**31 - 1
#: Characters of a host's name that its processes are called by, the last ones: a server cuts
#: names of connections, and clouds name hosts alike at their beginning.
HOST = 44


class Listening(Protocol):
    """Who has asked to be woken."""

    def wait(self, timeout_s: float, *others: int) -> bool:
        """Until it rings, one of other descriptors is readable, or the time is over.

        Returns
        -------
        whether it rang
        """


def process_name() -> str:
    """What this process is called among those of all hosts: `host:pid`."""
    return f"{socket.gethostname()[-HOST:]}:{os.getpid()}"


def wait_for(timeout_s: float, *descriptors: int) -> set[int]:
    """Those of some descriptors that are readable, waited for so long; negative ones are none."""
    waiting = select.poll()
    for descriptor in descriptors:
        if descriptor >= 0:
            waiting.register(descriptor, select.POLLIN)
    return {one for one, _ in waiting.poll(min(max(1e3 * timeout_s, 0.0), MOST_MS))}


class Wakeup:
    """A folder of FIFOs.

    Parameters
    ----------
    folder : made by the first who listens
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def ring(self) -> None:
        """Wake who waits; after the commit, so that they find what they are woken for."""
        try:
            names = os.listdir(self._folder)  # noqa: PTH208  (a path for each would cost)
        except OSError:
            return  # nobody has ever listened
        for name in names:
            self._ring(self._folder / name)

    def listeners(self, _connection: Connection | None = None) -> list[str]:
        """Host and process id, as `host:pid`, of every process of this machine that listens.

        Parameters
        ----------
        _connection : of the database, where there is one at hand: a server knows who listens
        """
        try:
            names = sorted(os.listdir(self._folder))  # noqa: PTH208
        except OSError:
            return []
        read = [name for name in names if self._is_read(self._folder / name)]
        return [":".join(name.rsplit("-", 2)[:2]) for name in read]

    @contextmanager
    def listen(self) -> Iterator[Listening]:
        """Be woken from now on; what is rung before the wait begins ends it at once."""
        listener = Listener(self._folder)
        try:
            yield listener
        finally:
            listener.close()

    def close(self) -> None:
        """Ring no more."""

    def _is_read(self, path: Path) -> bool:
        """Whether somebody has a FIFO open: one that was left behind cannot be written to."""
        try:
            opened = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        except OSError:
            return False
        try:
            return stat.S_ISFIFO(os.fstat(opened).st_mode)
        finally:
            os.close(opened)

    def _ring(self, path: Path) -> None:
        try:
            opened = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        except OSError:  # nobody reads it: just made, or left behind by the dead
            with suppress(OSError):
                if path.is_fifo() and time.time() - path.stat().st_mtime > STALE_S:
                    path.unlink()
            return
        try:
            if stat.S_ISFIFO(os.fstat(opened).st_mode):
                with suppress(OSError):  # full: it is awake, or about to be
                    os.write(opened, b"!")
        finally:
            os.close(opened)


class Listener:
    """One FIFO, open; made by `Wakeup.listen`."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / f"{process_name().replace(':', '-')}-{uuid.uuid4().hex[:8]}"
        self._fifo = -1
        self._alive = 0.0
        self._open()

    def wait(self, timeout_s: float, *others: int) -> bool:
        """Until it rings, one of other descriptors is readable, or the time is over.

        Returns
        -------
        whether it rang
        """
        if self._fifo < 0:
            timeout_s = min(timeout_s, DEAF_S)
        rung = self._fifo in wait_for(timeout_s, self._fifo, *others)
        if rung:
            with suppress(BlockingIOError):
                while os.read(self._fifo, 4096):
                    pass
        if time.monotonic() - self._alive > ALIVE_S:
            self._stay()
        return rung

    def close(self) -> None:
        """Listen no more."""
        with suppress(OSError):
            self._path.unlink()
        if self._fifo >= 0:
            os.close(self._fifo)
            self._fifo = -1

    def _open(self) -> None:
        self._alive = time.monotonic()
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            os.mkfifo(self._path, 0o600)
            # to write as well: without a writer it would be at its end, and always readable
            self._fifo = os.open(self._path, os.O_RDWR | os.O_NONBLOCK)
        except OSError:
            self._fifo = -1

    def _stay(self) -> None:
        """Show that the FIFO is not left behind; one that was removed is made anew."""
        self._alive = time.monotonic()
        try:
            os.utime(self._path)
        except OSError:
            self.close()
            self._open()
